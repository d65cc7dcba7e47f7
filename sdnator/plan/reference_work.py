"""How fast the machine is while something is measured: the CPU time of a fixed piece of work.

The CPU time of the same packets differs by a third within minutes where others share caches and processors, as on a
virtual machine.  The same work, done four times a second beside what is measured, differs as they do.
"""

import statistics
import threading
import time
from types import TracebackType
from typing import Final, Self

import msgspec
import numpy as np

_PAUSE_S: Final = 0.25
_ROWS: Final = 300
_NUMBERS: Final = 4096


class ReferenceWork:
    """Between enter and exit a thread does the work now and then; takes about one part in a thousand of a processor."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reference-work", daemon=True)

    @property
    def us(self) -> float:
        """Microseconds of CPU that the work took, the median."""
        return statistics.median(self._times)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            began = time.thread_time_ns()
            work()
            self._times.append((time.thread_time_ns() - began) / 1000)
            if self._ended.wait(_PAUSE_S):
                return


def work() -> int:
    """What apps do with packets, in small: decode, count by address, sort a column."""
    rows = [(number, number * 0.5, f"10.0.{number % 7}.{number % 251}") for number in range(_ROWS)]
    found: dict[str, int] = {}
    for number, _, address in msgspec.msgpack.decode(msgspec.msgpack.encode(rows)):
        found[address] = found.get(address, 0) + number
    column = (np.arange(_NUMBERS, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)
    return len(found) + int(np.sort(column).cumsum()[-1] % np.uint64(2))
