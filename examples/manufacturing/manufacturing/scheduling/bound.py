"""What no schedule of a scenario without faults can beat, with everything known in advance.

The largest of three lower bounds of the makespan:
    longest  the longest job behind its arrival and its setup
    work     for each arrival: what arrives from then on, divided evenly, with the least setups
    program  an integer program for setups with work that may be divided at will; where it does not end in time, the
             bound of its search tree, which is valid all the same
Printing times are those that turn out, noise included; heat-up and arrivals within the program are left out.
"""

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from manufacturing.core import process
from manufacturing.core.orders import ALL_SETUP_S, Order, Scenario

SECONDS: Final = 20.0
"""For the integer program."""


class LowerBound(msgspec.Struct, frozen=True):
    """Seconds that every schedule takes, and which of the three bounds says so."""

    seconds: float
    by: str
    optimal: bool
    """Whether the integer program was solved to the end."""


def makespan_bound(scenario: Scenario, seconds: float = SECONDS) -> LowerBound:
    """The lower bound of the makespan.

    Args:
        scenario: its faults are left out, which makes the bound lower but not wrong.
        seconds: for the integer program.
    """
    book = scenario.book()
    work = {order.id: _work(scenario, order) for order in book}
    program, optimal = _program(_by_kind(book, work), scenario.machines, seconds)
    found = {
        "longest": max(
            order.at + ALL_SETUP_S[order.kind] * (order.at == 0) + longest
            for order in book
            for longest in [max(_jobs(scenario, order))]
        ),
        "work": max(_released_from(at, book, work, scenario.machines) for at in {order.at for order in book}),
        "program": program,
    }
    by = max(found, key=lambda name: found[name])
    return LowerBound(found[by], by, optimal)


def _jobs(scenario: Scenario, order: Order) -> list[float]:
    """Seconds of each of its jobs as they turn out."""
    return [
        process.printing_s(scenario.seed, order.task(number)) + process.CLEAN_UP_S
        for number in range(order.jobs)
    ]


def _work(scenario: Scenario, order: Order) -> float:
    return sum(_jobs(scenario, order))


def _by_kind(book: Sequence[Order], work: dict[int, float]) -> dict[int, float]:
    found: dict[int, float] = {}
    for order in book:
        found[order.kind] = found.get(order.kind, 0.0) + work[order.id]
    return found


def _released_from(at: float, book: Sequence[Order], work: dict[int, float], machines: int) -> float:
    """From the start each kind needs a setup, and each printer needs one or stands idle for as long."""
    later = [order for order in book if order.at >= at]
    total = sum(work[order.id] for order in later)
    if at == 0:
        kinds = {order.kind for order in later}
        setups = sum(ALL_SETUP_S[kind] for kind in kinds)
        total += setups + max(0, machines - len(kinds)) * min(ALL_SETUP_S[kind] for kind in kinds)
    return at + total / machines


def _program(work: dict[int, float], machines: int, seconds: float) -> tuple[float, bool]:
    """Least C with work[k, m] <= work[k] * set_up[k, m] and each printer's work and setups <= C."""
    kinds = sorted(work)
    pairs = [(k, m) for k in range(len(kinds)) for m in range(machines)]
    n = len(pairs)
    hours = np.array([work[kind] for kind in kinds]) / 3_600
    cells: list[tuple[int, int, float]] = []
    for at, (k, m) in enumerate(pairs):
        cells += [(k, at, 1.0), (len(kinds) + m, at, 1.0)]
        cells += [(len(kinds) + m, n + at, ALL_SETUP_S[kinds[k]] / 3_600)]
        cells += [
            (len(kinds) + machines + at, at, 1.0),
            (len(kinds) + machines + at, n + at, -float(hours[k])),
        ]
    cells += [(len(kinds) + m, 2 * n, -1.0) for m in range(machines)]
    rows, columns, values = (np.array(part) for part in zip(*cells, strict=True))
    matrix = coo_array(
        (values, (rows.astype(int), columns.astype(int))), (len(kinds) + machines + n, 2 * n + 1)
    )
    cost = np.zeros(2 * n + 1)
    cost[-1] = 1.0
    result = milp(
        cost,
        constraints=LinearConstraint(
            matrix.tocsr(),
            np.concatenate((hours, np.full(machines + n, -np.inf))),
            np.concatenate((hours, np.zeros(machines + n))),
        ),
        integrality=np.concatenate((np.zeros(n), np.ones(n), [0])),
        bounds=Bounds(np.zeros(2 * n + 1), np.concatenate((np.full(n, np.inf), np.ones(n), [np.inf]))),
        options={"mip_rel_gap": 0.001, "time_limit": seconds},
    )
    bound = result.mip_dual_bound
    return (float(bound) * 3_600 if bound is not None and np.isfinite(bound) else 0.0), result.status == 0
