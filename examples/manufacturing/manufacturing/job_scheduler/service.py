"""Orders and the fleet's state in, queues of printers out.

    manufacturing.order.job_creator.* ────┐
    manufacturing.order_book.job_creator ─┼──► Scheduler ──► manufacturing.job_assignment.scheduler.<machine>
    manufacturing.fleet.digital_twins ────┘             └──► manufacturing.plan.scheduler

A step is planned once, when its fleet and all its orders are here; a fleet that comes again gets the same plan again.
After a restart the orders come from the archive or anew, and what was printed is in the fleet's state.
"""

import logging
import sys
from collections.abc import Callable, Sequence
from typing import Any
from uuid import uuid4

import msgspec

import due.service
from due import NO_WAIT, Capability, Engine, Interest, Item
from manufacturing import scheduling
from manufacturing.core.orders import Order
from manufacturing.core.twins import FleetState
from manufacturing.messages import (
    ASSIGNMENT,
    FLEET,
    ORDER,
    ORDER_BOOK,
    PLAN,
    FleetMessage,
    JobAssignment,
    OrderBook,
    OrderMessage,
    PlanMessage,
    from_value,
    to_value,
    tolerant,
)

INTERESTS = (Interest(FLEET), Interest(f"{ORDER}.*"), Interest(ORDER_BOOK))
CAPABILITIES = (Capability(f"{ASSIGNMENT}.*", archive="always"), Capability(PLAN))

log = logging.getLogger("scheduler")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the scheduler."""

    scheduler: scheduling.SchedulerName = "dynamic"


class JobSchedulerService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine, self._name = engine, settings.scheduler
        self._forget("")

    def _forget(self, run: str) -> None:
        self._run = run
        self._scheduler = scheduling.scheduler(self._name)
        self._orders: dict[int, Order] = {}
        self._book: OrderBook | None = None
        self._fleet: FleetState | None = None
        self._planned = -1
        self._told: tuple[PlanMessage, dict[str, JobAssignment]] | None = None

    def start(self) -> None:
        """Subscribe."""
        handlers: dict[str, Callable[[Item], None]] = {
            FLEET: self._on_fleet,
            f"{ORDER}.*": self._on_order,
            ORDER_BOOK: self._on_book,
        }
        for key, handler in handlers.items():
            self._engine.observe(key).subscribe(tolerant(handler, log))

    def tick(self) -> None:
        """Nothing to do between messages."""

    def _of_run(self, run: str) -> None:
        if run != self._run:
            self._forget(run)

    def _on_order(self, item: Item) -> None:
        message = from_value(item.value, OrderMessage)
        self._of_run(message.run)
        self._orders[message.order.id] = message.order
        self._look()

    def _on_book(self, item: Item) -> None:
        book = from_value(item.value, OrderBook)
        self._of_run(book.run)
        self._book = book
        self._look()

    def _on_fleet(self, item: Item) -> None:
        message = from_value(item.value, FleetMessage)
        self._of_run(message.run)
        self._fleet = message.fleet
        if self._planned == message.fleet.step:
            self._tell()
        self._look()

    def _look(self) -> None:
        book, fleet = self._book, self._fleet
        if book is None or fleet is None or fleet.step <= self._planned or book.step != fleet.step:
            return
        orders = [self._orders[number] for number in range(book.orders) if number in self._orders]
        if len(orders) < book.orders:  # a repeated clock brings them again
            return
        wanted = self._scheduler.plan(orders, fleet)
        self._planned, plan = fleet.step, uuid4().hex[:12]
        self._told = (
            PlanMessage(self._run, fleet.step, plan, tuple(wanted)),
            {
                machine: JobAssignment(self._run, fleet.step, plan, tuple(tasks))
                for machine, tasks in wanted.items()
            },
        )
        self._tell()

    def _tell(self) -> None:
        if self._told is None:
            return
        plan, assignments = self._told
        for machine, assignment in assignments.items():
            self._engine.write(f"{ASSIGNMENT}.{machine}", to_value(assignment), [NO_WAIT])
        self._engine.write(PLAN, to_value(plan), [NO_WAIT])

    def stop(self) -> None:
        """Nothing is left to write."""

    def health(self) -> dict[str, Any]:
        """Step that was planned last, orders known."""
        return {"step": self._planned, "orders": len(self._orders)}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app until a signal ends it."""
    return due.service.run("scheduler", JobSchedulerService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
