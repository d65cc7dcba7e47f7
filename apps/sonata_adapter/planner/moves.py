"""Moving queries between switch and host, so that no window is lost.  Pure.

    count so far   ───────────────────┐  results of the windows before W
    new count           ├──────────────────►  results of the windows from W on
                        begins        W  window that begins when the new count is surely in force

Queries that are refined move by refinement, and are left alone here.
"""

from collections.abc import Iterable, Mapping
from typing import Final, Literal

import msgspec

from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.planner.plan import QueryPlans, copies_saved, plan
from apps.sonata_adapter.planner.rates import MeasuredRates
from apps.sonata_adapter.planner.refinement_levels import levels_of

Side = Literal["switch", "host"]
_IN_FORCE_S: Final = 2.0
"""Seconds after which entries that were asked for are taken to be in the switch."""
_OTHER: Final = " (moved)"
"""Tells the two counts of a query apart while it moves."""
LEAST_GAIN: Final = 100.0
"""Copies a second; less is not worth a move."""
_FACTOR: Final = 2.0
"""By so much what comes into the switch must save more than what leaves it: or they would change places again."""
_WINDOWS: Final = 2
"""So many windows after W the old count leaves: it may report the last window when the next one is over."""


class _Move(msgspec.Struct, frozen=True):
    side: Side
    from_us: dict[str, int]
    """By switch: begin of the first window that is the new count's."""
    window_us: int


