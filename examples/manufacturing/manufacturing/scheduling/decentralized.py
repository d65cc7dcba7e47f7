"""No centre: a printer whose queue is empty takes the next order whole, and knows nothing of the others."""

from collections.abc import Mapping, Sequence

from manufacturing.core.orders import Order, Task
from manufacturing.core.twins import FleetState
from manufacturing.scheduling.backlog import Backlog, hungry


class Decentralized:
    """See the first line; a ruined part is printed again by the same printer."""

    sensors = False

    def plan(self, orders: Sequence[Order], fleet: FleetState) -> Mapping[str, Sequence[Task]]:
        """As `Scheduler.plan`."""
        empty = hungry(fleet)
        if not empty and not fleet.tried:
            return {}
        backlog = Backlog(orders, fleet)
        wanted: dict[str, list[Task]] = {}
        queues = {machine.machine: list(machine.queue) for machine in fleet.machines}
        for name, task in backlog.again():
            wanted[name] = [task, *wanted.get(name, queues[name])]
        waiting = iter(backlog.untouched)
        for machine in empty:
            if machine.machine not in wanted and (order := next(waiting, None)) is not None:
                wanted[machine.machine] = backlog.tasks(order)
        return wanted
