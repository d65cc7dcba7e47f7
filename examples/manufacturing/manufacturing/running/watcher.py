"""Follows a run on DUE: which prints ended, what is in progress, what waits, and when all jobs are done."""

import threading
import time
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import msgspec

from due import CONSUMER, Engine, Interest, Item, Options
from manufacturing.core.orders import Order, Scenario
from manufacturing.core.printer import PrintRecord
from manufacturing.core.twins import FleetState
from manufacturing.messages import (
    FLEET,
    ORDER,
    REPORT,
    FleetMessage,
    OrderMessage,
    ReportMessage,
    from_value,
)

INTERESTS: Final = (Interest(f"{REPORT}.*"), Interest(FLEET), Interest(f"{ORDER}.*"))


class Stalled(Exception):
    """A run did not go on or not end; the text says at which step it is and what is missing."""


class Watcher:
    """Hears what the apps say; a context manager.

    Args:
        options: where Data Updates and Data Archives are.
        scenario: to know how many jobs there are.
    """

    def __init__(self, options: Options, scenario: Scenario) -> None:
        self.scenario = scenario
        self._jobs = sum(order.jobs for order in scenario.book())
        self._engine = Engine(options)
        self._changed = threading.Condition()
        self._prints: dict[str, dict[str, PrintRecord]] = {name: {} for name in scenario.machine_names()}
        self._fleet: FleetState | None = None
        self._orders: dict[int, Order] = {}
        self._began: dict[str, float] = {}
        """When the print in progress of each machine began, s."""

    def __enter__(self) -> "Watcher":
        self._engine.init("manufacturing_watcher", CONSUMER, interests=INTERESTS)
        self._engine.observe(f"{REPORT}.*").subscribe(self._on_report)
        self._engine.observe(FLEET).subscribe(self._on_fleet)
        self._engine.observe(f"{ORDER}.*").subscribe(self._on_order)
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.close()

    def _on_report(self, item: Item) -> None:
        report = from_value(item.value, ReportMessage).report
        with self._changed:
            of_machine = self._prints.setdefault(report.machine, {})
            if report.running is not None:
                self._began[report.machine] = report.running.started
            for record in report.ended:
                of_machine.setdefault(record.task.name, record)

    def _on_fleet(self, item: Item) -> None:
        message = from_value(item.value, FleetMessage)
        with self._changed:
            self._fleet = message.fleet
            self._changed.notify_all()

    def _on_order(self, item: Item) -> None:
        order = from_value(item.value, OrderMessage).order
        with self._changed:
            self._orders[order.id] = order

    @property
    def step(self) -> int:
        """The step that the twins have reached; -1 before the first."""
        return self._fleet.step if self._fleet is not None else -1

    @property
    def done(self) -> int:
        """Jobs that were printed well."""
        return len(self._fleet.done) if self._fleet is not None else 0

    def wait_step(self, step: int, seconds: float) -> None:
        """Return when the twins have reached a step, or when all is done; raises Stalled."""
        with self._changed:
            if not self._changed.wait_for(partial(self._is_past, step - 1), seconds):
                raise Stalled(f"step {step} was not reached within {seconds:g} s: {self._where()}")

    def wait_done(self, patience_s: float, most_s: float) -> None:
        """Return when all jobs are done.

        Args:
            patience_s: seconds that a single step may take.
            most_s: seconds that all may take.

        Raises:
            Stalled: one of them was not enough.
        """
        end = time.monotonic() + most_s
        with self._changed:
            while self.done < self._jobs:
                before = self.step
                left = min(patience_s, end - time.monotonic())
                if left <= 0 or not self._changed.wait_for(partial(self._is_past, before), left):
                    raise Stalled(f"the run did not go on: {self._where()}")

    def _is_past(self, step: int) -> bool:
        return self.step > step or self.done == self._jobs

    def _where(self) -> str:
        return f"step {self.step}, {self.done} of {self._jobs} jobs done"

    def prints(self) -> Mapping[str, tuple[PrintRecord, ...]]:
        """Ended prints of each machine, in order."""
        with self._changed:
            return {
                name: tuple(sorted(found.values(), key=lambda record: record.started))
                for name, found in self._prints.items()
            }

    def state(self) -> dict[str, Any]:
        """What the page shows, as plain values: bars of each machine, orders, progress."""
        with self._changed:
            fleet = self._fleet
            machines = {one.machine: one for one in fleet.machines} if fleet is not None else {}
            bars = {name: [_bar(record) for record in found.values()] for name, found in self._prints.items()}
            orders = [msgspec.to_builtins(order) for order in self._orders.values()]
        return {
            "scenario": self.scenario.name,
            "time": fleet.time if fleet is not None else 0.0,
            "done": self.done,
            "jobs": self._jobs,
            "orders": orders,
            "machines": [
                {
                    "name": name,
                    "bars": bars[name],
                    "status": machines[name].status if name in machines else "unknown",
                    "alarm": machines[name].alarm if name in machines else "",
                    "queue": len(machines[name].queue) if name in machines else 0,
                    "began": self._began.get(name, 0.0),
                    "free_at": machines[name].free_at if name in machines else 0.0,
                    "running": msgspec.to_builtins(machines[name].running) if name in machines else None,
                }
                for name in bars
            ],
        }


def _bar(record: PrintRecord) -> dict[str, Any]:
    return {
        "order": record.task.order,
        "name": record.task.name,
        "priority": record.task.priority,
        "from": record.started,
        "setup": record.setup,
        "to": record.cleaned,
        "result": record.result,
    }
