"""How each kind of fault is done and undone.

`ACTIONS` has a class for each kind in `benchmarks.chaos_schedule.KINDS`: `begin` does it, `end` undoes what
lasts.  Both return at once, since the supervisor is looked after by the same thread.
"""

import os
import random
import resource
import shutil
import signal
import sqlite3
import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from pathlib import Path

from benchmarks.chaos_schedule import PlannedFault
from benchmarks.chaos_stage import ChaosStage, faketime_library, may_mount

Pids = Callable[[str], int]
_BLOCK = b"\0" * (1 << 16)
_PAGE = 8192
_DAMAGED_PAGES = 40
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
        self.hit = {name: pid(name) for name in fault.targets if name not in ("disk", "archive")}
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
        self.stage.switch_links[self.fault.targets[0]].cut()

    def end(self) -> None:
        self.stage.switch_links[self.fault.targets[0]].mend()


class SlowSwitch(CutSwitch):
    """A slow connection between controller and switch."""

    def begin(self) -> None:
        self.stage.switch_links[self.fault.targets[0]].slow()


class ControllersSplit(Cut):
    """A controller reaches the switch, but Data Updates neither hear it nor tell it what the other one does."""

    def begin(self) -> None:
        self.stage.links[self.fault.targets[0]].hold()


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
        for file in [each for each in spool.rglob("*") if each.is_file()]:
            _damage(file)
        # a full disk takes no damaged file more
        with suppress(OSError):
            spool.mkdir(parents=True, exist_ok=True)
            (spool / "spool-9.db").write_bytes(os.urandom(4096))


class CorruptArchive(FaultAction):
    """The archive's file is damaged while all use it; at the end its operator puts his last copy there.

    The copy is of the moment before.  What was archived between the two is lost, and excused.
    """

    def __init__(self, fault: PlannedFault, stage: ChaosStage, pid: Pids) -> None:
        super().__init__(fault, stage, pid)
        self._copy = stage.disk / "archive.copy"
        self._thread = threading.Thread(target=self._break, daemon=True)

    def begin(self) -> None:
        self._thread.start()

    def _break(self) -> None:
        try:
            with (
                closing(sqlite3.connect(self.stage.archive_file)) as source,
                closing(sqlite3.connect(self._copy)) as copy,
            ):
                source.backup(copy)
        except sqlite3.Error:
            # no room: there is nothing to put back, so nothing is damaged
            self._copy.unlink(missing_ok=True)
            return
        with suppress(OSError), self.stage.archive_file.open("r+b") as file:
            pages = file.seek(0, os.SEEK_END) // _PAGE
            for page in random.Random(self.fault.at).sample(range(1, pages), min(_DAMAGED_PAGES, pages - 1)):
                file.seek(page * _PAGE)
                file.write(os.urandom(_PAGE))

    def end(self) -> None:
        self._thread.join()
        if not self._copy.exists():
            return
        file, away = self.stage.archive_file, self.stage.disk / "damaged"
        away.mkdir(exist_ok=True)
        for end in ("-wal", "-shm"):
            with suppress(FileNotFoundError):
                Path(f"{file}{end}").replace(away / f"{file.name}{end}")
        self.stage.restored.append(self.stage.folder / f"copy-{len(self.stage.restored)}.db")
        shutil.copyfile(self._copy, self.stage.restored[-1])
        self._copy.replace(file)
        shutil.rmtree(away)


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
    "corrupt_archive": CorruptArchive,
    "controllers_split": ControllersSplit,
}


def left_out() -> dict[str, str]:
    """Kinds that cannot be done on this machine, and why."""
    found = {}
    if not may_mount():
        found["full_disk"] = "mounting a small disk needs root"
        found["forwarding"] = "veth pairs need root: no frames are sent"
    if faketime_library() is None:
        found["clock"] = "libfaketime is not installed: apt install faketime"
    return found
