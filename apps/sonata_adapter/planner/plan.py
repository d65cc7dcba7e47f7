"""Which parts of each query run in the switch, and which on the host.  Pure.

    query ─► graph ─► can the switch count it?  ─ yes, and there is room ─► counting entries, reports
                                                └ no ─► copies of the packets that its filters name

The switch can count a reduce over packets, or over a distinct over packets, whose keys are addresses, the destination
port and the length; and, in one cell, differences of such counts.  Each distinct and each reduce takes a bit of the
classifier for each alternative of its filter, and a place in a counting stage; within one stage, no frame may match
two entries.  Of a query with a gate the switch counts what opens it, and copies only what comes behind.  If there is not room for all queries, those that save most tuples come first.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import fsum, gcd
from typing import Final

import msgspec

from apps.sonata_adapter.errors import NotPlaced
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.cell_needs import CellNeeds
from apps.sonata_adapter.planner.conditions import Match, conditions_of, disjoint, narrowed
from apps.sonata_adapter.planner.estimates import packets_per_second
from apps.sonata_adapter.planner.placement import (
    CROWDED,
    Copy,
    Role,
    Shares,
    Space,
    StageEntry,
    SwitchLimits,
    by_bytes,
    masks_of,
)
from apps.sonata_adapter.planner.pushdown import Difference, candidates, difference
from apps.sonata_adapter.planner.rates import MeasuredRates
from apps.sonata_adapter.planner.refinement_levels import address_of, by_family, cut
from apps.sonata_adapter.query.dataflow import (
    Crossing,
    DistinctNode,
    Node,
    Outcome,
    PacketSource,
    ReduceNode,
    WindowTable,
    compile_query,
    conjuncts,
    key_fields,
    sources,
)
from apps.sonata_adapter.query.expressions import PAYLOAD_FIELDS, Expression, Field, fields_of, text_of
from apps.sonata_adapter.query.language import Gate, duration_text

_LONGEST_PERIOD_MS: Final = 10_000
"""Longest period between two time reports of the switch, ms."""
_SHARE_WITHIN: Final = 2
"""A narrowed query takes the number of cells that it would take for all packets, divided by this."""
_OTHER_SIDE: Final = {
    "ip.src": "ip.dst", "ip.dst": "ip.src", "tcp.sport": "tcp.dport", "tcp.dport": "tcp.sport",
    "udp.sport": "udp.dport", "udp.dport": "udp.sport", "length": "length",
}  # fmt: skip
"""Where the answer to a packet has a part of its key."""
MOVES: Final = "it is on the host until a window is over, and moves to the switch then if there is room"
_CELLS_A_PREFIX: Final = 8
"""Cells of a coarse level for each prefix that there can be of IPv4: then hardly one is without."""


class QueryPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Where one query runs."""

    identity: str
    entries: tuple[StageEntry, ...] = ()
    copies: tuple[Copy, ...] = ()
    payload: bool = False
    """On the host, and some of its copies must hold the frames' bytes."""
    reason: str = ""
    """Why it does not run in the switch; empty if it does."""
    tuples_per_second: float = 0.0
    """Estimated tuples per second that reach the host."""
    saved_per_second: float = 0.0
    """Estimated copies per second that counting in the switch saves."""

    @property
    def in_switch(self) -> bool:
        return bool(self.entries)

    @property
    def gate(self) -> StageEntry | None:
        """Of a query that the switch counts up to its gate, and the host from there on: the gate's first entry."""
        return next((entry for entry in self.entries if entry.role == "gate"), None)


class QueryPlans(msgspec.Struct, frozen=True):
    """Where all queries run."""

    queries: tuple[QueryPlan, ...]
    copies: tuple[Copy, ...]
    """All copies, each condition once: queries that need the same packets share a bit."""
    measured: bool = False
    """Whether rates are those of the running network."""

    @property
    def entries(self) -> dict[int, StageEntry]:
        """By bit: queries share the entries of a distinct."""
        return {entry.bit: entry for query in self.queries for entry in query.entries}

    @property
    def gate_bits(self) -> tuple[int, ...]:
        """Bits of the copies behind gates."""
        gates = [query.gate for query in self.queries if query.gate is not None]
        return tuple(bit for gate in gates for bit in (gate.opens, gate.uncounted))

    def repeated(self, bit: int) -> int:
        """Map of the bits that wait behind a distinct."""
        return sum(1 << entry.bit for entry in self.entries.values() if bit in entry.behind)

    def of(self, identity: str) -> QueryPlan:
        return next(query for query in self.queries if query.identity == identity)


