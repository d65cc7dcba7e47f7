"""How many jobs of each order each printer prints, as an integer program.

    minimise   C + a little for each setup
    subject to every job is printed,
               a printer prints jobs of a kind only if it is set up for it,
               each printer's free time + its jobs + its setups <= C

Free time comes from the twins; the setup for what a printer is loaded with costs nothing.  A greedy division, level
by level, gives the pairs of kind and printer that the program may use, so that it stays small, and is the answer
where the program finds none.
"""

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

GAP: Final = 0.03
NODES: Final = 1
"""Nodes of the search tree after which the best division so far is taken: a limit that does not depend on the
machine, so that a schedule is the same everywhere.  `SECONDS` of the wall clock are for the worst case: a program takes
a few on an idle core, and a limit that struck on a busy one would make another schedule."""
SECONDS: Final = 100.0
_MORE: Final = 2
"""Printers for each kind beyond those of the greedy division."""
_SETUP_WEIGHT: Final = 0.02


class Lot(msgspec.Struct, frozen=True):
    """Jobs of one order to be divided."""

    kind: int
    jobs: int
    seconds: float
    """Of one job, as planned."""


class Slot(msgspec.Struct, frozen=True):
    """One printer."""

    free_at: float
    """Seconds from now."""
    loaded: int


class Division(msgspec.Struct, frozen=True):
    """What was found."""

    jobs: NDArray[np.int64]
    """Shape (lots, slots)."""
    solved: bool
    """False: the greedy division."""


def divide(lots: Sequence[Lot], slots: Sequence[Slot], setups: Sequence[float]) -> Division:
    """Divide jobs so that the last printer ends early and few setups are needed.

    Args:
        lots: at least one.
        slots: at least one.
        setups: seconds by kind.
    """
    greedy = _greedy(lots, slots, setups)
    found = _program(lots, slots, setups, _pairs(lots, slots, setups, greedy))
    if found is None or _finish(found, lots, slots, setups) > _finish(greedy, lots, slots, setups):
        return Division(greedy, solved=False)
    return Division(found, solved=True)


def loads(
    jobs: NDArray[np.int64], lots: Sequence[Lot], slots: Sequence[Slot], setups: Sequence[float]
) -> NDArray[np.float64]:
    """When each printer ends, s from now, shape (slots,)."""
    found = np.array([slot.free_at for slot in slots])
    found += np.array([lot.seconds for lot in lots]) @ jobs
    for place, slot in enumerate(slots):
        kinds = {lot.kind for lot, n in zip(lots, jobs[:, place], strict=True) if n}
        found[place] += sum(setups[kind] for kind in kinds - {slot.loaded})
    return found


def _finish(
    jobs: NDArray[np.int64], lots: Sequence[Lot], slots: Sequence[Slot], setups: Sequence[float]
) -> float:
    return float(loads(jobs, lots, slots, setups).max())


def _greedy(lots: Sequence[Lot], slots: Sequence[Slot], setups: Sequence[float]) -> NDArray[np.int64]:
    """Kind by kind, the most work first: fill printers up to the level at which all would end together."""
    work: dict[int, float] = {}
    for lot in lots:
        work[lot.kind] = work.get(lot.kind, 0.0) + lot.jobs * lot.seconds
    ends = np.array([slot.free_at for slot in slots])
    level = (ends.sum() + sum(work.values()) + sum(setups[kind] for kind in work)) / len(slots)
    kinds_at: list[set[int]] = [{slot.loaded} for slot in slots]
    jobs = np.zeros((len(lots), len(slots)), dtype=np.int64)
    for kind in sorted(work, key=lambda kind: (-work[kind], kind)):
        mine = sorted(
            (place for place, lot in enumerate(lots) if lot.kind == kind), key=lambda p: -lots[p].seconds
        )
        at = -1
        for place in mine:
            for _ in range(lots[place].jobs):
                seconds = lots[place].seconds
                if at < 0 or ends[at] + seconds / 2 > level:
                    costs = [
                        ends[m] + (0.0 if kind in kinds_at[m] else setups[kind]) for m in range(len(slots))
                    ]
                    at = int(np.argmin(costs))
                if kind not in kinds_at[at]:
                    kinds_at[at].add(kind)
                    ends[at] += setups[kind]
                ends[at] += seconds
                jobs[place, at] += 1
    return jobs


def _pairs(
    lots: Sequence[Lot], slots: Sequence[Slot], setups: Sequence[float], greedy: NDArray[np.int64]
) -> list[tuple[int, int]]:
    """Pairs of kind and printer that the program may use."""
    pairs = {(lots[place].kind, int(m)) for place, m in np.argwhere(greedy > 0)}
    kinds = sorted({lot.kind for lot in lots})
    pairs |= {(slot.loaded, m) for m, slot in enumerate(slots) if slot.loaded in kinds}
    early = np.argsort(loads(greedy, lots, slots, setups), kind="stable")
    for kind in kinds:
        pairs |= {(kind, int(m)) for m in [m for m in early if (kind, int(m)) not in pairs][:_MORE]}
    return sorted(pairs)


def _program(
    lots: Sequence[Lot], slots: Sequence[Slot], setups: Sequence[float], pairs: Sequence[tuple[int, int]]
) -> NDArray[np.int64] | None:
    uses = [
        (place, m, at)
        for at, (kind, m) in enumerate(pairs)
        for place, lot in enumerate(lots)
        if lot.kind == kind
    ]
    n, y = len(uses), len(pairs)
    size = n + y + 1
    cells: list[tuple[int, int, float]] = []
    for column, (place, m, at) in enumerate(uses):
        cells += [(place, column, 1.0), (len(lots) + m, column, lots[place].seconds)]
        cells += [(len(lots) + len(slots) + column, column, 1.0)]
        cells += [(len(lots) + len(slots) + column, n + at, -float(lots[place].jobs))]
    for at, (kind, m) in enumerate(pairs):
        if slots[m].loaded != kind:
            cells.append((len(lots) + m, n + at, setups[kind]))
    cells += [(len(lots) + m, size - 1, -1.0) for m in range(len(slots))]
    rows, columns, values = (np.array(part) for part in zip(*cells, strict=True))
    matrix = coo_array((values, (rows.astype(int), columns.astype(int))), (len(lots) + len(slots) + n, size))
    counts = np.array([lot.jobs for lot in lots], dtype=float)
    free = np.array([slot.free_at for slot in slots])
    low = np.concatenate((counts, np.full(len(slots) + n, -np.inf)))
    high = np.concatenate((counts, -free, np.zeros(n)))
    cost = np.zeros(size)
    cost[-1] = 1.0
    cost[n:-1] = [0.0 if slots[m].loaded == kind else _SETUP_WEIGHT * setups[kind] for kind, m in pairs]
    most = np.concatenate((counts[[place for place, _, _ in uses]], np.ones(y), [np.inf]))
    result = milp(
        cost,
        constraints=LinearConstraint(matrix.tocsr(), low, high),
        integrality=np.concatenate((np.ones(n + y), [0])),
        bounds=Bounds(np.zeros(size), most),
        options={"mip_rel_gap": GAP, "node_limit": NODES, "time_limit": SECONDS},
    )
    if result.x is None:
        return None
    jobs = np.zeros((len(lots), len(slots)), dtype=np.int64)
    for column, (place, m, _) in enumerate(uses):
        jobs[place, m] = round(float(result.x[column]))
    return jobs
