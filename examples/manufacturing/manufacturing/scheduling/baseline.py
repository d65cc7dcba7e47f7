"""A centre without data of printers: it divides the jobs of each order evenly over all of them as it arrives."""

from collections.abc import Mapping, Sequence

from manufacturing.core.orders import Order, Task
from manufacturing.core.twins import FleetState
from manufacturing.scheduling.backlog import Backlog


class BaselineScheduler:
    """See the first line; a ruined part is printed again by the same printer."""

    sensors = False

    def __init__(self) -> None:
        self._divided = 0

    def plan(self, orders: Sequence[Order], fleet: FleetState) -> Mapping[str, Sequence[Task]]:
        """As `Scheduler.plan`; the n-th job of all goes to printer n modulo their number."""
        if len(orders) == self._divided and not fleet.tried:
            return {}
        self._divided = len(orders)
        backlog = Backlog(orders, fleet)
        names = [machine.machine for machine in fleet.machines]
        queues = {machine.machine: list(machine.queue) for machine in fleet.machines}
        wanted: dict[str, list[Task]] = {}
        for machine, task in backlog.again():
            wanted[machine] = [task, *wanted.get(machine, queues[machine])]
        before = 0
        missing = {order.id for order in backlog.orders}
        for order in orders:
            if order.id in missing:
                for task in backlog.tasks(order):
                    if not task.attempt:
                        name = names[(before + task.number) % len(names)]
                        wanted.setdefault(name, queues[name]).append(task)
            before += order.jobs
        return wanted
