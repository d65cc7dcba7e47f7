"""What of each query goes into the switch, and what stays on the host.  Pure.

    query ─► graph ─► can the switch count it?  ─ yes, and there is room ─► counting entries, reports
                                                └ no ─► copies of the packets that its filters name

The switch counts a reduce over packets, or over a distinct over packets, whose keys are addresses,
the destination port and the length.  Each distinct and each reduce takes a bit of the classifier for
each alternative of its filter and a place in a counting stage; in one stage, no frame may match two
entries.  Where there is no room for all, those queries go in first that save most tuples.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, Literal

import msgspec

from apps.sonata_adapter.conditions import Match, conditions_of, disjoint
from apps.sonata_adapter.dataflow import (
    Crossing,
    DistinctNode,
    Node,
    Outcome,
    PacketSource,
    ReduceNode,
    Table,
    compile_query,
    sources,
)
from apps.sonata_adapter.errors import NotPlaced
from apps.sonata_adapter.estimates import packets_per_second
from apps.sonata_adapter.expressions import PAYLOAD_FIELDS, Expression, Field, Number, fields_of, text_of
from apps.sonata_adapter.keys import Request
from apps.sonata_adapter.query import duration_text

_ADDRESS: Final = (1 << 128) - 1
_SHORT: Final = (1 << 16) - 1
_KEY_PARTS: Final = {
    "ip.src": ("source_mask", _ADDRESS),
    "ip.dst": ("destination_mask", _ADDRESS),
    "tcp.dport": ("port_mask", _SHORT),
    "udp.dport": ("port_mask", _SHORT),
    "length": ("length_mask", _SHORT),
}
Role = Literal["distinct", "reduce"]


class SwitchLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the switch program has room for, and what of it queries may take."""

    bits: int = 200
    """Bits 0 up of the classifier; the controller keeps the others for ports and the whole stream."""
    stages: int = 8
    entries: int = 32
    """Entries of a stage."""
    cells: int = 32_768
    """Cells of a stage in one bank."""
    distinct_cells: int = 16_384
    """What an entry for a distinct takes, if there is room; never less than a quarter."""
    reduce_cells: int = 8_192


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One entry of a counting stage."""

    role: Role
    bit: int
    stage: int
    match: Match
    """What the classifier's bit means."""
    masks: tuple[tuple[str, int], ...]
    threshold: int
    by_bytes: int
    window_us: int
    base: int = 0
    size: int = 0
    behind: int = -1
    """Of a reduce: the bit of the distinct that lets its tuples pass, -1 = none."""

    def params(self, repeated: int = 0) -> dict[str, int]:
        """Parameters of the action `count`; `repeated`: bits to forget for a key seen before."""
        return {
            "query": self.bit,
            "bit_of_query": 1 << self.bit,
            "source_mask": 0,
            "destination_mask": 0,
            "port_mask": 0,
            "length_mask": 0,
            **dict(self.masks),
            "threshold": self.threshold,
            "by_bytes": self.by_bytes,
            "reciprocal": reciprocal(self.window_us),
            "base": self.base,
            "size": self.size,
            "repeated": repeated,
        }


class Copy(msgspec.Struct, frozen=True, kw_only=True):
    """Copies of packets to the host."""

    bit: int
    match: Match
    payload: bool
    """The frames' bytes are needed, not only their headers."""


class QueryPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Where one query runs."""

    identity: str
    entries: tuple[Entry, ...] = ()
    copies: tuple[Copy, ...] = ()
    payload: bool = False
    """On the host, and some of its copies must hold the frames' bytes."""
    reason: str = ""
    """Why it does not run in the switch; empty: it does."""
    tuples_per_second: float = 0.0
    """Estimate of what reaches the host."""
    saved_per_second: float = 0.0
    """Estimate of the copies that counting in the switch saves."""

    @property
    def in_switch(self) -> bool:
        return bool(self.entries)


