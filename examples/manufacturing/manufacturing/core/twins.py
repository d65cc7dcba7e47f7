"""Digital twins: of each printer, and of the fleet.

    Report of each printer ──► PrinterTwin: state, queue, expected finish, history, alarms
                                   └──► FleetTwin ──► FleetState: what schedulers know
                                                 └──► commands: abort a print, maintain a printer

A job that is neither done nor printing nor waiting is to be printed (again): nobody has to remember that.
"""

from collections.abc import Sequence
from typing import Final

import msgspec

from manufacturing.core import process
from manufacturing.core.anomaly import AnomalyDetector, commissioning_prints
from manufacturing.core.faults import MAINTENANCE_S
from manufacturing.core.orders import Task
from manufacturing.core.printer import PrintRecord, Report, Status

_EARLY: Final = 0.05
"""Below this progress the slicer's estimate is better than the printer's pace."""


class MachineState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the twin of a printer says of it."""

    machine: str
    status: Status
    loaded: int
    """Kind that it is set up for, -1 for none."""
    free_at: float
    """When its print and maintenance are expected to be over, s after the start."""
    finish: float
    """The same with its queue."""
    running: Task | None
    queue: tuple[Task, ...]
    waited: float
    """Average wait of the jobs that it has begun, s after their first sight in its queue."""
    prints: int
    """Prints that ended there, of whatever result."""
    alarm: str
    """Why it is to be maintained; empty: it is not."""


class TriedJob(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A job whose attempts came to nothing so far."""

    order: int
    number: int
    attempts: int
    machine: str
    """Of the last attempt."""


