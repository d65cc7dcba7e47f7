"""Which step the driver is at, and what it still waits for.  Pure.

    reports are out ──► fleet of this step ──► plan and all its assignments ──► carried out ──► next step

A fleet is carried out (maintenance) once for each step, also a late one; a plan only in its own step: it was made from
the queues of that step.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from manufacturing.core.orders import Task
from manufacturing.messages import FleetMessage, JobAssignment, PlanMessage

_REMEMBERED: Final = 64


class StepKeeper:
    """What has arrived for the present step."""

    def __init__(self, step: int) -> None:
        self.step = step
        self._maintained: dict[int, None] = {}
        self._fleet_here = False
        self._plan: PlanMessage | None = None
        self._assignments: dict[str, JobAssignment] = {}

    def fleet(self, message: FleetMessage) -> Sequence[str]:
        """Machines to be maintained now."""
        step = message.fleet.step
        self._fleet_here |= step == self.step
        if step > self.step or step in self._maintained:
            return ()
        self._maintained[step] = None
        while len(self._maintained) > _REMEMBERED:
            del self._maintained[next(iter(self._maintained))]
        return message.fleet.maintain

    def assignment(self, machine: str, message: JobAssignment) -> None:
        """One printer's queue as wanted."""
        if message.step == self.step:
            self._assignments[machine] = message

    def plan(self, message: PlanMessage) -> None:
        """Which assignments there are."""
        if message.step == self.step:
            self._plan = message

    def complete(self) -> Mapping[str, tuple[Task, ...]] | None:
        """The queues to be set, once everything of this step is here; None before."""
        plan = self._plan
        if plan is None or not self._fleet_here:
            return None
        found = {
            machine: part.tasks
            for machine, part in self._assignments.items()
            if machine in plan.machines and part.plan == plan.plan
        }
        return found if len(found) == len(plan.machines) else None

    def next(self) -> None:
        """Time has moved on."""
        self.step += 1
        self._fleet_here, self._plan = False, None
        self._assignments.clear()
