"""The keys between the five apps, and what is written under them.

    key                                                       written by        value
    manufacturing.inventory.machine_assets                    Machine Assets    Inventory
    manufacturing.clock.data_driver                           Data Driver       SimulatedClock
    manufacturing.report.data_driver.<machine>                Data Driver       ReportMessage
    manufacturing.order.job_creator.<order>                   Job Creator       OrderMessage
    manufacturing.order_book.job_creator                      Job Creator       OrderBook
    manufacturing.fleet.digital_twins                         Digital Twins     FleetMessage
    manufacturing.machine_state.digital_twins.<machine>       Digital Twins     MachineState
    manufacturing.job_assignment.scheduler.<machine>          Job Scheduler     JobAssignment
    manufacturing.plan.scheduler                              Job Scheduler     PlanMessage

Simulated time moves in steps: the driver asks for the next one when the plan of this one is carried out.  Everything
names its run and its step, so that whoever was killed finds its place again, and what comes twice does no harm.
"""

from collections.abc import Callable, Mapping
from logging import Logger
from typing import Any, Final, TypeVar

import msgspec

from due import Item
from manufacturing.core.orders import Order, Task
from manufacturing.core.printer import Report
from manufacturing.core.twins import FleetState

INVENTORY: Final = "manufacturing.inventory.machine_assets"
CLOCK: Final = "manufacturing.clock.data_driver"
REPORT: Final = "manufacturing.report.data_driver"
ORDER: Final = "manufacturing.order.job_creator"
ORDER_BOOK: Final = "manufacturing.order_book.job_creator"
FLEET: Final = "manufacturing.fleet.digital_twins"
MACHINE: Final = "manufacturing.machine_state.digital_twins"
ASSIGNMENT: Final = "manufacturing.job_assignment.scheduler"
PLAN: Final = "manufacturing.plan.scheduler"

M = TypeVar("M", bound=msgspec.Struct)


class Inventory(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The printers that there are."""

    run: str
    """Identifies the run."""
    printers: Mapping[str, str]
    """Machine to the base URL of its REST interface."""


class SimulatedClock(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Simulated time has reached a step."""

    run: str
    step: int
    time: float
    """Simulated s after the start."""
    machines: tuple[str, ...]


class ReportMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a printer says of itself at a step."""

    run: str
    report: Report


class OrderMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One order."""

    run: str
    order: Order


class OrderBook(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many orders there are by a step, so that nobody plans before it has them all."""

    run: str
    step: int
    orders: int


class FleetMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fleet at a step."""

    run: str
    fleet: FleetState


class JobAssignment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the queue of one printer is to hold."""

    run: str
    step: int
    plan: str
    """Of which plan it is a part."""
    tasks: tuple[Task, ...]


class PlanMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which printers have a new assignment at a step; the others keep their queues."""

    run: str
    step: int
    plan: str
    machines: tuple[str, ...]


def to_value(message: msgspec.Struct) -> dict[str, Any]:
    """A message as a plain DUE value."""
    value: dict[str, Any] = msgspec.to_builtins(message)
    return value


def from_value(value: object, kind: type[M]) -> M:
    """A received value as a message; raises msgspec.ValidationError."""
    return msgspec.convert(value, kind)


def tolerant(handler: Callable[[Item], None], log: Logger) -> Callable[[Item], None]:
    """A handler that logs messages it does not understand, and goes on."""

    def handle(item: Item) -> None:
        try:
            handler(item)
        except msgspec.ValidationError as error:
            log.warning("%s is not understood: %s", item.key, error)

    return handle