class Moves:
    """Which counts are in force for each request, and whose results are taken."""

    def __init__(self) -> None:
        self._sides: dict[str, Side] = {}
        """Of settled counts, by request."""
        self._other: set[str] = set()
        """Requests whose settled count has the other name."""
        self._moves: dict[str, _Move] = {}
        self.moved = 0

    def counts(self, requests: Mapping[str, QueryRequest]) -> dict[str, QueryRequest]:
        """What is to be planned, by identity: a count for each request, two while it moves."""
        self._sides = {identity: side for identity, side in self._sides.items() if identity in requests}
        self._other &= requests.keys()
        self._moves = {identity: move for identity, move in self._moves.items() if identity in requests}
        found: list[QueryRequest] = []
        for identity, request in requests.items():
            side, move = self._sides.get(identity), self._moves.get(identity)
            found.append(_count(request, other=identity in self._other, on_host=side == "host"))
            if move is not None:
                found.append(_count(request, other=identity not in self._other, on_host=move.side == "host"))
        return {count.identity: count for count in found}

    def owner(self, count: str) -> str:
        """Identity of the request that a count is for."""
        return count.removesuffix(_OTHER)

    def current(self, identity: str) -> str:
        """Identity of a request's settled count."""
        return identity + _OTHER if identity in self._other else identity

    def settle(self, requests: Mapping[str, QueryRequest], made: QueryPlans) -> bool:
        """Note where counts are; returns whether a move is off because the switch has no room: plan again."""
        inside = {one.identity for one in made.queries if one.in_switch}
        for identity, request in requests.items():
            if movable(request) and identity not in self._sides:
                self._sides[identity] = "switch" if identity in inside else "host"
        off = [
            identity
            for identity, move in self._moves.items()
            if move.side == "switch" and self._new(identity) not in inside
        ]
        for identity in off:
            del self._moves[identity]
        return bool(off)

    def begin(self, request: QueryRequest, side: Side, surely_us: Mapping[str, int]) -> None:
        """Start to move a query; `surely_us`: for each switch the time at which the new count will be in force."""
        window_us = request.query.window_us
        from_us = {name: -(-time_us // window_us) * window_us for name, time_us in surely_us.items()}
        self._moves[request.identity] = _Move(side, from_us, window_us)

    def end(self, now_us: Mapping[str, int | None]) -> bool:
        """Let go of old counts whose windows are reported; times are from the switches' zero.  Whether there was one."""
        over = [identity for identity, move in self._moves.items() if _is_over(move, now_us)]
        for identity in over:
            self._sides[identity] = self._moves.pop(identity).side
            self._other ^= {identity}
            self.moved += 1
        return bool(over)

    @property
    def under_way(self) -> bool:
        """Whether a query moves now."""
        return bool(self._moves)

    def accepts(self, count: str, switch: str, window_us: int) -> bool:
        """Whether a result is taken; `window_us`: begin of its window, from the switch's zero."""
        move = self._moves.get(self.owner(count))
        if move is None:
            return True
        return (count == self._new(self.owner(count))) == (window_us >= move.from_us.get(switch, 0))

    def set_back(self, switch: str, step_us: int) -> None:
        """The clock of a switch was set back by `step_us`, at most 0: what begins at a time begins as much earlier."""
        for move in self._moves.values():
            if switch in move.from_us:
                from_us = move.from_us[switch] + step_us
                move.from_us[switch] = -(-from_us // move.window_us) * move.window_us

    def _new(self, identity: str) -> str:
        return identity if identity in self._other else identity + _OTHER


def improvements(
    counts: Iterable[QueryRequest],
    limits: SwitchLimits,
    present: QueryPlans,
    rates: MeasuredRates,
    resting: Iterable[int] = (),
) -> dict[str, Side]:
    """Counts that should move, by identity: into room that there is; or out, for others that save much more.

    Args:
        counts: all that are planned.
        limits: of the switch.
        present: their plan.
        rates: as they are now.
        resting: bits that are not given away yet.
    """
    free = {one.identity: msgspec.structs.replace(one, on_host=False) for one in counts}
    waiting = {
        identity
        for identity, one in free.items()
        if movable(one) and not present.of(identity).in_switch and copies_saved(one, limits, rates) > 0
    }
    if not waiting:
        return {}
    fits = plan(list(free.values()), limits, before=present, resting=resting, rates=rates)
    comes = {identity for identity in waiting if fits.of(identity).in_switch}
    if comes:
        return dict.fromkeys(comes, "switch")
    ideal = plan(list(free.values()), limits, rates=rates)
    comes = {identity for identity in waiting if ideal.of(identity).in_switch}
    goes = {one.identity for one in present.queries if one.in_switch and not ideal.of(one.identity).in_switch}
    gain = sum(copies_saved(free[identity], limits, rates) for identity in comes)
    loss = sum(copies_saved(free[identity], limits, rates) for identity in goes)
    worthwhile = gain >= _FACTOR * loss and gain - loss >= LEAST_GAIN
    return (
        dict.fromkeys(goes, "host") if worthwhile and all(map(movable, map(free.__getitem__, goes))) else {}
    )


def surely_us(heard_us: int | None, rate: float, idle_s: float, window_us: int) -> int:
    """When a count that is asked for now will be in force, us since a switch's zero.

    Args:
        heard_us: the time it has said last; None: none.
        rate: of its clock, seconds a second.
        idle_s: since when it has said none.
        window_us: of the count.
    """
    pace = max(1.0, rate)
    margin_us = max(window_us, round(_IN_FORCE_S * pace * 1e6))
    return 0 if heard_us is None else heard_us + round(idle_s * pace * 1e6) + margin_us


def movable(request: QueryRequest) -> bool:
    """Whether a request is moved here; refinement moves the others."""
    return request.kind == "query" and not levels_of(request)


def _count(request: QueryRequest, *, other: bool, on_host: bool) -> QueryRequest:
    if not other:
        return msgspec.structs.replace(request, on_host=on_host)
    identity = request.identity + _OTHER
    query = msgspec.structs.replace(request.query, name=identity)
    return msgspec.structs.replace(request, identity=identity, query=query, on_host=on_host)


def _is_over(move: _Move, now_us: Mapping[str, int | None]) -> bool:
    return all(
        (now_us.get(name) or 0) >= from_us + _WINDOWS * move.window_us
        for name, from_us in move.from_us.items()
        if name in now_us
    )
