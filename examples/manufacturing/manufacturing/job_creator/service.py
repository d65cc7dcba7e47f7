"""Simulated time in, orders out as they are due.

    manufacturing.clock.data_driver ──► JobCreator ──► manufacturing.order.job_creator.<order>
                                                  └──► manufacturing.order_book.job_creator

Orders follow from scenario and seed, so that one that comes again, after a restart or a repeated clock, is the same.
"""

import logging
import sys
from collections.abc import Sequence
from typing import Any

import msgspec

import due.service
from due import NO_WAIT, Capability, Engine, Interest, Item
from manufacturing.core.orders import ORDERS, Scenario, ScenarioName
from manufacturing.messages import (
    CLOCK,
    ORDER,
    ORDER_BOOK,
    OrderBook,
    OrderMessage,
    SimulatedClock,
    from_value,
    to_value,
    tolerant,
)

INTERESTS = (Interest(CLOCK),)
CAPABILITIES = (Capability(f"{ORDER}.*", archive="always"), Capability(ORDER_BOOK))

log = logging.getLogger("job_creator")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the job creator."""

    scenario: ScenarioName = "normal"
    seed: int = 0
    machines: int = 5
    orders: int = ORDERS
    fraction: float = 1.0
    """Of the jobs of each order."""


class JobCreatorService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._book = Scenario(
            name=settings.scenario,
            seed=settings.seed,
            machines=settings.machines,
            orders=settings.orders,
            fraction=settings.fraction,
        ).book()
        self._run = ""
        self._step, self._written = -1, 0

    def start(self) -> None:
        """Subscribe."""
        self._engine.observe(CLOCK).subscribe(tolerant(self._on_clock, log))

    def tick(self) -> None:
        """Nothing to do between messages."""

    def _on_clock(self, item: Item) -> None:
        clock = from_value(item.value, SimulatedClock)
        if clock.run != self._run or clock.step == self._step:  # somebody may have missed some
            self._run, self._written = clock.run, 0
        self._step = clock.step
        due_by_now = sum(order.at <= clock.time for order in self._book)
        for order in self._book[self._written : due_by_now]:
            self._engine.write(f"{ORDER}.{order.id}", to_value(OrderMessage(self._run, order)), [NO_WAIT])
        self._written = due_by_now
        book = OrderBook(self._run, clock.step, due_by_now)
        self._engine.write(ORDER_BOOK, to_value(book), [NO_WAIT])

    def stop(self) -> None:
        """Nothing is left to write."""

    def health(self) -> dict[str, Any]:
        """Orders so far."""
        return {"orders": self._written, "step": self._step}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the app until a signal ends it."""
    return due.service.run("job_creator", JobCreatorService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