class FleetState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What schedulers know: the whole fleet at one moment."""

    step: int
    time: float
    machines: tuple[MachineState, ...]
    done: tuple[tuple[int, int], ...]
    """Jobs that were printed well, as (order, number)."""
    tried: tuple[TriedJob, ...]
    """In the order in which they failed first."""
    maintain: tuple[str, ...]
    """Machines whose print is to be aborted, and which are to be maintained, from this step."""


class TwinCounts(msgspec.Struct):
    """What the twins have decided so far."""

    alarms: int = 0
    """Maintenances ordered because of the sensors."""
    inspections: int = 0
    """Maintenances ordered because a part was found ruined."""


class PrinterTwin:
    """The twin of one printer.

    Args:
        machine: its name.
        detector: None: its sensors are not watched.
    """

    def __init__(self, machine: str, detector: AnomalyDetector | None) -> None:
        self.machine = machine
        self.history: list[PrintRecord] = []
        self.alarm = ""
        self._detector = detector
        self._seen: dict[str, float] = {}
        self._waits: list[float] = []
        self._names: set[str] = set()
        self._serviced = False
        self._queue: tuple[Task, ...] = ()
        self._queued: tuple[tuple[Task, ...], int, float] = ((), -1, 0.0)

    def update(self, report: Report) -> str:
        """Take a report; returns why the printer must be maintained now, empty for no reason."""
        failed = self._take_history(report)
        if report.queue != self._queue:
            self._queue = report.queue
            for task in report.queue:
                self._seen.setdefault(task.name, report.time)
        if report.running is not None and report.running.task.name in self._seen:
            self._waits.append(max(0.0, report.running.started - self._seen.pop(report.running.task.name)))
        if self.alarm:
            if report.status == "maintenance":
                self._serviced = True
            elif self._serviced:
                self._recovered()
            return ""
        found = self._detector.alarm(report.readings) if self._detector is not None else ""
        self.alarm = found or ("a part was found ruined" if failed else "")
        return self.alarm

    @property
    def waits_for_maintenance(self) -> bool:
        """Whether a maintenance was ordered that has not begun."""
        return bool(self.alarm) and not self._serviced

    def _take_history(self, report: Report) -> bool:
        new = [record for record in report.ended if record.task.name not in self._names]
        self._names.update(record.task.name for record in new)
        self.history += new
        return any(record.result == "Failed" for record in new)

    def _recovered(self) -> None:
        self.alarm, self._serviced = "", False
        if self._detector is not None:
            self._detector.reset()

    def state(self, report: Report) -> MachineState:
        """What it says of the printer now."""
        free = max(report.time, self._expected(report))
        finish = free + self._queue_s(report.queue, report.loaded)
        return MachineState(
            self.machine, report.status, report.loaded, round(free, 3), round(finish, 3),
            report.running.task if report.running else None, report.queue,
            round(sum(self._waits) / len(self._waits), 1) if self._waits else 0.0, len(self.history), self.alarm,
        )  # fmt: skip

    def _queue_s(self, queue: tuple[Task, ...], loaded: int) -> float:
        """Planned seconds of a queue behind what is loaded."""
        if self._queued[:2] != (queue, loaded):
            seconds, kind = 0.0, loaded
            for task in queue:
                seconds += process.setup_s(task.kind, kind) + process.planned_s(task)
                kind = task.kind
            self._queued = (queue, loaded, seconds)
        return self._queued[2]

    def _expected(self, report: Report) -> float:
        running = report.running
        now = report.time
        if self.alarm:
            return now + MAINTENANCE_S + (process.CLEAN_UP_S if running else 0.0)
        if running is None:
            return now
        if running.phase == "pre_print":
            setup = process.setup_s(running.task.kind, -1)
            left = max(0.0, running.started + setup - now) if setup else 0.0
            return now + min(left, setup) + process.planned_s(running.task)
        if running.phase == "wait_cleanup":
            return now + process.CLEAN_UP_S / 2
        total = running.elapsed / running.progress if running.progress > _EARLY else float(running.total)
        return now + max(0.0, total - running.elapsed) + process.CLEAN_UP_S


class FleetTwin:
    """The twins of all printers, and what follows for the fleet.

    Args:
        machines: their names, in order.
        seed: of the scenario, for the good prints that detectors are trained on.
        sensors: False: only ruined parts tell of a fault, as for a fleet without twins.
    """

    def __init__(self, machines: Sequence[str], seed: int, *, sensors: bool) -> None:
        self.counts = TwinCounts()
        self.step = -1
        self._twins = {
            machine: PrinterTwin(
                machine, AnomalyDetector(commissioning_prints(seed, number)) if sensors else None
            )
            for number, machine in enumerate(machines)
        }
        self._done: dict[tuple[int, int], None] = {}
        self._tried: dict[tuple[int, int], tuple[int, str]] = {}
        self._taken = dict.fromkeys(machines, 0)
        self._overdue: set[str] = set()
        """Machines whose maintenance may have been ordered by nobody, see `restore`."""

    def update(self, reports: Sequence[Report]) -> FleetState:
        """Take the reports of all printers of one step."""
        maintain = []
        for report in reports:
            twin = self._twins[report.machine]
            cause = twin.update(report)
            if report.machine in self._overdue and twin.waits_for_maintenance:
                maintain.append(report.machine)
            if cause:
                maintain.append(report.machine)
                if cause.startswith("a part"):
                    self.counts.inspections += 1
                else:
                    self.counts.alarms += 1
            self._note(twin)
        self._overdue.clear()
        self.step = reports[0].step
        return FleetState(
            self.step, reports[0].time, tuple(self._twins[report.machine].state(report) for report in reports),
            tuple(self._done), tuple(TriedJob(*job, *tried) for job, tried in self._tried.items()), tuple(maintain),
        )  # fmt: skip

    def _note(self, twin: PrinterTwin) -> None:
        for record in twin.history[self._taken[twin.machine] :]:
            job = record.task.job
            if record.result == "Finished":
                self._done[job] = None
                self._tried.pop(job, None)
            elif job not in self._done:
                attempts = max(self._tried.get(job, (0, ""))[0], record.task.attempt + 1)
                self._tried[job] = (attempts, twin.machine)
        self._taken[twin.machine] = len(twin.history)

    def restore(self, reports: Sequence[Report]) -> None:
        """Take old reports, after a restart, for their history and readings.

        Whether anybody carried out what they led to is not known: a maintenance that is still outstanding afterwards
        is ordered again by the next `update`, which does no harm to a printer that waits for it already.
        """
        for report in reports:
            twin = self._twins[report.machine]
            twin.update(report)
            self._note(twin)
        self._overdue = {name for name, twin in self._twins.items() if twin.waits_for_maintenance}

    def history(self, machine: str) -> tuple[PrintRecord, ...]:
        """Prints that ended on a printer, in order."""
        return tuple(self._twins[machine].history)
