"""One printer: its queue, the print in progress, its sensors, its faults and its history.

    enqueue, withdraw, abort, maintain ──► Printer ──advance(to)──► report()

A state machine on simulated time: nothing happens but in `advance`, and the result does not depend on how often it
is called, except that readings are taken in steps.
"""

from typing import Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from manufacturing.core import faults, process
from manufacturing.core.faults import PrinterFault
from manufacturing.core.orders import NOZZLE_C, Task

Status = Literal["idle", "printing", "maintenance"]
Phase = Literal["none", "pre_print", "printing", "wait_cleanup"]
Result = Literal["Finished", "Failed", "Aborted"]
STEP_S: Final = 300.0
"""Simulated seconds from one report to the next."""
READING_S: Final = 30.0
"""Simulated seconds from one reading of the sensors to the next."""
MOST_QUEUED: Final = 4_096


class QueueFull(Exception):
    """The printer takes no more jobs."""


class PrintRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ended print in a printer's history; times in s after the start."""

    task: Task
    started: float
    finished: float
    """When printing ended."""
    cleaned: float
    """When the plate was free again."""
    result: Result
    setup: float
    """Seconds spent on setting up."""


class RunningPrint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The print in progress, as a printer tells it."""

    task: Task
    started: float
    phase: Phase
    elapsed: int
    """Seconds since printing began; 0 before."""
    total: int
    """The slicer's estimate of the printing time, s."""
    progress: float
    """0 to 1."""


