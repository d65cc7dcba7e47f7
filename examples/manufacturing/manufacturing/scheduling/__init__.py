"""The paper's four schedulers and one more, pure, and a bound that no schedule can beat.

    decentralized  a printer whose queue is empty takes the next order whole, knowing nothing of the others
    baseline       a centre divides the jobs of each order evenly over all printers as it arrives
    fcfs           a centre gives the next job, in order of arrival, to the printer that is free first
    urgent_first   fcfs that serves urgent orders first: not the paper's, a fairer peer where orders are urgent
    dynamic        a centre plans with integer programs on the twins' data, again and again

The first two know nothing of sensors: for them a fault is found with the ruined part.  All are without memory
that matters: what they need is in the orders and in the fleet's state, so that one that was killed goes on.
"""

from collections.abc import Callable, Mapping
from typing import Final, Literal, get_args

from manufacturing.core.simulation import Scheduler
from manufacturing.scheduling.baseline import BaselineScheduler
from manufacturing.scheduling.decentralized import Decentralized
from manufacturing.scheduling.dynamic import Dynamic
from manufacturing.scheduling.fcfs import FirstComeFirstServed, UrgentFirst

SchedulerName = Literal["decentralized", "baseline", "fcfs", "urgent_first", "dynamic"]
SCHEDULERS: Final[tuple[SchedulerName, ...]] = get_args(SchedulerName)
_MAKERS: Final[Mapping[str, Callable[[], Scheduler]]] = {
    "decentralized": Decentralized,
    "baseline": BaselineScheduler,
    "fcfs": FirstComeFirstServed,
    "urgent_first": UrgentFirst,
    "dynamic": Dynamic,
}


def scheduler(name: SchedulerName) -> Scheduler:
    """A new scheduler of this name; raises KeyError."""
    return _MAKERS[name]()
