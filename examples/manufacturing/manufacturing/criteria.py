"""When a finding of the paper counts as reproduced; committed before anything is measured.

    finding 10  normal:    central scheduling on twins shortens production
    finding 11  anomalies: it stays the best when printers fail
    finding 12  PPE:       urgent orders are done much sooner, and the rest not later

The paper's other schedulers ignore priority, so its PPE ratio measures overtaking above all.  `fairer` compares with a
first come, first served that lets urgent orders go first, by the same bars; it is reported beside finding 12.

Ratios are taken seed by seed and then averaged; a bar is compared with the mean, and the interval is shown beside it.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

FLEETS: Final = (5, 10, 20, 40)
SEEDS: Final = 20
NORMAL_FLEET: Final = 20
NORMAL_RATIO: Final = 0.7
"""Dynamic's makespan to Decentralized's, at 20 printers."""
BOUND_RATIO: Final = 1.1
"""Dynamic's makespan to the lower bound, at 20 printers."""
PPE_RATIO: Final = 0.67
"""Dynamic's makespan of urgent orders to that of the best of the others, at every fleet."""
FINAL_RATIO: Final = 1.02
"""Dynamic's final makespan with urgent orders to that of the best of the others, at every fleet."""

Cells = Mapping[tuple[str, str, int], Mapping[int, float]]
"""(scenario, scheduler, machines) to seed to seconds."""


class MeanRatio(msgspec.Struct, frozen=True):
    """A mean ratio with its interval of 95 %."""

    mean: float
    low: float
    high: float
    seeds: int


class Criterion(msgspec.Struct, frozen=True):
    """One criterion and how it came out."""

    finding: int
    says: str
    held: bool
    figures: Mapping[str, MeanRatio]
    bar: float


def mean_ratio(above: Mapping[int, float], below: Mapping[int, float]) -> MeanRatio:
    """Ratios seed by seed: mean and Student's interval."""
    from scipy.stats import t

    seeds = sorted(set(above) & set(below))
    ratios = np.array([above[seed] / below[seed] for seed in seeds])
    mean = float(ratios.mean())
    half = 0.0
    if len(ratios) > 1:
        half = float(t.ppf(0.975, len(ratios) - 1) * ratios.std(ddof=1) / np.sqrt(len(ratios)))
    return MeanRatio(mean, mean - half, mean + half, len(ratios))


def best_of(cells: Cells, scenario: str, others: Sequence[str], machines: int) -> Mapping[int, float]:
    """Of each seed, the least of several schedulers: the best one is not chosen once for all."""
    found = [cells[scenario, other, machines] for other in others]
    return {seed: min(of[seed] for of in found) for seed in found[0] if all(seed in of for of in found)}


def judge(
    final: Cells, ppe: Cells, bounds: Mapping[int, float], fleets: Sequence[int] = FLEETS
) -> tuple[Criterion, ...]:
    """All criteria.

    Args:
        final: makespans.
        ppe: makespans of urgent orders, for the scenario ppe.
        bounds: lower bound of the normal scenario at 20 printers by seed.
        fleets: sizes that were measured.
    """
    others = ("decentralized", "baseline", "fcfs")
    normal = mean_ratio(
        final["normal", "dynamic", NORMAL_FLEET], final["normal", "decentralized", NORMAL_FLEET]
    )
    to_bound = mean_ratio(final["normal", "dynamic", NORMAL_FLEET], bounds)
    failing = {
        f"{n}": mean_ratio(final["anomalies", "dynamic", n], best_of(final, "anomalies", others, n))
        for n in fleets
    }
    urgent = {f"{n}": mean_ratio(ppe["ppe", "dynamic", n], best_of(ppe, "ppe", others, n)) for n in fleets}
    whole = {f"{n}": mean_ratio(final["ppe", "dynamic", n], best_of(final, "ppe", others, n)) for n in fleets}
    return (
        _criterion(10, "normal: dynamic / decentralized at 20 printers", {"20": normal}, NORMAL_RATIO),
        _criterion(10, "normal: dynamic / lower bound at 20 printers", {"20": to_bound}, BOUND_RATIO),
        _criterion(11, "anomalies: dynamic / best of the others at every fleet", failing, 1.0),
        _criterion(12, "PPE: urgent makespan, dynamic / best of the others", urgent, PPE_RATIO),
        _criterion(12, "PPE: final makespan, dynamic / best of the others", whole, FINAL_RATIO),
    )


def fairer(final: Cells, ppe: Cells, fleets: Sequence[int] = FLEETS) -> tuple[Criterion, ...]:
    """Finding 12 against the scheduler that knows priority but does not plan; arguments as for `judge`."""
    found = []
    for says, cells, bar in (("urgent", ppe, PPE_RATIO), ("final", final, FINAL_RATIO)):
        figures = {
            f"{n}": mean_ratio(cells["ppe", "dynamic", n], cells["ppe", "urgent_first", n]) for n in fleets
        }
        found.append(_criterion(12, f"PPE: {says} makespan, dynamic / urgent_first", figures, bar))
    return tuple(found)


def _criterion(finding: int, says: str, figures: Mapping[str, MeanRatio], bar: float) -> Criterion:
    held = all(figure.mean <= bar for figure in figures.values())
    return Criterion(finding, says, held, figures, bar)
