"""Assignments and maintenance in as REST calls, reports of all printers out.

    manufacturing.inventory.machine_assets ──► which printers
    manufacturing.fleet.digital_twins ───────► DataDriver ──REST──► printers
    manufacturing.job_assignment.scheduler.* ─►    │
    manufacturing.plan.scheduler ────────────►     └──► manufacturing.clock.data_driver
                                                        manufacturing.report.data_driver.<machine>

While an answer is missing, clock and reports of the step are repeated; after `patience_s` time goes on without a plan,
as it would for real printers.
"""

import logging
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import httpx
import msgspec

import due.service
from due import NO_WAIT, Capability, Engine, Interest, Item
from manufacturing.core.printer import STEP_S, Report
from manufacturing.core.simulation import reconcile
from manufacturing.data_driver.printer_client import PrinterClient, PrinterUnreachable
from manufacturing.data_driver.step_keeper import StepKeeper
from manufacturing.messages import (
    ASSIGNMENT,
    CLOCK,
    FLEET,
    INVENTORY,
    PLAN,
    REPORT,
    FleetMessage,
    Inventory,
    JobAssignment,
    PlanMessage,
    ReportMessage,
    SimulatedClock,
    from_value,
    to_value,
)

INTERESTS = (Interest(INVENTORY), Interest(FLEET), Interest(f"{ASSIGNMENT}.*"), Interest(PLAN))
CAPABILITIES = (Capability(CLOCK, archive="always"), Capability(f"{REPORT}.*", archive="always"))
_TIMEOUT_S: Final = 10.0

log = logging.getLogger("data_driver")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the data driver."""

    readings: bool = True
    """Read the sensors."""
    repeat_s: float = 1.0
    """Seconds without an answer after which the reports of a step are repeated."""
    patience_s: float = 120.0
    """Seconds after which time goes on without a plan."""


class DataDriverService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine, self._settings = engine, settings
        self._lock = threading.RLock()
        self._client = httpx.Client(timeout=_TIMEOUT_S, trust_env=False)
        self._inventory: Inventory | None = None
        self._printers: dict[str, PrinterClient] = {}
        self._keeper = StepKeeper(0)
        self._reports: list[Report] = []
        self._told: dict[str, int] = {}
        """Ended prints of which the twins have heard, by machine."""
        self._sent, self._since = 0.0, 0.0
        self._moving = False
        """Whether the plan is carried out, and only the clock has to move."""
        self._unplanned = 0
        self._errors = 0
        self._stopped = False

    def start(self) -> None:
        """Subscribe."""
        handlers: dict[str, Callable[[Item], None]] = {
            INVENTORY: self._on_inventory,
            FLEET: self._on_fleet,
            f"{ASSIGNMENT}.*": self._on_assignment,
            PLAN: self._on_plan,
        }
        for key, handler in handlers.items():
            self._engine.observe(key).subscribe(self._guarded(handler))

    def _guarded(self, handler: Callable[[Item], None]) -> Callable[[Item], None]:
        def handle(item: Item) -> None:
            with self._lock:
                if self._stopped:
                    return
                try:
                    handler(item)
                except msgspec.ValidationError as error:
                    log.warning("%s is not understood: %s", item.key, error)
                except PrinterUnreachable as error:
                    self._unreachable(error)

        return handle

    def _unreachable(self, error: PrinterUnreachable) -> None:
        """It is tried again with the next repetition."""
        self._errors += 1
        log.warning("%s", error)

    def tick(self) -> None:
        """Repeat what was not answered; let time pass."""
        with self._lock:
            if self._inventory is None or self._stopped:
                return
            try:
                self._go_on(time.monotonic())
            except PrinterUnreachable as error:
                self._unreachable(error)

    def _go_on(self, now: float) -> None:
        if not self._reports:
            self._read()
        elif self._moving:
            self._next_step()
        elif self._keeper.complete() is not None:  # a printer did not answer before
            self._carry_out()
        elif now - self._since >= self._settings.patience_s:
            self._unplanned += 1
            log.warning("no plan for step %d within %g s", self._keeper.step, self._settings.patience_s)
            self._moving = True
            self._next_step()
        elif now - self._sent >= self._settings.repeat_s:
            self._tell()

    # the printers

    def _on_inventory(self, item: Item) -> None:
        found = from_value(item.value, Inventory)
        if self._inventory == found:
            return
        printers = {name: PrinterClient(name, url, self._client) for name, url in found.printers.items()}
        self._keeper = StepKeeper(next(iter(printers.values())).clock())
        self._printers, self._inventory = printers, found
        self._told = dict.fromkeys(printers, 0)
        self._reports, self._moving = [], False
        self._read()

    def _read(self) -> None:
        self._reports = []
        step = self._keeper.step
        found = [printer.read(step, readings=self._settings.readings) for printer in self._printers.values()]
        self._reports = found
        self._since = time.monotonic()
        self._tell()

    def _tell(self) -> None:
        """Clock and reports of this step; ended prints are told until the twins have answered."""
        if self._inventory is None:
            return
        self._sent = time.monotonic()
        run, step = self._inventory.run, self._keeper.step
        for report in self._reports:
            ended = tuple(self._printers[report.machine].history[self._told[report.machine] :])
            message = ReportMessage(run, msgspec.structs.replace(report, ended=ended))
            self._engine.write(f"{REPORT}.{report.machine}", to_value(message), [NO_WAIT])
        clock = SimulatedClock(run, step, step * STEP_S, tuple(self._printers))
        self._engine.write(CLOCK, to_value(clock), [NO_WAIT])

    # what is to be done

    def _of_this_run(self, run: str) -> bool:
        return self._inventory is not None and run == self._inventory.run and bool(self._reports)

    def _on_fleet(self, item: Item) -> None:
        message = from_value(item.value, FleetMessage)
        if not self._of_this_run(message.run):
            return
        if message.fleet.step == self._keeper.step:
            self._told = {name: len(printer.history) for name, printer in self._printers.items()}
        for machine in self._keeper.fleet(message):
            if machine in self._printers:
                self._printers[machine].maintain()
        self._carry_out()

    def _on_assignment(self, item: Item) -> None:
        message = from_value(item.value, JobAssignment)
        if self._of_this_run(message.run):
            self._keeper.assignment(item.key.rpartition(".")[2], message)
            self._carry_out()

    def _on_plan(self, item: Item) -> None:
        message = from_value(item.value, PlanMessage)
        if self._of_this_run(message.run):
            self._keeper.plan(message)
            self._carry_out()

    def _carry_out(self) -> None:
        wanted = self._keeper.complete()
        if wanted is None or self._moving:
            return
        for machine, tasks in wanted.items():
            printer = self._printers.get(machine)
            if printer is None:
                continue
            withdraw, add = reconcile(printer.queue, tasks)
            for name in withdraw:
                printer.withdraw(name)
            for place, task in add:
                printer.enqueue(task, place)
            printer.queue = list(tasks)
        self._moving = True
        self._next_step()

    def _next_step(self) -> None:
        """Ask for the next step; too early: the next tick asks again."""
        printer = next(iter(self._printers.values()))
        if printer.set_clock(self._keeper.step + 1):
            self._keeper.next()
            self._moving = False
            self._read()

    def stop(self) -> None:
        """Finish the request in progress, and close the connections."""
        with self._lock:
            self._stopped = True
        self._client.close()

    def health(self) -> dict[str, Any]:
        """Step, steps without a plan, refused or unanswered requests."""
        return {"step": self._keeper.step, "unplanned": self._unplanned, "errors": self._errors}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app until a signal ends it."""
    return due.service.run("data_driver", DataDriverService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