class Plan(msgspec.Struct, frozen=True):
    """Where all queries run."""

    queries: tuple[QueryPlan, ...]
    copies: tuple[Copy, ...]
    """All copies, each condition once: queries that need the same packets share a bit."""

    @property
    def entries(self) -> dict[int, Entry]:
        """By bit: queries share the entries of a distinct."""
        return {entry.bit: entry for query in self.queries for entry in query.entries}

    def repeated(self, bit: int) -> int:
        """Map of the bits that wait behind a distinct."""
        return sum(1 << entry.bit for entry in self.entries.values() if entry.behind == bit)

    def of(self, identity: str) -> QueryPlan:
        return next(query for query in self.queries if query.identity == identity)


def reciprocal(window_us: int) -> int:
    """2^64 / window, rounded up: `time * reciprocal >> 64` is the window's number.

    Exact for times below 2^64 / (reciprocal * window - 2^64): at least 71 days for 3 s, 85 minutes for
    an hour; beyond, frames in the last microseconds of a window may fall into the next.
    """
    return -(-(1 << 64) // window_us)


def plan(
    requests: Sequence[Request],
    limits: SwitchLimits | None = None,
    *,
    before: Plan | None = None,
) -> Plan:
    """The plan for all requests; what `before` has in the switch keeps its place.

    The order of requests does not matter; of new ones those come first that save most.
    """
    limits = limits or SwitchLimits()
    space = _Space(limits)
    kept: dict[str, QueryPlan] = {}
    wanted = {request.identity: request for request in requests}
    held = before.copies if before is not None else ()
    space.take_bits(copy.bit for copy in held)
    for old in before.queries if before is not None else ():
        if old.identity in wanted and old.in_switch:
            kept[old.identity] = old
            space.hold(old.entries)
    fresh = [request for request in wanted.values() if request.identity not in kept]
    ordered = sorted(fresh, key=lambda request: (-_saving(request), request.identity))
    found = dict(kept)
    for request in ordered:
        found[request.identity] = _counted(request, space)
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
                tuples_per_second=packets_per_second(copy.match for copy in mine),
            )
        plans.append(one)
    return Plan(tuple(plans), tuple(copies))


def _saving(request: Request) -> float:
    """Copies a second that counting in the switch saves, for each stage that it takes."""
    outcome = compile_query(request.query)
    node = outcome.node
    stages = 2 if isinstance(node, ReduceNode) and isinstance(node.source, DistinctNode) else 1
    return packets_per_second(match for match, _ in _needed(request)) / stages


def _needed(request: Request) -> list[tuple[Match, bool]]:
    """Conditions of the packets that the host needs to run the query alone, and whether it needs bytes."""
    found: list[tuple[Match, bool]] = []
    for node in _nodes(compile_query(request.query)):
        names = {name for expression in _expressions(node) for name in fields_of(expression)}
        payload = bool(names & (PAYLOAD_FIELDS | {"payload"}))
        for match in conditions_of(_packets(node).filters).alternatives:
            _want(found, match, payload)
    return found


def _want(found: list[tuple[Match, bool]], match: Match, payload: bool) -> None:
    for place, (other, bytes_too) in enumerate(found):
        if other == match:
            found[place] = (match, bytes_too or payload)
            return
    found.append((match, payload))


def _nodes(outcome: Outcome) -> list[Node]:
    return sources(outcome) if isinstance(outcome, Table) else [outcome.node]


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


def _counted(request: Request, space: "_Space") -> QueryPlan:
    """The query in the switch, or the reason why it is not there."""
    trial = space.copy()
    try:
        entries = _entries(request, trial)
    except NotPlaced as reason:
        return QueryPlan(identity=request.identity, reason=str(reason))
    space.hold(entries)
    return QueryPlan(
        identity=request.identity,
        entries=tuple(entries),
        saved_per_second=packets_per_second(match for match, _ in _needed(request)),
    )


