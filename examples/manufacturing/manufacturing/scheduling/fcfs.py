"""A centre with twins, first come, first served: the next job goes to the printer that is free first.

The paper's knows no priority.  The one that does is a fairer peer for urgent orders: it lets them go first, without
any planning.
"""

from collections.abc import Iterator, Mapping, Sequence

from manufacturing.core.orders import Order, Task
from manufacturing.core.twins import FleetState
from manufacturing.scheduling.backlog import Backlog, hungry


class FirstComeFirstServed:
    """See the first line; a job that came to nothing is the next one."""

    sensors = True
    urgent_first = False

    def plan(self, orders: Sequence[Order], fleet: FleetState) -> Mapping[str, Sequence[Task]]:
        """As `Scheduler.plan`."""
        machines = hungry(fleet)
        if not machines:
            return {}
        if self.urgent_first:
            orders = sorted(orders, key=lambda order: not order.priority)
        waiting = _in_order(Backlog(orders, fleet))
        return {
            machine.machine: [task]
            for machine, task in zip(machines, waiting, strict=False)
            if task is not None
        }


class UrgentFirst(FirstComeFirstServed):
    """First come, first served, but urgent orders before all others."""

    urgent_first = True


def _in_order(backlog: Backlog) -> Iterator[Task]:
    again = [task for _, task in backlog.again()]
    yield from again
    tried = {task.job for task in again}
    for order in backlog.orders:
        yield from (task for task in backlog.tasks(order) if task.job not in tried)