def plan(
    requests: Sequence[QueryRequest],
    limits: SwitchLimits | None = None,
    *,
    before: QueryPlans | None = None,
    resting: Iterable[int] = (),
    generation: int = 1,
    rates: MeasuredRates | None = None,
) -> QueryPlans:
    """The plan for all requests; entries of the plan `before` keep their place in the switch.

    The order of requests does not matter; new ones that save most come first.  Bits that are
    `resting` are not given away: their cells of this window still hold what they counted before.
    `generation` (1 to 255) is other than that of the plans before, for who gets a bit that was another's.
    `rates`: of the running network.  Requests that are `on_host` stay there.
    """
    limits = limits or SwitchLimits()
    space = Space(limits)
    kept: dict[str, QueryPlan] = {}
    wanted = {request.identity: request for request in requests}
    held = before.copies if before is not None else ()
    space.take_bits((*resting, *(copy.bit for copy in held)))
    for old in before.queries if before is not None else ():
        if old.identity in wanted and old.in_switch:
            kept[old.identity] = old
            space.hold(old.entries)
    fresh = [request for request in wanted.values() if request.identity not in kept]
    ordered = sorted(fresh, key=lambda request: (-_saving(request, limits, rates), request.identity))
    placed, space = _placed(ordered, space, limits, rates)
    found = _timed({**kept, **_marked(placed, generation)}, limits)
    copies = _copies([wanted[one.identity] for one in found.values() if not one.in_switch], held, space)
    plans = []
    for identity in sorted(found):
        one = found[identity]
        if not one.in_switch:
            mine = _serving(wanted[identity], copies)
            one = msgspec.structs.replace(
                one,
                copies=mine,
                payload=any(bytes_too for _, bytes_too in _needed(wanted[identity])),
                tuples_per_second=packets_per_second((copy.match for copy in mine), rates),
            )
        plans.append(one)
    measured = rates is not None and rates.of({}) is not None
    return QueryPlans(tuple(plans), tuple(copies), measured)


def _placed(
    requests: Sequence[QueryRequest], space: Space, limits: SwitchLimits, rates: MeasuredRates | None
) -> tuple[dict[str, QueryPlan], Space]:
    """Plans for new requests, and what is free then.

    Cells are shared out so that most copies are saved; then so that keys have the cells that they need.  Entries that
    could do with fewer have fewer only where that makes a difference to others.
    """
    keys = rates.cells if rates is not None and rates.cells.known else None
    first = _split(requests, space, limits, rates, Shares(keys=keys))
    if keys is None or all(one.in_switch and not crowded(one, keys, limits) for one in first[0].values()):
        return first
    modest = sorted(
        requests, key=lambda one: max((keys.wanted(each) for each in _alone(one, limits)), default=0)
    )
    others = [
        _split(modest, space, limits, rates, Shares(keys=keys, spares=True)),
        _split(requests, space, limits, rates, Shares()),
    ]
    return max([first, *others], key=lambda trial: _worth(trial[0], keys, limits))


def _alone(request: QueryRequest, limits: SwitchLimits) -> list[StageEntry]:
    """Entries of a query alone in a switch; none: it cannot count it."""
    try:
        return _entries(request, Space(limits), limits)
    except NotPlaced:
        return []


def _worth(plans: Mapping[str, QueryPlan], keys: CellNeeds, limits: SwitchLimits) -> tuple[float, int]:
    """What plans save, and the cells that they give to keys that need them."""
    entries = {entry.bit: entry for one in plans.values() for entry in one.entries}.values()
    needed = sum(min(entry.size, keys.wanted(entry), limits.cells) for entry in entries)
    return fsum(one.saved_per_second for one in plans.values()), needed


def crowded(one: QueryPlan, keys: CellNeeds, limits: SwitchLimits) -> list[StageEntry]:
    """Entries of a query with at most half of the cells that their keys need."""
    return [entry for entry in one.entries if CROWDED * entry.size <= min(keys.wanted(entry), limits.cells)]


def _split(
    requests: Sequence[QueryRequest],
    space: Space,
    limits: SwitchLimits,
    rates: MeasuredRates | None,
    shares: Shares,
) -> tuple[dict[str, QueryPlan], Space]:
    """Plans with distincts split where that takes no query's room, and what is free then."""
    trials = []
    for splits in (True, False):
        trial = space.copy(msgspec.structs.replace(shares, splits=splits))
        trials.append(({one.identity: _counted(one, trial, limits, rates) for one in requests}, trial))
    (split, less), (whole, more) = trials
    as_many = all(split[identity].in_switch for identity, one in whole.items() if one.in_switch)
    return trials[0] if as_many and (less.free_stages or not more.free_stages) else trials[1]


