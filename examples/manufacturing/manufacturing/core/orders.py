"""Orders, jobs and the three scenarios, all from a seed.

    Scenario("ppe", seed=3) ──► orders(): regular ones and urgent ones, each with its time, kind, jobs and volume

An order is one part to be printed so many times; each copy is a job.  A kind is what a printer must be set up for:
material, print core and profile.  Orders are of many or few jobs, of small or large volumes, as in the paper.
"""

from typing import Final, Literal

import msgspec
import numpy as np

ScenarioName = Literal["normal", "anomalies", "ppe"]
SCENARIOS: Final[tuple[ScenarioName, ...]] = ("normal", "anomalies", "ppe")
HOUR: Final = 3_600.0
"""Seconds."""

SETUP_S: Final = (
    1200.0,
    1500.0,
    1800.0,
    1800.0,
    2100.0,
    2400.0,
    2400.0,
    2700.0,
    3000.0,
    3000.0,
    3300.0,
    3600.0,
)
"""Seconds to set a printer up for each kind of regular job: change material and print core, calibrate."""
PPE_SETUP_S: Final = (2400.0, 2400.0)
"""The same for the kinds of protective equipment, which follow the regular ones."""
ALL_SETUP_S: Final = SETUP_S + PPE_SETUP_S
NOZZLE_C: Final = (
    205.0,
    200.0,
    210.0,
    215.0,
    225.0,
    230.0,
    240.0,
    220.0,
    235.0,
    245.0,
    210.0,
    225.0,
    230.0,
    225.0,
)
"""Target temperature of the nozzle for each kind, °C."""

ORDERS: Final = 60
AT_ONCE: Final = 20
"""Orders that are there at the start; the others come within a working day."""
DAY_S: Final = 8 * HOUR
JOBS: Final = (2, 40)
VOLUME_CM3: Final = (4.0, 40.0)
PPE_ORDERS: Final = ((4 * HOUR, 60, 25.0), (6 * HOUR, 60, 8.0))
"""Time, jobs and cm³ of each order of protective equipment: headbands of face shields, then valves."""


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One part, to be printed `jobs` times."""

    id: int
    at: float
    """When it arrives, s after the start."""
    kind: int
    jobs: int
    volume: float
    """Of one copy, cm³."""
    priority: bool = False

    def task(self, number: int, attempt: int = 0) -> "Task":
        """One copy, for the first time or once more."""
        return Task(self.id, number, attempt, self.kind, self.volume, self.priority)


class Task(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One attempt to print one job."""

    order: int
    number: int
    attempt: int
    kind: int
    volume: float
    priority: bool = False

    @property
    def job(self) -> tuple[int, int]:
        """Which job it is, whatever the attempt."""
        return self.order, self.number

    @property
    def name(self) -> str:
        """Name at the printer, `o012-j003-a0`."""
        return f"o{self.order:03d}-j{self.number:03d}-a{self.attempt}"


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a run is about.  `orders` and `fraction` are for tests; measurements take the defaults."""

    name: ScenarioName
    seed: int
    machines: int
    orders: int = ORDERS
    fraction: float = 1.0
    """Of the jobs of each order, of urgent ones too."""

    def __post_init__(self) -> None:
        if not (1 <= self.machines <= 1_000 and 1 <= self.orders <= 10_000 and 0 < self.fraction <= 1):
            raise ValueError(
                f"machines={self.machines} (1 to 1000), orders={self.orders} (1 to 10000), "
                f"fraction={self.fraction} (above 0, up to 1)"
            )
        if self.seed < 0:
            raise ValueError(f"seed={self.seed}: 0 or more")

    @property
    def faults(self) -> bool:
        """Whether printers fail."""
        return self.name == "anomalies"

    def machine_names(self) -> tuple[str, ...]:
        """`m00`, `m01`, …"""
        return tuple(f"m{number:02d}" for number in range(self.machines))

    def book(self) -> tuple[Order, ...]:
        """All orders by time; those of one seed are the same for every fleet and every scheduler."""
        random = np.random.default_rng((self.seed, 1))
        at_once = round(self.orders * AT_ONCE / ORDERS)
        times = np.concatenate((np.zeros(at_once), np.sort(random.uniform(0, DAY_S, self.orders - at_once))))
        kinds = random.integers(0, len(SETUP_S), self.orders)
        jobs = np.exp(random.uniform(np.log(JOBS[0]), np.log(JOBS[1]), self.orders))
        volumes = np.exp(random.uniform(np.log(VOLUME_CM3[0]), np.log(VOLUME_CM3[1]), self.orders))
        found = [
            Order(0, round(float(at), 1), int(kind), self._some(float(n)), round(float(cm3), 2))
            for at, kind, n, cm3 in zip(times, kinds, jobs, volumes, strict=True)
        ]
        if self.name == "ppe":
            found += [
                Order(0, at, len(SETUP_S) + place, self._some(n), cm3, priority=True)
                for place, (at, n, cm3) in enumerate(PPE_ORDERS)
            ]
        found.sort(key=lambda order: order.at)
        return tuple(msgspec.structs.replace(order, id=place) for place, order in enumerate(found))

    def _some(self, jobs: float) -> int:
        return max(1, round(jobs * self.fraction))
