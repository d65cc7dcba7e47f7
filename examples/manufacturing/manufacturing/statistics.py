"""All cells of the comparison from the pure cores: scenario by scheduler by fleet by seed, kept in a file as they come.

    cells() ──► processes ──► RESULTS.jsonl ──► CellTable ──► criteria, figures

A run that was cut short goes on where it stopped.
"""

import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import msgspec

from manufacturing.core.orders import SCENARIOS, Scenario, ScenarioName
from manufacturing.core.simulation import simulate
from manufacturing.criteria import FLEETS, NORMAL_FLEET, Cells
from manufacturing.scheduling import SCHEDULERS, SchedulerName, scheduler
from manufacturing.scheduling.bound import makespan_bound

BOUND: str = "bound"
"""Stands in a cell for the lower bound."""


class CellResult(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated scenario; times in s."""

    scenario: ScenarioName
    scheduler: str
    """Or `BOUND`."""
    machines: int
    seed: int
    makespan: float
    ppe_makespan: float = 0.0
    faults: int = 0
    ruined: int = 0
    alarms: int = 0
    false_alarms: int = 0
    setups: int = 0
    prints: int = 0

    @property
    def cell(self) -> tuple[str, str, int, int]:
        """Which cell it is."""
        return self.scenario, self.scheduler, self.machines, self.seed


def cells(seeds: int, fleets: Sequence[int] = FLEETS) -> list[tuple[ScenarioName, str, int, int]]:
    """All cells, seed by seed, so that a run that is cut short has whole seeds; bounds of the normal scenario too."""
    found: list[tuple[ScenarioName, str, int, int]] = []
    for seed in range(seeds):
        found += [(kind, name, n, seed) for kind in SCENARIOS for name in SCHEDULERS for n in fleets]
        if NORMAL_FLEET in fleets:
            found.append(("normal", BOUND, NORMAL_FLEET, seed))
    return found


def measure(kind: ScenarioName, name: str, machines: int, seed: int) -> CellResult:
    """Simulate one cell."""
    scenario = Scenario(name=kind, seed=seed, machines=machines)
    if name == BOUND:
        seconds = makespan_bound(scenario).seconds
        return CellResult(scenario=kind, scheduler=name, machines=machines, seed=seed, makespan=seconds)
    chosen: SchedulerName = msgspec.convert(name, SchedulerName)
    outcome = simulate(scenario, scheduler(chosen))
    return CellResult(
        scenario=kind,
        scheduler=name,
        machines=machines,
        seed=seed,
        makespan=outcome.makespan,
        ppe_makespan=outcome.ppe_makespan,
        faults=outcome.faults,
        ruined=outcome.ruined,
        alarms=outcome.alarms,
        false_alarms=outcome.false_alarms,
        setups=outcome.setups,
        prints=sum(map(len, outcome.prints.values())),
    )


class CellTable:
    """Results by cell, in a file of JSON lines.

    Args:
        path: the file; what it holds already is not simulated again.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._results: dict[tuple[str, str, int, int], CellResult] = {}
        if path.exists():
            for line in path.read_bytes().splitlines():
                result = msgspec.json.decode(line, type=CellResult)
                self._results[result.cell] = result

    def __iter__(self) -> Iterator[CellResult]:
        return iter(self._results.values())

    def fill(self, seeds: int, fleets: Sequence[int], *, workers: int = 1, minutes: float = 0.0) -> bool:
        """Simulate what is missing.

        Args:
            seeds: 0 to this number, exclusive.
            fleets: sizes.
            workers: processes.
            minutes: after which no more cells are begun; 0: no limit.

        Returns:
            Whether all cells are there.
        """
        missing = [cell for cell in cells(seeds, fleets) if cell not in self._results]
        end = time.monotonic() + minutes * 60 if minutes else float("inf")
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with (
            ProcessPoolExecutor(workers, initializer=os.nice, initargs=(10,)) as pool,
            self._path.open("ab") as file,
        ):
            while missing and time.monotonic() < end:
                some, missing = missing[: workers * 4], missing[workers * 4 :]
                for done in as_completed([pool.submit(measure, *cell) for cell in some]):
                    result = done.result()
                    self._results[result.cell] = result
                    file.write(msgspec.json.encode(result) + b"\n")
                    file.flush()
        return not missing

    def whole_seeds(self, fleets: Sequence[int]) -> int:
        """How many seeds, from 0 on, have all their cells."""
        seed = 0
        wanted = [cell[:3] for cell in cells(1, fleets)]
        while all((*cell, seed) in self._results for cell in wanted):
            seed += 1
        return seed

    def figures(self, seeds: int) -> tuple[Cells, Cells, Mapping[int, float]]:
        """Makespans, urgent makespans and bounds of the first `seeds` seeds, as the criteria take them."""
        some = [result for result in self._results.values() if result.seed < seeds]
        return (
            _table((result, result.makespan) for result in some if result.scheduler != BOUND),
            _table((result, result.ppe_makespan) for result in some if result.scenario == "ppe"),
            {result.seed: result.makespan for result in some if result.scheduler == BOUND},
        )


def _table(values: Iterable[tuple[CellResult, float]]) -> Cells:
    found: dict[tuple[str, str, int], dict[int, float]] = {}
    for result, value in values:
        found.setdefault((result.scenario, result.scheduler, result.machines), {})[result.seed] = value
    return found
