"""CPU and memory of a replay's processes, from /proc: those of the start, and those of the loop."""

import os
import threading
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from sdnator.replay.packet_accounting import PacketAccounting

_EVERY_S = 0.2
_HZ = os.sysconf("SC_CLK_TCK")
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / (1 << 20)


class ProcessMeter:
    """Looks at this process and all below it until it is left."""

    def __init__(self) -> None:
        self._first = _cpu_s()
        self._begun: dict[tuple[int, str], float] | None = None
        self._last: dict[tuple[int, str], float] = {}
        self._peaks: dict[tuple[int, str], float] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def look(self, flight: PacketAccounting, _blocks: int) -> None:
        """The progress of a pass: the loop begins with its first packet, and ends with its last."""
        if self._begun is None and flight.sent:
            self._begun = _cpu_s()
        if flight.decided < len(flight.state) or not self._last:
            self._last = _cpu_s()

    def loop_cpu_s(self) -> dict[str, float]:
        """CPU seconds of the loop, by process."""
        begun = self._begun or {}
        return _by_name({key: s - begun.get(key, 0.0) for key, s in self._last.items()})

    def start_cpu_s(self) -> dict[str, float]:
        """CPU seconds before the first packet, by process."""
        return _by_name({key: s - self._first.get(key, 0.0) for key, s in (self._begun or {}).items()})

    def peak_mb(self) -> dict[str, float]:
        """Most resident memory, by process."""
        return {name: round(mb, 1) for name, mb in _by_name(self._peaks).items()}

    def _watch(self) -> None:
        while not self._stop.wait(_EVERY_S):
            for pid, name in _tree(os.getpid(), "replay"):
                with suppress(OSError, ValueError):
                    mb = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_MB
                    self._peaks[pid, name] = max(mb, self._peaks.get((pid, name), 0.0))


def _cpu_s() -> dict[tuple[int, str], float]:
    found = {}
    for pid, name in _tree(os.getpid(), "replay"):
        with suppress(OSError, ValueError):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            found[pid, name] = (int(fields[11]) + int(fields[12])) / _HZ
    return found


def _by_name(values: dict[tuple[int, str], float]) -> dict[str, float]:
    found: dict[str, float] = {}
    for (_, name), value in values.items():
        found[name] = found.get(name, 0.0) + value
    return found


def _tree(pid: int, name: str) -> list[tuple[int, str]]:
    found = [(pid, name)]
    for task in _names(f"/proc/{pid}/task"):
        with suppress(OSError):
            for child in Path(f"/proc/{pid}/task/{task}/children").read_text().split():
                found += _tree(int(child), _program(int(child)))
    return found


def _names(folder: str) -> list[str]:
    with suppress(OSError):
        return [each.name for each in Path(folder).iterdir()]
    return []


def _program(pid: int) -> str:
    """`kitsune` of `python -m apps.kitsune.service`; else the program's name."""
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
        if "-m" in words[:-1]:
            module = words[words.index("-m") + 1].removesuffix(".service")
            return {"dataplane": "switch"}.get(module, module.rpartition(".")[2])
        return Path(words[0]).name or "gone"
    return "gone"