def _marked(plans: Mapping[str, QueryPlan], generation: int) -> dict[str, QueryPlan]:
    """The plans, with differences told from those that had their bits before."""
    return {
        identity: msgspec.structs.replace(
            one,
            entries=tuple(
                msgspec.structs.replace(entry, generation=generation) if entry.role == "difference" else entry
                for entry in one.entries
            ),
        )
        for identity, one in plans.items()
    }


def renewed(plans: QueryPlans, generation: int) -> QueryPlans:
    """The same plans, with another generation of differences: the switch forgets which keys wait for a window's end."""
    marked = _marked({one.identity: one for one in plans.queries}, generation)
    return msgspec.structs.replace(plans, queries=tuple(marked.values()))


def _timed(plans: Mapping[str, QueryPlan], limits: SwitchLimits) -> dict[str, QueryPlan]:
    """The plans, with the switch's clock as slow as the windows of all that it serves allow.

    It reports the end of each window, and the time in between.
    """
    windows = [
        entry.window_us // 1000
        for one in plans.values()
        if any(entry.role == "clock" for entry in one.entries)
        for entry in one.entries
        if entry.role in ("reduce", "gate")
    ]
    period_us = 1000 * clock_period(windows, limits.read_window_ms)
    return {
        identity: msgspec.structs.replace(
            one, entries=tuple(_at_pace(entry, period_us) for entry in one.entries)
        )
        for identity, one in plans.items()
    }


def _at_pace(entry: StageEntry, period_us: int) -> StageEntry:
    return msgspec.structs.replace(entry, window_us=period_us) if entry.role == "clock" else entry