def _entries(request: Request, space: "_Space") -> list[Entry]:
    outcome = compile_query(request.query)
    if request.kind != "query":
        raise NotPlaced("it asks for the packets themselves")
    if not isinstance(outcome, Crossing):
        raise NotPlaced("its result is known at the window's end only, and the values of cells are not read")
    node = outcome.node
    if not isinstance(node, ReduceNode):
        raise NotPlaced("the switch reports counts that reach a threshold, not each new tuple")
    source = _packets(node)
    conditions = conditions_of(source.filters)
    if not conditions.exact:
        raise NotPlaced(f"the classifier cannot express {' and '.join(map(text_of, source.filters))}")
    if node.filters or (isinstance(node.source, DistinctNode) and node.source.filters):
        raise NotPlaced("the switch cannot filter between its counting stages")
    if isinstance(node.source, DistinctNode) and not isinstance(node.source.source, PacketSource):
        raise NotPlaced("it has more operators in a row than a distinct and a reduce")
    found: list[Entry] = []
    window_us = request.query.window_us
    by_bytes = _by_bytes(node.value)
    for match in conditions.alternatives:
        first: Entry | None = None
        if isinstance(node.source, DistinctNode):
            first = space.distinct(match, _masks(node.source.values), window_us)
            found.append(first)
        last = Entry(
            role="reduce",
            bit=0,
            stage=0,
            match=match,
            masks=_masks(node.keys),
            window_us=window_us,
            threshold=outcome.threshold,
            by_bytes=by_bytes,
            behind=-1 if first is None else first.bit,
        )
        found.append(space.place(last, after=-1 if first is None else first.stage))
    return found


def _by_bytes(value: Expression) -> int:
    if value == Number(1):
        return 0
    if value == Field("length"):
        return 1
    raise NotPlaced(f"the switch adds up frames or bytes, not {text_of(value)}")


def _masks(keys: Iterable[Expression]) -> tuple[tuple[str, int], ...]:
    masks: dict[str, int] = {}
    for key in keys:
        part = _KEY_PARTS.get(key.name) if isinstance(key, Field) else None
        if part is None:
            known = ", ".join(_KEY_PARTS)
            raise NotPlaced(f"the key of a cell has no room for {text_of(key)}, only for {known}")
        masks[part[0]] = part[1]
    return tuple(sorted(masks.items()))


def _serving(request: Request, copies: Sequence[Copy]) -> tuple[Copy, ...]:
    """The copies that bring what a query needs."""
    every = [copy for copy in copies if not copy.match]
    found: dict[int, Copy] = {}
    for match, _ in _needed(request):
        for copy in [copy for copy in copies if copy.match == match] or every:
            found[copy.bit] = copy
    return tuple(found.values())


def _copies(requests: Sequence[Request], held: Sequence[Copy], space: "_Space") -> list[Copy]:
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


class _Space:
    """Bits, stages and cells that are still free."""

    def __init__(self, limits: SwitchLimits) -> None:
        self._limits = limits
        self._bits: set[int] = set()
        self._stages: list[list[Entry]] = [[] for _ in range(limits.stages)]

    def copy(self) -> "_Space":
        twin = _Space(self._limits)
        twin._bits = set(self._bits)
        twin._stages = [list(stage) for stage in self._stages]
        return twin

    def hold(self, entries: Iterable[Entry]) -> None:
        for entry in entries:
            if entry.bit not in self._bits:
                self._bits.add(entry.bit)
                self._stages[entry.stage].append(entry)

    def take_bits(self, bits: Iterable[int]) -> None:
        self._bits |= set(bits)

    def bit(self) -> int:
        """A free bit; raises `NotPlaced`."""
        free = self.bit_for_copy()
        if free is None:
            raise NotPlaced(f"all {self._limits.bits} bits of the classifier are taken")
        return free

    @property
    def last_bit(self) -> int:
        """Kept for copies of every packet."""
        return self._limits.bits - 1

    def bit_for_copy(self) -> int | None:
        """A free bit, None if there is none."""
        free = next((bit for bit in range(self.last_bit) if bit not in self._bits), None)
        if free is not None:
            self._bits.add(free)
        return free

    def distinct(self, match: Match, masks: tuple[tuple[str, int], ...], window_us: int) -> Entry:
        """An entry for a distinct: one that is there already, with room behind it, or a new one."""
        for number, held in enumerate(self._stages):
            for entry in held:
                wanted = ("distinct", match, masks, window_us)
                if (entry.role, entry.match, entry.masks, entry.window_us) == wanted and self._room_behind(
                    number, match
                ):
                    return entry
        new = Entry(
            role="distinct",
            bit=0,
            stage=0,
            match=match,
            masks=masks,
            window_us=window_us,
            threshold=0,
            by_bytes=0,
        )
        return self.place(new, after=-1)

    def _room_behind(self, stage: int, match: Match) -> bool:
        return any(
            all(disjoint(match, entry.match) for entry in held) and len(held) < self._limits.entries
            for held in self._stages[stage + 1 :]
        )

    def place(self, wanted: Entry, *, after: int) -> Entry:
        """The entry in the first stage behind `after` that has room; raises `NotPlaced`."""
        wish = self._limits.distinct_cells if wanted.role == "distinct" else self._limits.reduce_cells
        for number in range(after + 1, self._limits.stages):
            held = self._stages[number]
            if len(held) >= self._limits.entries:
                continue
            if not all(disjoint(wanted.match, entry.match) for entry in held):
                continue
            gap = self._gap(held, wish)
            if gap is None:
                continue
            entry = msgspec.structs.replace(wanted, bit=self.bit(), stage=number, base=gap[0], size=gap[1])
            held.append(entry)
            return entry
        raise NotPlaced(f"no counting stage of {self._limits.stages} has room for its {wanted.role}")

    def _gap(self, held: Iterable[Entry], wish: int) -> tuple[int, int] | None:
        """The first gap of cells that is as large as wished, else the largest of at least a quarter."""
        gaps = []
        start = 0
        for entry in sorted(held, key=lambda entry: entry.base):
            gaps.append((start, entry.base - start))
            start = entry.base + entry.size
        gaps.append((start, self._limits.cells - start))
        large = next(((base, wish) for base, size in gaps if size >= wish), None)
        if large is not None:
            return large
        base, size = max(gaps, key=lambda gap: gap[1])
        return (base, size) if size >= wish // 4 else None


