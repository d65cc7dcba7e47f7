"""Which jobs are not done and neither printing nor waiting at a printer, from the orders and the fleet's state."""

from collections.abc import Iterator, Sequence
from typing import Final

import msgspec

from manufacturing.core.orders import Order, Task
from manufacturing.core.printer import STEP_S
from manufacturing.core.twins import FleetState, MachineState

SOON_S: Final = 2 * STEP_S
"""A printer whose work ends within this time gets more, so that it does not wait for the next step."""


class Backlog:
    """The jobs of some orders that no printer has.

    Args:
        orders: that have arrived.
        fleet: as the twins see it.
        recall: jobs that wait at printers count as if no printer had them.
    """

    def __init__(self, orders: Sequence[Order], fleet: FleetState, *, recall: bool = False) -> None:
        self._fleet = fleet
        self._attempts = {(one.order, one.number): one.attempts for one in fleet.tried}
        for machine in fleet.machines:
            if machine.alarm and machine.running is not None:
                job, attempts = machine.running.job, machine.running.attempt + 1
                self._attempts[job] = max(self._attempts.get(job, 0), attempts)
        self.placed = set(fleet.done)
        """Jobs that are done, printing or waiting."""
        for machine in fleet.machines:
            if machine.running is not None and not machine.alarm:
                self.placed.add(machine.running.job)
            if not recall:
                self.placed.update(task.job for task in machine.queue)
        counts: dict[int, int] = {}
        for order, _ in self.placed:
            counts[order] = counts.get(order, 0) + 1
        self.orders = [order for order in orders if counts.get(order.id, 0) < order.jobs]
        """Those with missing jobs."""
        self.untouched = [order for order in self.orders if order.id not in counts]
        """Those none of whose jobs is anywhere."""

    def tasks(self, order: Order) -> list[Task]:
        """Missing jobs of an order, with the number of the attempt."""
        return [
            order.task(number, self.attempts((order.id, number)))
            for number in range(order.jobs)
            if (order.id, number) not in self.placed
        ]

    def attempts(self, job: tuple[int, int]) -> int:
        """How often a job was tried without a good part; a print that is about to be aborted counts."""
        return self._attempts.get(job, 0)

    def anew(self, task: Task) -> Task:
        """A task of a plan that was made before, with the number of the attempt that it would be now."""
        return msgspec.structs.replace(task, attempt=max(task.attempt, self.attempts(task.job)))

    def again(self) -> Iterator[tuple[str, Task]]:
        """Missing jobs that were tried before, each with the machine of the last attempt."""
        by_id = {order.id: order for order in self.orders}
        for one in self._fleet.tried:
            order = by_id.get(one.order)
            if order is not None and (one.order, one.number) not in self.placed:
                yield one.machine, order.task(one.number, self.attempts((one.order, one.number)))


def hungry(fleet: FleetState) -> list[MachineState]:
    """Machines with an empty queue whose work is about to end, the one that is free first at the front."""
    found = [
        machine
        for machine in fleet.machines
        if not machine.queue and not machine.alarm and machine.free_at <= fleet.time + SOON_S
    ]
    return sorted(found, key=lambda machine: (machine.free_at, machine.machine))