def clock_period(windows: Iterable[int], least: int) -> int:
    """How often the switch says the time for these windows, in ms: at the end of each and within it.

    Where that would be more often than `least`: at the ends of all only, or else every `least`.
    """
    common = gcd(*windows)
    parts = max(2, -(-common // _LONGEST_PERIOD_MS))
    while common % parts:
        parts += 1
    return next((period for period in (common // parts, common) if period >= least), least)


def copies_saved(request: QueryRequest, limits: SwitchLimits, rates: MeasuredRates | None = None) -> float:
    """Copies a second that counting in the switch saves; 0: it cannot count it."""
    return _saving(request, limits, rates, a_stage=False)


def _saving(
    request: QueryRequest, limits: SwitchLimits, rates: MeasuredRates | None, *, a_stage: bool = True
) -> float:
    """Copies a second that counting in the switch saves, for each stage that it takes; 0: it cannot."""
    stages = {entry.stage for entry in _alone(request, limits)}
    if not stages:
        return 0.0
    saved = packets_per_second((match for match, _ in _needed(request)), rates)
    return saved / len(stages) if a_stage else saved


def _needed(request: QueryRequest) -> list[tuple[Match, bool]]:
    """Conditions of the packets that the host needs to run the query alone, and whether it needs bytes."""
    found: list[tuple[Match, bool]] = []
    for node in _nodes(compile_query(request.query)):
        names = {name for expression in _expressions(node) for name in fields_of(expression)}
        payload = bool(names & (PAYLOAD_FIELDS | {"payload"}))
        for match in conditions_of(_packets(node).filters).alternatives:
            _want(found, match, payload)
    return found


def packet_filters(request: QueryRequest) -> list[tuple[Expression, ...]]:
    """For each side of a query, the conditions that a packet must meet to be counted there."""
    return [
        tuple(part for each in _packets(node).filters for part in conjuncts(each))
        for node in _nodes(compile_query(request.query))
    ]


def _want(found: list[tuple[Match, bool]], match: Match, payload: bool) -> None:
    for place, (other, bytes_too) in enumerate(found):
        if other == match:
            found[place] = (match, bytes_too or payload)
            return
    found.append((match, payload))


def _nodes(outcome: Outcome) -> list[Node]:
    return sources(outcome) if isinstance(outcome, WindowTable) else [outcome.node]


def _packets(node: Node) -> PacketSource:
    while not isinstance(node, PacketSource):
        node = node.source
    return node


def _expressions(node: Node) -> Iterator[Expression]:
    match node:
        case PacketSource(filters):
            yield from filters
        case DistinctNode(source, filters, values):
            yield from (*filters, *values)
            yield from _expressions(source)
        case ReduceNode(source, filters, keys, _, value):
            yield from (*filters, *keys, value)
            yield from _expressions(source)


def _counted(
    request: QueryRequest, space: Space, limits: SwitchLimits, rates: MeasuredRates | None
) -> QueryPlan:
    """The query in the switch, or the reason why it is not there."""
    trial = space.copy()
    try:
        entries = _entries(request, trial, limits)
    except NotPlaced as reason:
        return QueryPlan(identity=request.identity, reason=str(reason))
    if request.on_host:
        return QueryPlan(identity=request.identity, reason=MOVES)
    space.hold(entries)
    return QueryPlan(
        identity=request.identity,
        entries=tuple(entries),
        saved_per_second=packets_per_second((match for match, _ in _needed(request)), rates),
    )


def _entries(request: QueryRequest, space: Space, limits: SwitchLimits) -> list[StageEntry]:
    outcome = compile_query(request.query)
    if request.kind != "query":
        raise NotPlaced("it asks for the packets themselves")
    if request.query.gated is not None:
        return _gate_entries(request, request.query.gated, outcome, space, limits)
    if isinstance(outcome, Crossing):
        return _count_entries(request, outcome.node, space, limits, outcome.threshold)
    if not isinstance(outcome, WindowTable) or not limits.reads:
        raise NotPlaced("its result is known at the window's end only, and the values of cells are not read")
    nodes = sources(outcome)
    signed = difference(outcome)
    if signed is not None:
        with suppress(NotPlaced):  # then it is counted apart, if there is room for that
            return _difference_entries(request, outcome, signed, space)
    found: list[StageEntry] = [_clock(request, space, limits)]
    for place, (node, threshold) in enumerate(zip(nodes, candidates(outcome), strict=True)):
        found += _count_entries(request, node, space, limits, threshold, source=place)
    return found


def _clock(request: QueryRequest, space: Space, limits: SwitchLimits) -> StageEntry:
    if request.query.window_ms < limits.read_window_ms:
        raise NotPlaced(
            f"its result is known at the window's end only, and the switch reports the time no more often than every "
            f"{duration_text(limits.read_window_ms)}: it would come too late"
        )
    return space.clock()


def _gate_entries(
    request: QueryRequest, gate: Gate, outcome: Outcome, space: Space, limits: SwitchLimits
) -> list[StageEntry]:
    """Entries that count what opens the gate, and that copy what comes behind it."""
    counted = conditions_of(conjuncts(gate.condition))
    if not counted.exact:
        raise NotPlaced(f"the classifier cannot express {text_of(gate.condition)}")
    clock = [_clock(request, space, limits)] if isinstance(outcome, WindowTable) else []
    masks = masks_of((gate.key,))
    wanted: list[tuple[Match, Expression, Role]] = [
        (match, gate.key, "gate") for match in counted.alternatives
    ]
    for node in _nodes(outcome):
        packets = _packets(node)
        for match in conditions_of(packets.filters).alternatives:
            same = [key for other, key, _ in wanted if narrowed(match, other) == match]
            if packets.gate_key in same:
                continue
            wanted.append((match, packets.gate_key or gate.key, "look"))
    entries = [
        StageEntry(
            role=role,
            bit=0,
            stage=0,
            match=match,
            masks=masks,
            threshold=gate.count,
            by_bytes=0,
            window_us=request.query.window_us,
            answers=_answers(gate.key, key),
        )
        for match, key, role in wanted
    ]
    return [*clock, *space.gate(entries)]


def _answers(key: Expression, other: Expression) -> int:
    """Whether the key of other packets is that of the other side; raises `NotPlaced` where it is neither."""
    if other == key:
        return 0
    if not (isinstance(key, Field) and other == Field(_OTHER_SIDE.get(key.name, ""))):
        raise NotPlaced("what goes through a gate is one side of a conversation")
    return 1


def _difference_entries(
    request: QueryRequest, table: WindowTable, signed: Difference, space: Space
) -> list[StageEntry]:
    """Entries that count up and down in the same cells."""
    fields = key_fields(table)
    keys = [dict(each) for each in fields]
    found: list[StageEntry] = []
    for place, (node, sign) in enumerate(zip(sources(table), signed.signs, strict=True)):
        counted, matches = _countable(node)
        if isinstance(counted.source, DistinctNode) or counted.function != "sum":
            raise NotPlaced("the switch adds up frames or bytes for a difference, nothing else")
        answers = keys[place] != keys[0]
        if answers and {name: _OTHER_SIDE.get(part) for name, part in keys[place].items()} != keys[0]:
            raise NotPlaced("the keys of a difference are one side of a conversation")
        found += [
            StageEntry(
                role="difference",
                bit=0,
                stage=0,
                match=match,
                masks=masks_of(Field(part) for _, part in fields[0]),
                threshold=signed.threshold,
                by_bytes=by_bytes(counted.value),
                window_us=request.query.window_us,
                source=place,
                answers=int(answers),
                subtracts=int(sign < 0),
            )
            for match in matches
        ]
    return space.together(found)


def _count_entries(
    request: QueryRequest, node: Node, space: Space, limits: SwitchLimits, threshold: int, *, source: int = 0
) -> list[StageEntry]:
    """Entries of one reduce, and of the distinct before it."""
    counted, matches = _countable(node)
    if request.coarse:
        matches = by_family(matches)
    window_us = request.query.window_us
    share = len(matches) * (_SHARE_WITHIN if request.within else 1)
    cells = min(_CELLS_A_PREFIX << request.coarse, limits.reduce_cells) if request.coarse else 0
    found: list[StageEntry] = []
    for match in matches:
        first: list[StageEntry] = []
        if isinstance(counted.source, DistinctNode):
            masks = _masks(request, counted.source.values, match)
            first = space.distinct(match, masks, window_us, share)
            found += first
        last = StageEntry(
            role="reduce",
            bit=0,
            stage=0,
            match=match,
            masks=_masks(request, counted.keys, match),
            window_us=window_us,
            threshold=threshold,
            by_bytes=by_bytes(counted.value),
            source=source,
            behind=tuple(entry.bit for entry in first),
        )
        found.append(space.place(last, after=max((entry.stage for entry in first), default=-1), cells=cells))
    return found


def _masks(request: QueryRequest, keys: Sequence[Expression], match: Match) -> tuple[tuple[str, int], ...]:
    masks = masks_of(keys)
    return cut(masks, address_of(request.query), request.coarse, match) if request.coarse else masks


def _countable(node: Node) -> tuple[ReduceNode, Sequence[Match]]:
    """A reduce that counting stages can do, and the packets for it; raises `NotPlaced`."""
    if not isinstance(node, ReduceNode):
        raise NotPlaced("the switch reports counts that reach a threshold, not each new tuple")
    filters = _packets(node).filters
    conditions = conditions_of(filters)
    if not conditions.exact:
        raise NotPlaced(f"the classifier cannot express {' and '.join(map(text_of, filters))}")
    if node.filters or (isinstance(node.source, DistinctNode) and node.source.filters):
        raise NotPlaced("the switch cannot filter between its counting stages")
    if isinstance(node.source, DistinctNode) and not isinstance(node.source.source, PacketSource):
        raise NotPlaced("it has more operators in a row than a distinct and a reduce")
    return node, conditions.alternatives


def _serving(request: QueryRequest, copies: Sequence[Copy]) -> tuple[Copy, ...]:
    """The copies that bring what a query needs."""
    every = [copy for copy in copies if not copy.match]
    found: dict[int, Copy] = {}
    for match, _ in _needed(request):
        for copy in [copy for copy in copies if copy.match == match] or every:
            found[copy.bit] = copy
    return tuple(found.values())


def _copies(requests: Sequence[QueryRequest], held: Sequence[Copy], space: Space) -> list[Copy]:
    """One copy for each condition; those of the plan before keep their bits.

    Where bits run out, the last one copies every packet for all that is left.
    """
    wanted: list[tuple[Match, bool]] = []
    for request in requests:
        for match, payload in _overlapping_too(_needed(request)):
            _want(wanted, match, payload)
    old = {copy.bit: copy.match for copy in held}
    found: list[Copy] = []
    for match, payload in wanted:
        bit = next((bit for bit, other in old.items() if other == match), None)
        if bit is None:
            bit = space.bit_for_copy()
        if bit is None:
            rest = any(bytes_too for other, bytes_too in wanted if all(other != copy.match for copy in found))
            return [*found, Copy(bit=space.last_bit, match={}, payload=rest)]
        found.append(Copy(bit=bit, match=match, payload=payload))
    return found


def _overlapping_too(needed: Sequence[tuple[Match, bool]]) -> list[tuple[Match, bool]]:
    """Where one of a query's copies holds bytes, those that may hold the same packets must, too."""
    return [
        (match, payload or any(bytes_too and not disjoint(match, other) for other, bytes_too in needed))
        for match, payload in needed
    ]
