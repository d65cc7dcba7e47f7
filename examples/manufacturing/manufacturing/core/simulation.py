"""A whole scenario in one process: the same printers, twins and schedulers that the apps wrap, without HTTP and DUE.

step k:  printers advance ──► reports ──► FleetTwin ──► Scheduler ──► queues as wanted ──► printers
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Protocol

import msgspec

from manufacturing.core.orders import Order, Scenario, Task
from manufacturing.core.printer import STEP_S, Printer, PrintRecord
from manufacturing.core.twins import FleetState, FleetTwin, TwinCounts

MOST_STEPS: Final = 20_000
"""A scenario that is not over by then has lost a job."""


class NotOver(Exception):
    """A scenario did not end; the text says which jobs are missing."""


class Scheduler(Protocol):
    """Says what each printer's queue should hold."""

    sensors: bool
    """Whether the fleet that it works with has twins that watch the sensors."""

    def plan(self, orders: Sequence[Order], fleet: FleetState) -> Mapping[str, Sequence[Task]]:
        """The wanted queue of each machine; machines that are not named keep theirs.

        Args:
            orders: all that have arrived, by time.
            fleet: as the twins see it.
        """
        ...


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """How a scenario went."""

    prints: Mapping[str, tuple[PrintRecord, ...]]
    """By machine, all that ended, in order."""
    makespan: float
    """When the last job was done, s."""
    ppe_makespan: float
    """From the first urgent order to the end of the last urgent job, s; 0 without any."""
    faults: int
    ruined: int
    """Prints that were ruined by faults and went on to their end: what was missed."""
    aborted: int
    alarms: int
    false_alarms: int
    """Alarms of printers without a fault."""
    setups: int


def reconcile(waiting: Sequence[Task], wanted: Sequence[Task]) -> tuple[list[str], list[tuple[int, Task]]]:
    """What to withdraw and what to add, with its place, so that a queue holds what is wanted.

    A job that waits at another place than wanted is withdrawn and added again.
    """
    names = [task.name for task in wanted]
    kept = [task.name for task in waiting if task.name in set(names)]
    if kept != [name for name in names if name in set(kept)]:
        kept = []
    withdraw = [task.name for task in waiting if task.name not in set(kept)]
    add = [(place, task) for place, task in enumerate(wanted) if task.name not in set(kept)]
    return withdraw, add


def simulate(scenario: Scenario, scheduler: Scheduler) -> Outcome:
    """Run a scenario to its end; raises NotOver."""
    book = scenario.book()
    names = scenario.machine_names()
    printers = [Printer(number, scenario.seed, faulty=scenario.faults) for number in range(len(names))]
    twins = FleetTwin(names, scenario.seed, sensors=scheduler.sensors)
    jobs = sum(order.jobs for order in book)
    false_alarms = 0
    for step in range(MOST_STEPS):
        time = step * STEP_S
        for printer in printers:
            printer.advance(time)
        fleet = twins.update([printer.report(step, sensors=scheduler.sensors) for printer in printers])
        if len(fleet.done) == jobs:
            return outcome(book, printers, twins.counts, false_alarms)
        for name in fleet.maintain:
            printer = printers[names.index(name)]
            false_alarms += not printer.broken
            printer.abort()
            printer.maintain()
        wanted = scheduler.plan([order for order in book if order.at <= time], fleet)
        for name, tasks in wanted.items():
            apply(printers[names.index(name)], tasks)
    raise NotOver(f"{jobs - len(fleet.done)} of {jobs} jobs are not done after {MOST_STEPS} steps")


def apply(printer: Printer, wanted: Sequence[Task]) -> None:
    """Make a printer's queue hold what is wanted; like the REST interface it leaves alone what it had before."""
    withdraw, add = reconcile(printer.queue, wanted)
    for name in withdraw:
        printer.withdraw(name)
    for place, task in add:
        if not printer.knows(task.name):
            printer.enqueue(task, place)


def outcome(
    book: Iterable[Order], printers: Sequence[Printer], counts: TwinCounts, false_alarms: int
) -> Outcome:
    """The figures of a scenario that is over."""
    records = [record for printer in printers for record in printer.history]
    good = [record for record in records if record.result == "Finished"]
    urgent = [order.at for order in book if order.priority]
    ppe = max((record.cleaned for record in good if record.task.priority), default=0.0)
    return Outcome(
        prints={printer.machine: tuple(printer.history) for printer in printers},
        makespan=max(record.cleaned for record in good),
        ppe_makespan=ppe - min(urgent) if urgent else 0.0,
        faults=sum(len(printer.faults_begun) for printer in printers),
        ruined=sum(printer.ruined for printer in printers),
        aborted=sum(record.result == "Aborted" for record in records),
        alarms=counts.alarms,
        false_alarms=false_alarms,
        setups=sum(record.setup > 0 for record in records),
    )
