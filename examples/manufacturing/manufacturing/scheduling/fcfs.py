"""A centre with twins, first come, first served: the next job goes to the printer that is free first."""

from collections.abc import Iterator, Mapping, Sequence

from manufacturing.core.orders import Order, Task
from manufacturing.core.twins import FleetState
from manufacturing.scheduling.backlog import Backlog, hungry


class FirstComeFirstServed:
    """See the first line; a job that came to nothing is the next one."""

    sensors = True

    def plan(self, orders: Sequence[Order], fleet: FleetState) -> Mapping[str, Sequence[Task]]:
        """As `Scheduler.plan`."""
        machines = hungry(fleet)
        if not machines:
            return {}
        waiting = _in_order(Backlog(orders, fleet))
        return {
            machine.machine: [task]
            for machine, task in zip(machines, waiting, strict=False)
            if task is not None
        }


def _in_order(backlog: Backlog) -> Iterator[Task]:
    again = [task for _, task in backlog.again()]
    yield from again
    tried = {task.job for task in again}
    for order in backlog.orders:
        yield from (task for task in backlog.tasks(order) if task.job not in tried)