def explain(request: Request, found: Plan, *, meaning: str = "") -> str:
    """The plan of one query as a drawing in text."""
    one = found.of(request.identity)
    lines = [request.identity]
    if meaning:
        lines.append(f"  {meaning}")
    lines += ["", *(f"  {line}" for line in request.query.text().splitlines()[1:]), ""]
    lines.append(f"  in the switch{'' if one.in_switch else ': only copies, because ' + one.reason}")
    for entry in one.entries:
        lines += _entry_lines(entry)
    for copy in one.copies:
        what = "frames" if copy.payload else "headers"
        lines.append(f"    bit {copy.bit:<3} copies {what} of {match_text(copy.match)}")
    lines.append("  on the host")
    if one.in_switch:
        lines.append("    keys that reached the threshold, reported once in a window; keys without a cell")
        lines.append(f"    saves about {one.saved_per_second:,.0f} copies a second of 10,000 packets")
    else:
        lines.append(
            f"    all operators, on about {one.tuples_per_second:,.0f} tuples a second of 10,000 packets"
        )
    lines.append(f"    results for windows of {duration_text(request.query.window_ms)}")
    return "\n".join(lines)


def _entry_lines(entry: Entry) -> list[str]:
    key = ", ".join(name.removesuffix("_mask") for name, _ in entry.masks)
    unit = "bytes" if entry.by_bytes else "frames"
    what = (
        f"lets new ({key}) pass"
        if entry.role == "distinct"
        else f"counts {unit} by ({key}), reports {entry.threshold}"
    )
    cells = f"{entry.size:,} cells"
    return [
        f"    bit {entry.bit:<3} {match_text(entry.match)}",
        f"      stage {entry.stage}: {what}, {cells}",
    ]


def match_text(match: Mapping[str, Any]) -> str:
    """A condition of the classifier for people."""
    if not match:
        return "every packet"
    parts = []
    for name, value in sorted(match.items()):
        if name == "ethertype":
            parts.append(
                {0x0800: "IPv4", 0x86DD: "IPv6", 0x0806: "ARP"}.get(value, f"ethertype {value:#06x}")
            )
        elif name in ("sport", "dport"):
            parts.append(f"{name} {value[0]}" if value[0] == value[1] else f"{name} {value[0]}-{value[1]}")
        elif name == "tcp_flags":
            parts.append(f"flags & {value[1]:#04x} == {value[0]:#04x}")
        elif name != "l4_valid":
            parts.append(f"{name} {value}")
    return ", ".join(parts)
