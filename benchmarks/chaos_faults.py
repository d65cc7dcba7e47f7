"""How each kind of fault is done and undone.

`ACTIONS` has a class for each kind in `benchmarks.chaos_schedule.KINDS`: `begin` does it, `end` undoes what
lasts.  Both return at once, since the supervisor is looked after by the same thread.
"""

import os
import resource
import signal
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from benchmarks.chaos_schedule import PlannedFault
from benchmarks.chaos_stage import ChaosStage, faketime_library, may_mount

Pids = Callable[[str], int]
_BLOCK = b"\0" * (1 << 16)
_GROWTH = 8 << 20
"""Bytes of address space that a part without memory may still take."""


class FaultAction:
    """A fault that is being done.

    Args:
        fault: which one.
        stage: where.
        pid: the process id of a target, now.
    """

    def __init__(self, fault: PlannedFault, stage: ChaosStage, pid: Pids) -> None:
        self.fault = fault
        self.stage = stage
        self.hit = {name: pid(name) for name in fault.targets if name != "disk"}
        self._pid = pid

    def begin(self) -> None:
        """Do it."""
        raise NotImplementedError

    def end(self) -> None:
        """Undo what lasts; nothing for a blow."""

    def signal_all(self, number: signal.Signals) -> None:
        """To every target, as long as it is still the process that was hit."""
        for name, pid in self.hit.items():
            if self._pid(name) == pid:
                with suppress(ProcessLookupError):
                    os.kill(pid, number)


class Kill(FaultAction):
    """kill -9 of one process or two at once; Data Updates come back empty."""

    def begin(self) -> None:
        self.signal_all(signal.SIGKILL)


class StopFault(FaultAction):
    """SIGSTOP; the supervisor may kill it meanwhile."""

    def begin(self) -> None:
        self.signal_all(signal.SIGSTOP)

    def end(self) -> None:
        self.signal_all(signal.SIGCONT)


class Cut(FaultAction):
    """No connection to Data Updates."""

    def begin(self) -> None:
        self.stage.links[self.fault.targets[0]].cut()

    def end(self) -> None:
        self.stage.links[self.fault.targets[0]].mend()


class Slow(Cut):
    """A slow connection to Data Updates."""

    def begin(self) -> None:
        self.stage.links[self.fault.targets[0]].slow()


class CutSwitch(FaultAction):
    """No connection between controller and switch."""

    def begin(self) -> None:
        self.stage.switch_link.cut()

    def end(self) -> None:
        self.stage.switch_link.mend()


class SlowSwitch(CutSwitch):
    """A slow connection between controller and switch."""

    def begin(self) -> None:
        self.stage.switch_link.slow()


class FullDisk(FaultAction):
    """The disk of state and archive takes no byte more."""

    def begin(self) -> None:
        with suppress(OSError), self._filler.open("wb", buffering=0) as file:
            while True:
                file.write(_BLOCK)

    def end(self) -> None:
        self._filler.unlink(missing_ok=True)

    @property
    def _filler(self) -> Path:
        return self.stage.disk / "filler"


class ClockFault(Kill):
    """Started again with a wall clock that is an hour off."""

    def begin(self) -> None:
        self.stage.clocks[self.fault.targets[0]] = self.fault.value
        super().begin()


class Memory(FaultAction):
    """No memory beyond what it has."""

    def begin(self) -> None:
        for pid in self.hit.values():
            with suppress(ProcessLookupError, FileNotFoundError):
                pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
                most = pages * resource.getpagesize() + _GROWTH
                resource.prlimit(pid, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))

    def end(self) -> None:
        for name, pid in self.hit.items():
            if self._pid(name) == pid:
                with suppress(ProcessLookupError):
                    free = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
                    resource.prlimit(pid, resource.RLIMIT_AS, free)


class Corrupt(Kill):
    """Killed, and what it left on disk for its next start is damaged: spool and settings of its engine."""

    def begin(self) -> None:
        super().begin()
        spool = self.stage.spool(self.fault.targets[0])
        spool.mkdir(parents=True, exist_ok=True)
        for file in [each for each in spool.rglob("*") if each.is_file()]:
            _damage(file)
        (spool / "spool-9.db").write_bytes(os.urandom(4096))


def _damage(file: Path) -> None:
    with suppress(OSError), file.open("r+b") as opened:
        size = opened.seek(0, os.SEEK_END)
        opened.seek(size // 2)
        opened.write(os.urandom(min(64, size - size // 2)))


ACTIONS: Mapping[str, type[FaultAction]] = {
    "kill": Kill,
    "kill_two": Kill,
    "stop": StopFault,
    "redis_empty": Kill,
    "cut": Cut,
    "slow": Slow,
    "cut_switch": CutSwitch,
    "slow_switch": SlowSwitch,
    "full_disk": FullDisk,
    "clock": ClockFault,
    "memory": Memory,
    "corrupt": Corrupt,
}

NOT_DONE: Mapping[str, str] = {
    "controllers_split": "two controllers of one switch, split from each other, are not part of `sdnator up`",
    "corrupt_archive": "a damaged archive loses what stood in it: there is no promise to check",
}
"""What this benchmark does not do anywhere, and why."""


def left_out() -> dict[str, str]:
    """Kinds that cannot be done on this machine, and why."""
    found = {}
    if not may_mount():
        found["full_disk"] = "mounting a small disk needs root"
        found["forwarding"] = "veth pairs need root: no frames are sent"
    if faketime_library() is None:
        found["clock"] = "libfaketime is not installed: apt install faketime"
    return found
