"""A centre that plans with integer programs on the twins' data, on a rolling horizon.

    missing and waiting jobs ──► urgent ones first ──► then the others, behind them ──► each printer's sequence
                                                                                          └─► its next jobs

A plan covers all known jobs; printers get only the next ones of it, and what waits at a printer may be taken back.
It is made anew when urgent orders come, when a printer would run dry, two hours after it does not know of an order
or of a job that came to nothing, and after eight hours.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from manufacturing.core import process
from manufacturing.core.orders import ALL_SETUP_S, HOUR, Order, Task
from manufacturing.core.twins import FleetState, MachineState
from manufacturing.scheduling.backlog import SOON_S, Backlog
from manufacturing.scheduling.integer_program import Lot, Slot, divide, loads

AHEAD: Final = 2
"""Jobs of the plan that wait at a printer."""
AGAIN_S: Final = 2 * HOUR
"""A plan that does not know all orders, or not that a job is to be printed again, is made anew after so long ..."""
LONGEST_S: Final = 8 * HOUR
"""... and any plan after so long."""


class Dynamic:
    """See the first line."""

    sensors = True

    def __init__(self) -> None:
        self.programs = 0
        """Integer programs so far."""
        self.unsolved = 0
        """Those for which the greedy division was better, or the only one."""
        self._plan: dict[str, list[Task]] = {}
        self._made = float("-inf")
        self._known: tuple[int, int] = (0, 0)
        self._tried = 0

    def plan(self, orders: Sequence[Order], fleet: FleetState) -> Mapping[str, Sequence[Task]]:
        """As `Scheduler.plan`."""
        backlog = Backlog(orders, fleet, recall=True)
        if self._must(orders, fleet, backlog):
            self._make(orders, fleet, backlog)
        return self._next(fleet, backlog)

    def _must(self, orders: Sequence[Order], fleet: FleetState, backlog: Backlog) -> bool:
        if sum(order.priority for order in orders) > self._known[1]:
            return True
        age = fleet.time - self._made
        fresh = len(orders) > self._known[0] or _tries(fleet) > self._tried
        if (age >= AGAIN_S and fresh) or age >= LONGEST_S:
            return bool(backlog.orders)
        return self._dry(fleet, backlog, fresh=fresh)

    def _dry(self, fleet: FleetState, backlog: Backlog, *, fresh: bool) -> bool:
        """Whether a printer runs out of work while others have more than they begin soon."""
        left = {name: [t for t in tasks if t.job not in backlog.placed] for name, tasks in self._plan.items()}
        empty = [
            machine
            for machine in fleet.machines
            if not machine.alarm and not left.get(machine.machine) and machine.free_at <= fleet.time + SOON_S
        ]
        return bool(empty) and (fresh or any(len(tasks) > 1 for tasks in left.values()))

    def _make(self, orders: Sequence[Order], fleet: FleetState, backlog: Backlog) -> None:
        self._made = fleet.time
        self._known = (len(orders), sum(order.priority for order in orders))
        self._tried = _tries(fleet)
        slots = [Slot(machine.free_at - fleet.time, _loaded(machine)) for machine in fleet.machines]
        plan: list[list[Task]] = [[] for _ in slots]
        for urgent in (True, False):
            some = [order for order in backlog.orders if order.priority is urgent]
            if some:
                slots = self._share(some, backlog, slots, plan)
        self._plan = {machine.machine: tasks for machine, tasks in zip(fleet.machines, plan, strict=True)}

    def _share(
        self, orders: Sequence[Order], backlog: Backlog, slots: Sequence[Slot], plan: Sequence[list[Task]]
    ) -> list[Slot]:
        """Append these orders' jobs to the plan; returns the printers as they are behind them."""
        tasks = [backlog.tasks(order) for order in orders]
        lots = [Lot(some[0].kind, len(some), process.planned_s(some[0])) for some in tasks]
        found = divide(lots, slots, ALL_SETUP_S)
        self.programs += 1
        self.unsolved += not found.solved
        ends = loads(found.jobs, lots, slots, ALL_SETUP_S)
        behind: list[Slot] = []
        for place, slot in enumerate(slots):
            mine: list[Task] = []
            for some, jobs in zip(tasks, found.jobs[:, place], strict=True):
                mine += some[:jobs]
                del some[:jobs]
            mine = _sequence(mine, slot.loaded)
            plan[place].extend(mine)
            behind.append(Slot(float(ends[place]), mine[-1].kind if mine else slot.loaded))
        return behind

    def _next(self, fleet: FleetState, backlog: Backlog) -> dict[str, list[Task]]:
        """The next jobs of each printer's plan; one that fails gets none."""
        wanted: dict[str, list[Task]] = {}
        for machine in fleet.machines:
            planned = self._plan.get(machine.machine, ())
            tasks = [backlog.anew(task) for task in planned if task.job not in backlog.placed]
            self._plan[machine.machine] = tasks
            wanted[machine.machine] = [] if machine.alarm else tasks[:AHEAD]
        return wanted


def _tries(fleet: FleetState) -> int:
    """Attempts that came to nothing, of jobs that are not done."""
    return sum(one.attempts for one in fleet.tried)


def _loaded(machine: MachineState) -> int:
    return machine.running.kind if machine.running is not None else machine.loaded


def _sequence(tasks: Iterable[Task], loaded: int) -> list[Task]:
    """What the printer is set up for first, then the kind with the most work; of a kind the longest job first."""
    by_kind: dict[int, list[Task]] = {}
    for task in tasks:
        by_kind.setdefault(task.kind, []).append(task)
    work = {kind: sum(map(process.planned_s, some)) for kind, some in by_kind.items()}
    kinds = sorted(by_kind, key=lambda kind: (kind != loaded, -work[kind], kind))
    return [
        task
        for kind in kinds
        for task in sorted(by_kind[kind], key=lambda task: (-task.volume, task.order, task.number))
    ]
