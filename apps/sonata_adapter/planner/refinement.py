"""Iterative refinement: coarse prefixes first, then finer ones only below those that crossed.  Pure.

    ddos:refine=8/16/32 ─► counts by /8 of all packets
                               └ 10.0.0.0/8 crosses in window n ─► counts by /16 within it, at once and in n+1
                                     └ 10.1.0.0/16 crosses ─► addresses within it: results, under the key asked for

A prefix counts at least as much as each address in it, so that the query's own threshold loses none.  A
finer count leaves with the first window that its prefix has not crossed in.  An attack therefore has
results from its n-th window on, where n is the number of levels; nothing is reported that the query
without refinement would not report.

If the switch has no room for a coarse count, addresses are counted instead; if more
prefixes cross than `MOST`, addresses of all packets are counted until no coarse prefix crosses.
"""

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

import msgspec
import numpy as np

from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.plan import QueryPlans, plan
from apps.sonata_adapter.planner.rates import MeasuredRates
from apps.sonata_adapter.planner.refinement_levels import address_of, levels_of, narrowed, prefixes
from apps.sonata_adapter.results import QueryResult
from due import RecordBatch

MOST: Final = 16
"""Most prefixes below which one query counts at a time."""
_MARK: Final = " | "
"""Between a request's identity and what one of its counts is."""
_KEPT: Final = 4
"""Windows whose results are remembered, against one that comes of two counts."""
_REST_WINDOWS: Final = 2
"""For this long a bit that was given up is not given to another count: cells of its last window still carry it."""


class Crossings:
    """Prefixes of one coarse count that cross the threshold on one switch."""

    def __init__(self, request: QueryRequest, *, base_us: int = 0) -> None:
        self._address = address_of(request.query)
        self._level = request.coarse
        self._window_us = request.query.window_us
        self._base_us = base_us
        self._last: dict[str, int] = {}
        self.tuples = 0

    def take(self, bit: int, batch: RecordBatch) -> list[QueryResult]:  # noqa: ARG002 - as other reports
        """Note reports; a prefix without a cell is taken to have crossed."""
        self.tuples += len(batch)
        told = batch.take(np.flatnonzero((batch["crossed"] > 0) | (batch["overflow"] > 0)))
        for prefix, time_us in prefixes(told, self._address, self._level).items():
            self._last[prefix] = max(self._window(time_us), self._last.get(prefix, 0))
        return []

    def crossed(self, now_us: int | None) -> set[str]:
        """Prefixes that crossed in this window or the last one."""
        if now_us is not None:
            oldest = self._window(now_us) - 1
            self._last = {prefix: last for prefix, last in self._last.items() if last >= oldest}
        return set(self._last)

    def set_back(self, now_us: int) -> list[QueryResult]:  # noqa: ARG002 - as other reports
        """The switch's clock was set back: no prefix is taken to have crossed."""
        self._last.clear()
        return []

    def _window(self, time_us: int) -> int:
        return (time_us - self._base_us) // self._window_us


class RefinementCounts(NamedTuple):
    """The counts in force for the requests."""

    plan: QueryPlans
    by_identity: dict[str, QueryRequest]
    owners: dict[str, str]
    """Identity of each count that has results to that of the request whose they are."""


class _Resting(NamedTuple):
    bit: int
    until_us: dict[str, int]
    """By switch."""


