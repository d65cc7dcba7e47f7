"""One seed of each cell through REST, DUE and Coordinator, held against the pure simulation; kept as they come.

scenario, scheduler, fleet ──► ProcessProduction ──► prints ═══ simulate(...).prints?
"""

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Final

import msgspec

from manufacturing.core.orders import SCENARIOS, Scenario, ScenarioName
from manufacturing.core.printer import PrintRecord
from manufacturing.core.simulation import simulate
from manufacturing.running.in_process import InProcessProduction
from manufacturing.running.processes import ProcessProduction
from manufacturing.running.watcher import Stalled
from manufacturing.scheduling import SCHEDULERS, SchedulerName, scheduler

STEP_S: Final = 180.0
"""Seconds of the wall clock that one step may take."""
MOST_S: Final = 4 * 3_600.0
"""Seconds of the wall clock that one run may take."""

Prints = Mapping[str, Sequence[PrintRecord]]
Production = type[InProcessProduction] | type[ProcessProduction]


class VerifiedCell(msgspec.Struct, frozen=True, kw_only=True):
    """One scenario that went through REST and DUE."""

    scenario: ScenarioName
    scheduler: SchedulerName
    machines: int
    same: bool
    """Whether every print was on the same machine at the same time as in the simulation."""
    prints: int
    seconds: float
    """Of the wall clock."""
    problem: str = ""
    """Why it did not end, or which print was another one; empty where all is the same."""

    @property
    def cell(self) -> tuple[str, str, int]:
        """Which cell it is."""
        return self.scenario, self.scheduler, self.machines


def verify(scenario: Scenario, name: SchedulerName, production: Production) -> VerifiedCell:
    """Run one cell; it never raises `Stalled`, but says so in the result.

    Args:
        scenario: with its seed and fleet.
        name: of the scheduler.
        production: in one process or as processes.
    """
    begun, problem = time.monotonic(), ""
    with production(scenario, name) as running:
        try:
            running.watcher.wait_done(STEP_S, MOST_S)
        except Stalled as error:
            problem = str(error)
        prints = running.watcher.prints()
    problem = problem or _first_difference(simulate(scenario, scheduler(name)).prints, prints)
    return VerifiedCell(
        scenario=scenario.name,
        scheduler=name,
        machines=scenario.machines,
        same=not problem,
        prints=sum(map(len, prints.values())),
        seconds=round(time.monotonic() - begun, 1),
        problem=problem,
    )


def _first_difference(wanted: Prints, found: Prints) -> str:
    """The earliest print that is not as it was simulated; empty: there is none."""
    places: list[tuple[float, str, PrintRecord | None, PrintRecord | None]] = []
    for machine in sorted({*wanted, *found}):
        for one, other in zip_longest(wanted.get(machine, ()), found.get(machine, ())):
            if one != other:
                start = min(each.started for each in (one, other) if each is not None)
                places.append((start, machine, one, other))
                break
    if not places:
        return ""
    _, machine, one, other = min(places, key=lambda place: place[:2])
    return f"another schedule: on {machine} simulated {_described(one)}, found {_described(other)}"


def _described(record: PrintRecord | None) -> str:
    return f"job {record.task.name} from {record.started:.0f} s" if record is not None else "no print"


def verify_all(
    scenarios: Callable[[ScenarioName, int], Scenario],
    fleets: Sequence[int],
    path: Path,
    *,
    production: Production = ProcessProduction,
    minutes: float = 0.0,
    tell: Callable[[VerifiedCell], None],
) -> tuple[list[VerifiedCell], int]:
    """Run the cells that a file of JSON lines does not hold yet, small fleets first.

    Args:
        scenarios: makes the scenario of a name and a number of printers.
        fleets: sizes.
        path: the file.
        production: in one process or as processes.
        minutes: after which no more cells are begun; 0: no limit.
        tell: called with each new cell.

    Returns:
        All cells so far, and how many are missing.
    """
    lines = path.read_bytes().splitlines() if path.exists() else []
    found = [msgspec.json.decode(line, type=VerifiedCell) for line in lines]
    known = {one.cell for one in found}
    wanted = [(kind, name, n) for n in sorted(fleets) for kind in SCENARIOS for name in SCHEDULERS]
    missing = [cell for cell in wanted if cell not in known]
    end = time.monotonic() + minutes * 60 if minutes else float("inf")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        while missing and time.monotonic() < end:
            kind, name, machines = missing.pop(0)
            one = verify(scenarios(kind, machines), name, production)
            found.append(one)
            file.write(msgspec.json.encode(one) + b"\n")
            file.flush()
            tell(one)
    return found, len(missing)
