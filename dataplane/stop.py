"""Waits until a signal or a thread asks the process to end.

Neither a handler that sets a threading.Event nor `Event.wait` without a time limit is safe for this: the
handler may run while the main thread holds the event's own lock, and a signal just before the thread sleeps
does not wake it.  A pipe has neither problem: CPython writes to it when the signal arrives.
"""

import os
import select
import signal
from collections.abc import Iterable
from contextlib import suppress
from types import FrameType


class Stop:
    """Waits for one of `signals`, or for `set`.  For the main thread, once per process.

    stop = Stop((signal.SIGTERM, signal.SIGINT))
    stop.wait()
    """

    def __init__(self, signals: Iterable[int]) -> None:
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        # first: a signal that has a handler and no pipe would be forgotten
        signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        for number in signals:
            signal.signal(number, _taken)

    def set(self) -> None:
        """End the wait, now or when it begins; from any thread."""
        with suppress(BlockingIOError):  # full: it ends in any case
            os.write(self._write, b"\0")

    def wait(self) -> None:
        """Return as soon as it was set."""
        os.read(self._read, 1)

    def readable_first(self, descriptor: int) -> bool:
        """Wait until a descriptor can be read, or this was set; whether the former, and not the latter."""
        ready, _, _ = select.select([self._read, descriptor], [], [])
        return self._read not in ready


def _taken(_number: int, _frame: FrameType | None) -> None:
    """The pipe knows."""
