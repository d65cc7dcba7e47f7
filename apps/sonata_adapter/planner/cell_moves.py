"""Which queries get other cells, because the keys that they have need more.  Pure.

cells cannot grow in place: a key is where its hash says, and would be counted twice

there is room    ─► a second count with more cells beside the first, until a window is over (`moves`)
there is none    ─► the query, and such as have more cells than they need, go to the host for some windows
                    and come back, each to cells by its need
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

import msgspec

from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.conditions import disjoint
from apps.sonata_adapter.planner.moves import LEAST_GAIN, Side, improvements, movable
from apps.sonata_adapter.planner.placement import CROWDED, StageEntry, SwitchLimits
from apps.sonata_adapter.planner.plan import QueryPlan, QueryPlans, copies_saved, crowded, plan
from apps.sonata_adapter.planner.rates import MeasuredRates

_TWIN: Final = " (more cells)"
_DETOUR: Final = 15.0
"""By so much the copies of a way over the host may exceed what is saved: it takes about twenty seconds, and must pay
twice within ten minutes."""
_MOST: Final = 2
"""Queries with too few cells that are looked at a time, since each takes plans."""
_MOST_SPARING: Final = 4
"""Queries that make room at a time."""


def better_places(
    counts: Iterable[QueryRequest],
    limits: SwitchLimits,
    present: QueryPlans,
    rates: MeasuredRates,
    resting: Sequence[int] = (),
) -> dict[str, Side]:
    """Counts that should move: to where they save most, and then to as many cells as their keys need.

    Arguments as of `moves.improvements`; none of the counts moves now.
    """
    every = list(counts)
    found = improvements(every, limits, present, rates, resting)
    return found or _more_cells(every, limits, present, rates, resting)


def _more_cells(
    counts: Iterable[QueryRequest],
    limits: SwitchLimits,
    present: QueryPlans,
    rates: MeasuredRates,
    resting: Sequence[int],
) -> dict[str, Side]:
    """Counts that should move so that keys get the cells that they need, by identity.

    `switch` for one that gets a second count in the switch; `host` for those that go there to come back.
    """
    wanted = {one.identity: one for one in counts}
    needy = _needy(wanted, limits, present, rates)
    for identity in needy:
        twin = msgspec.structs.replace(wanted[identity], identity=identity + _TWIN)
        trial = plan([*wanted.values(), twin], limits, before=present, resting=resting, rates=rates)
        if _is_roomier(present.of(identity), trial.of(twin.identity), limits, rates):
            return {identity: "switch"}
    free = {name: msgspec.structs.replace(one, on_host=False) for name, one in wanted.items()}
    saved = {
        name: copies_saved(one, limits, rates)
        for name, one in free.items()
        if movable(one) and not present.of(name).in_switch
    }
    waiting = sorted(saved, key=lambda name: (-saved[name], name))
    for identity in (*needy, *waiting[:1]):
        for goes in _leaving(identity, free, limits, present, rates):
            if not _pays(identity, goes, free, limits, present, rates):
                break
            rest = QueryPlans(
                tuple(one for one in present.queries if one.identity not in goes), present.copies
            )
            trial = plan(list(free.values()), limits, before=rest, resting=resting, rates=rates)
            if _is_better(identity, present, trial, limits, rates):
                return dict.fromkeys(goes, "host")
    return {}


def _needy(
    wanted: Mapping[str, QueryRequest], limits: SwitchLimits, present: QueryPlans, rates: MeasuredRates
) -> list[str]:
    """Queries with too few cells, those with most reports of keys without one first."""
    gains = {}
    for name, one in wanted.items():
        tight = crowded(present.of(name), rates.cells, limits) if movable(one) else []
        gain = rates.cells.without_cell(tight)
        if gain >= LEAST_GAIN:
            gains[name] = gain
    return sorted(gains, key=lambda name: (-gains[name], name))[:_MOST]


def _leaving(
    identity: str,
    free: Mapping[str, QueryRequest],
    limits: SwitchLimits,
    present: QueryPlans,
    rates: MeasuredRates,
) -> Iterator[set[str]]:
    """Queries that might go to the host for a while, so that one gets room: itself, and such as could do with less."""
    mine = {identity} if present.of(identity).in_switch else set()
    spare = {
        name: copies_saved(one, limits, rates)
        for name, one in free.items()
        if name != identity and movable(one) and _could_spare(present.of(name), rates)
    }
    others = sorted(spare, key=lambda name: (spare[name], name))[:_MOST_SPARING]
    yield from (mine | set(others[:number]) for number in range(len(others) + 1) if mine or number)


def _could_spare(one: QueryPlan, rates: MeasuredRates) -> bool:
    """Whether half of the cells of an entry were enough for minutes."""
    enough = [(entry.size, rates.cells.enough(entry)) for entry in one.entries if entry.has_cells]
    return any(cells is not None and CROWDED * cells <= size for size, cells in enough)


def _is_better(
    identity: str, present: QueryPlans, trial: QueryPlans, limits: SwitchLimits, rates: MeasuredRates
) -> bool:
    """Whether nothing leaves the switch, nobody is crowded who was not, and one query gets what it needs."""
    for old in present.queries:
        new = trial.of(old.identity)
        if old.in_switch and not new.in_switch:
            return False
        if len(crowded(new, rates.cells, limits)) > len(crowded(old, rates.cells, limits)) and old.in_switch:
            return False
    old, new = present.of(identity), trial.of(identity)
    return new.in_switch and (not old.in_switch or _is_roomier(old, new, limits, rates))


def _is_roomier(old: QueryPlan, new: QueryPlan, limits: SwitchLimits, rates: MeasuredRates) -> bool:
    """Whether each count that has too few cells has at least half as many again in another plan."""
    return new.in_switch and all(
        2 * _cells(entry, new) >= 3 * entry.size for entry in crowded(old, rates.cells, limits)
    )


def _cells(entry: StageEntry, one: QueryPlan) -> int:
    """Cells for what an entry counts, which may be in two parts."""
    return sum(
        other.size
        for other in one.entries
        if (other.role, other.source, other.masks) == (entry.role, entry.source, entry.masks)
        and not disjoint(other.match, entry.match)
        and other.has_cells
    )


def _pays(
    identity: str,
    goes: set[str],
    free: Mapping[str, QueryRequest],
    limits: SwitchLimits,
    present: QueryPlans,
    rates: MeasuredRates,
) -> bool:
    """Whether a way over the host costs little beside what it saves."""
    inside = present.of(identity).in_switch
    gain = (
        rates.cells.without_cell(present.of(identity).entries)
        if inside
        else copies_saved(free[identity], limits, rates)
    )
    loss = sum(copies_saved(free[name], limits, rates) for name in goes)
    return gain >= LEAST_GAIN and gain * _DETOUR >= loss