class Refinement:
    """Chooses the counts for each request, and changes them when prefixes cross the threshold."""

    def __init__(self) -> None:
        self._crossed: dict[str, frozenset[str]] = {}
        """By identity of the coarse count."""
        self._wide: set[str] = set()
        """Requests for which addresses of all packets are counted: too many prefixes crossed."""
        self._no_room: set[str] = set()
        """Coarse counts that the switch has no room for, while what is above them crosses."""
        self._looked_at: set[str] = set()
        """Counts that were wanted, with room or without."""
        self._resting: list[_Resting] = []
        self._refined: dict[str, str] = {}
        """Counts in force of requests with levels, to their request."""
        self._seen: dict[tuple[int, str], dict[int, set[str]]] = {}

    @property
    def resting(self) -> list[int]:
        """Bits that are not given away yet."""
        return [each.bit for each in self._resting]

    def note(self, crossed: Mapping[str, Iterable[str]]) -> bool:
        """Prefixes that cross now, by identity of their count; returns whether the plan is to follow."""
        new = {identity: frozenset(found) for identity, found in crossed.items() if found}
        changed = new != self._crossed
        self._crossed = new
        return changed

    def planned(
        self,
        requests: Mapping[str, QueryRequest],
        limits: SwitchLimits,
        before: QueryPlans,
        clocks: Mapping[str, int | None],
        *,
        generation: int = 1,
        rates: MeasuredRates | None = None,
    ) -> RefinementCounts:
        """Counts for these requests and their plan; `clocks`: the time (us) that each switch has reached."""
        self._resting = [each for each in self._resting if _rests(each, clocks)]
        resting = [each.bit for each in self._resting]
        while True:
            self._looked_at.clear()
            counts = {request.identity: self._of(request) for request in requests.values()}
            found = {count.identity: count for each in counts.values() for count in each}
            made = plan(
                list(found.values()),
                limits,
                before=before,
                resting=resting,
                generation=generation,
                rates=rates,
            )
            failed = {
                each.identity for each in made.queries if found[each.identity].coarse and not each.in_switch
            }
            if not failed:
                break
            self._no_room |= failed
        self._rest(before, made, clocks)
        self._no_room &= self._looked_at
        self._seen = {place: seen for place, seen in self._seen.items() if place[1] in requests}
        self._refined = {
            count.identity: owner
            for owner, each in counts.items()
            for count in each
            if levels_of(requests[owner])
        }
        owners = {
            count.identity: owner for owner, each in counts.items() for count in each if not count.coarse
        }
        return RefinementCounts(made, found, owners)

    def is_first(self, switch: int, result: QueryResult) -> bool:
        """Whether no other count of the same request has reported this on a switch (any number for it)."""
        owner = self._refined.get(result.query)
        if owner is None:
            return True
        windows = self._seen.setdefault((switch, owner), {})
        seen = windows.setdefault(result.window_us, set())
        fields = str(sorted(result.fields.items()))
        first = fields not in seen
        seen.add(fields)
        while len(windows) > _KEPT:
            del windows[min(windows)]
        return first

    def set_back(self, name: str, switch: int, step_us: int) -> None:
        """The clock of a switch (`switch`: its number of `is_first`) was set back by `step_us`, at most 0."""
        self._seen = {place: seen for place, seen in self._seen.items() if place[0] != switch}
        for each in self._resting:
            if name in each.until_us:
                each.until_us[name] += step_us

    def _of(self, request: QueryRequest) -> list[QueryRequest]:
        """Counts for one request."""
        levels = levels_of(request)
        if not levels:
            return [request]
        first = coarsest(request)
        if not self._crossed.get(first.identity):
            self._wide.discard(request.identity)
        found = self._below(request, levels)
        if len(found) > MOST + 1 or request.identity in self._wide:
            self._wide.add(request.identity)
            return [first, _count(request, 0, "")]
        return found

    def _below(self, request: QueryRequest, levels: tuple[int, ...]) -> list[QueryRequest]:
        found: list[QueryRequest] = []
        within = [""]
        for level in levels:
            finer: list[str] = []
            for prefix in within:
                count = _count(request, level if level != levels[-1] else 0, prefix)
                self._looked_at.add(count.identity)
                if count.identity in self._no_room:
                    found.append(_count(request, 0, prefix))
                    continue
                found.append(count)
                finer += sorted(self._crossed.get(count.identity, ()))
            within = finer
        return found

    def _rest(self, before: QueryPlans, after: QueryPlans, clocks: Mapping[str, int | None]) -> None:
        held = after.entries
        for query in before.queries if self._refined else ():
            for entry in query.entries if query.identity in self._refined else ():
                if held.get(entry.bit) == entry:
                    continue
                rest_us = _REST_WINDOWS * entry.window_us
                until = {name: now_us + rest_us for name, now_us in clocks.items() if now_us is not None}
                self._resting.append(_Resting(entry.bit, until))


def coarsest(request: QueryRequest) -> QueryRequest:
    """The count that is always in force for a request; itself where it asks for no levels."""
    levels = levels_of(request)
    return _count(request, levels[0], "") if levels else request


def _count(request: QueryRequest, level: int, prefix: str) -> QueryRequest:
    """The request's count by prefixes of a level (0: by addresses) below a prefix (empty: of all packets)."""
    if not level and not prefix:
        return request
    by = f"/{level}" if level else "addresses"
    identity = f"{request.identity}{_MARK}{by} in {prefix or 'all'}"
    return msgspec.structs.replace(
        request,
        identity=identity,
        query=narrowed(request.query, identity, prefix),
        coarse=level,
        within=prefix,
    )


def _rests(resting: _Resting, clocks: Mapping[str, int | None]) -> bool:
    return any((clocks.get(name) or until) < until for name, until in resting.until_us.items())