class Report(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of a printer at one moment."""

    machine: str
    step: int
    time: float
    status: Status
    loaded: int
    """Kind that it is set up for, -1 for none."""
    running: RunningPrint | None
    queue: tuple[Task, ...]
    ended: tuple[PrintRecord, ...]
    """Prints that ended since the report before."""
    readings: tuple[tuple[float, float], ...]
    """Deviation of the nozzle from its target in °C and flow as a share, one each 30 s of printing."""


class _Print:
    """A print that has begun: when its phases end."""

    def __init__(self, task: Task, now: float, setup: float, heat: float, printing: float) -> None:
        self.task, self.started, self.setup = task, now, setup
        self.printing_from = round(now + setup + heat, 3)
        self.printing_to = round(self.printing_from + printing, 3)
        self.cleaned = round(self.printing_to + process.CLEAN_UP_S, 3)
        self.result: Result = "Finished"


class Printer:
    """An emulated Ultimaker 3.

    Args:
        number: of the machine in its fleet.
        seed: of the scenario.
        faulty: whether faults happen.
    """

    def __init__(self, number: int, seed: int, *, faulty: bool) -> None:
        self.machine = f"m{number:02d}"
        self.queue: list[Task] = []
        self.history: list[PrintRecord] = []
        self.time = 0.0
        self.loaded = -1
        self.ruined = 0
        """Prints that a fault ruined."""
        self.faults_begun: list[float] = []
        """When the faults so far began, s after the start."""
        self._number, self._seed = number, seed
        self._print: _Print | None = None
        self._maintained_at: float | None = None
        self._wants_maintenance = False
        self._nozzle = process.AMBIENT_C
        self._heater_off = 0.0
        self._printed = 0.0
        self._fault = faults.draw(seed, number, 0, 0.0) if faulty else None
        self._faults = 0
        self._measured: tuple[int, NDArray[np.float64], PrinterFault | None] = (0, np.zeros(0), None)
        self._readings: NDArray[np.float64] | None = None
        self.targets: NDArray[np.float64] = np.zeros(0)
        """Target temperature at each reading, °C."""
        self.reading_times: NDArray[np.float64] = np.zeros(0)
        """When each reading was taken, s after the start."""
        self._told = 0

    # what can be asked of it

    def enqueue(self, task: Task, place: int | None = None) -> None:
        """Put a job at a place of the queue, None for its end; raises QueueFull."""
        if len(self.queue) >= MOST_QUEUED:
            raise QueueFull(f"{self.machine}: {MOST_QUEUED} jobs wait already")
        self.queue.insert(len(self.queue) if place is None else place, task)

    def withdraw(self, name: str) -> bool:
        """Take a waiting job out of the queue; False if it does not wait."""
        rest = [task for task in self.queue if task.name != name]
        found = len(rest) < len(self.queue)
        self.queue = rest
        return found

    def knows(self, name: str) -> bool:
        """Whether a job of this name waits, is printed or was printed here."""
        running = self._print is not None and self._print.task.name == name
        return (
            running
            or any(task.name == name for task in self.queue)
            or any(record.task.name == name for record in self.history)
        )

    def abort(self) -> bool:
        """Stop the print in progress; False if there is none, or if only its plate has to be cleaned."""
        running = self._print
        if running is None or self.time >= running.printing_to:
            return False
        running.printing_from = min(running.printing_from, self.time)
        running.printing_to = self.time
        running.cleaned = round(self.time + process.CLEAN_UP_S, 3)
        running.result = "Aborted"
        return True

    def maintain(self) -> None:
        """Have it maintained as soon as nothing lies on its plate, before the next print."""
        self._wants_maintenance = self._maintained_at is None

    # time

    def advance(self, to: float) -> None:
        """Let simulated time pass up to `to`, s after the start."""
        before = self.time
        batches: list[NDArray[np.float64]] = []
        while self._next(to, batches):
            pass
        self._read_sensors(before, to, batches)
        self.time = to
        self._measure(round(to / STEP_S), batches)

    def _next(self, to: float, batches: list[NDArray[np.float64]]) -> bool:
        """One event that is due; False if none is left before `to`."""
        if self._maintained_at is not None:
            if self._maintained_at > to:
                return False
            self.time, self._maintained_at = self._maintained_at, None
            self._repair()
            return True
        if self._print is not None:
            if self._print.cleaned > to:
                return False
            self._end(self._print, batches)
            return True
        if self.time >= to:
            return False
        if self._wants_maintenance:
            self._wants_maintenance = False
            self._maintained_at = round(self.time + faults.MAINTENANCE_S, 3)
            return True
        if self.queue:
            self._begin(self.queue.pop(0))
            return True
        return False

    def _begin(self, task: Task) -> None:
        setup = process.setup_s(task.kind, self.loaded)
        cold = process.nozzle_cooled(self._nozzle, self.time + setup - self._heater_off)
        heat = process.heat_up_s(cold, NOZZLE_C[task.kind])
        self._print = _Print(task, self.time, setup, heat, process.printing_s(self._seed, task))
        self.loaded = task.kind

    def _end(self, running: _Print, batches: list[NDArray[np.float64]]) -> None:
        self._read_sensors(self.time, running.cleaned, batches)
        self._nozzle, self._heater_off = NOZZLE_C[running.task.kind], running.printing_to
        self.time, self._print = running.cleaned, None
        if self._fault is not None and running.result == "Finished" and self._printed > self._fault.ruin:
            running.result = "Failed"
            self.ruined += 1
        self.history.append(
            PrintRecord(
                running.task,
                running.started,
                running.printing_to,
                running.cleaned,
                running.result,
                running.setup,
            )
        )

    def _repair(self) -> None:
        if self._fault is not None and self._printed > self._fault.onset:
            self._faults += 1
            self._fault = faults.draw(self._seed, self._number, self._faults, self._printed)

    # sensors

    def _read_sensors(self, since: float, to: float, batches: list[NDArray[np.float64]]) -> None:
        """Times of the readings in (since, to] while it printed, and what it had printed by then."""
        running = self._print
        if running is None:
            return
        start, end = max(since, running.printing_from), min(to, running.printing_to)
        if end <= start:
            return
        times = np.arange(np.floor(start / READING_S) + 1, np.floor(end / READING_S) + 1) * READING_S
        fault = self._fault
        if fault is not None and self._printed <= fault.onset < self._printed + end - start:
            self.faults_begun.append(start + fault.onset - self._printed)
        if len(times):
            targets = np.full(len(times), NOZZLE_C[running.task.kind])
            batches.append(np.column_stack((targets, self._printed + times - start, times)))
        self._printed += end - start

    def _measure(self, step: int, batches: list[NDArray[np.float64]]) -> None:
        # a repair takes longer than a step, so that all readings of one belong to the same fault
        rows = np.concatenate(batches) if batches else np.zeros((0, 3))
        self.targets, self.reading_times = rows[:, 0], rows[:, 2]
        self._measured = (step, rows[:, 1], self._fault)
        self._readings = None

    # what it tells

    @property
    def broken(self) -> bool:
        """Whether a fault has begun: the truth, which no twin knows."""
        return self._fault is not None and self._printed > self._fault.onset

    @property
    def status(self) -> Status:
        """In the words of its REST interface."""
        if self._maintained_at is not None:
            return "maintenance"
        return "printing" if self._print is not None else "idle"

    @property
    def target(self) -> float:
        """Target temperature of the nozzle, 0 while its heater is off."""
        running = self._print
        if running is None or not running.started + running.setup <= self.time < running.printing_to:
            return 0.0
        return NOZZLE_C[running.task.kind]

    @property
    def nozzle(self) -> float:
        """Temperature of the nozzle now, °C."""
        running = self._print
        if running is None or self.time < running.started + running.setup:
            return round(process.nozzle_cooled(self._nozzle, self.time - self._heater_off), 2)
        target = NOZZLE_C[running.task.kind]
        if self.time >= running.printing_to:
            return round(process.nozzle_cooled(target, self.time - running.printing_to), 2)
        if self.time < running.printing_from:
            return round(target - (running.printing_from - self.time) * process.HEAT_C_S, 2)
        return round(target + (float(self.readings[-1, 0]) if len(self.readings) else 0.0), 2)

    @property
    def readings(self) -> NDArray[np.float64]:
        """Readings of the last step, shape (n, 2), see `Report.readings`."""
        if self._readings is None:  # nobody may want them
            step, printed, fault = self._measured
            self._readings = faults.readings(self._seed, self._number, step, printed, fault)
        return self._readings

    def running(self) -> RunningPrint | None:
        """The print in progress."""
        running = self._print
        if running is None:
            return None
        total = running.printing_to - running.printing_from
        done = min(max(self.time - running.printing_from, 0.0), total)
        phase: Phase = "printing"
        if self.time < running.printing_from:
            phase = "pre_print"
        elif self.time >= running.printing_to:
            phase = "wait_cleanup"
        return RunningPrint(
            running.task,
            running.started,
            phase,
            int(done),
            int(process.planned_printing_s(running.task.volume)),
            round(done / total, 4) if total else 1.0,
        )

    def report(self, step: int, *, sensors: bool = True) -> Report:
        """Everything since the report before; without `sensors` no readings."""
        ended = tuple(self.history[self._told :])
        self._told = len(self.history)
        readings = tuple((a, b) for a, b in self.readings.tolist()) if sensors else ()
        return Report(
            self.machine,
            step,
            self.time,
            self.status,
            self.loaded,
            self.running(),
            tuple(self.queue),
            ended,
            readings,
        )
