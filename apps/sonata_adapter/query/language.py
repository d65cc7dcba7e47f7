"""Queries: operators over packet tuples as typed values, built with chained method calls.

    Query("new_tcp", window_ms=3000)
        .filter(tcp.flags == SYN)
        .map(dst=ip.dst)
        .reduce("dst", count=count())
        .filter(field("count") >= 40)

Values are immutable: every call returns a new query.  Each call checks the query: fields exist, kinds fit,
and joins have fields to join on.  A mistake raises `QueryError`.
"""

from collections.abc import Iterable
from typing import Final, Literal, TypeAlias

import msgspec

from apps.sonata_adapter.errors import QueryError
from apps.sonata_adapter.query.expressions import (
    ACK,
    FIN,
    PACKET_FIELDS,
    RST,
    SYN,
    SYN_ACK,
    Contains,
    Expression,
    Field,
    Kind,
    Number,
    Term,
    as_node,
    kind_of,
    text_of,
)

__all__ = ["ACK", "ETHERTYPE_ARP", "FIN", "RST", "SYN", "SYN_ACK", "Query", "arp", "count", "dns", "entropy", "eth", "field", "icmp", "ip", "largest", "length", "length_of", "payload", "payload_contains", "port", "tcp", "total", "udp", "vlan"]  # fmt: skip

JoinKind = Literal["inner", "left", "outer", "anti"]
Function = Literal["sum", "max"]


class Filter(msgspec.Struct, frozen=True, tag=True):
    """Keep the tuples that meet the condition."""

    condition: Expression


class Map(msgspec.Struct, frozen=True, tag=True):
    """Make tuples with exactly these fields, sorted by name."""

    fields: tuple[tuple[str, Expression], ...]


class Distinct(msgspec.Struct, frozen=True, tag=True):
    """Keep the first of equal tuples in a window."""


class Reduce(msgspec.Struct, frozen=True, tag=True):
    """One tuple per value of the keys, with the keys and the sum or maximum of `value`."""

    keys: tuple[str, ...]
    name: str
    function: Function
    value: Expression


class Join(msgspec.Struct, frozen=True, tag=True):
    """Join the tuples of two queries that have equal keys, at the end of a window.

    inner: keys that both sides have.  left: all keys of this side.  outer: all keys of either side.
    anti: keys of this side that the other side does not have.  Missing fields are 0.
    """

    other: "Pipeline"
    keys: tuple[str, ...]
    kind: JoinKind


class Gate(msgspec.Struct, frozen=True, tag=True):
    """Look at a key's packets only from the one on with which enough of them have come in the window.

    The packet that opens the gate is the first that is looked at.  For queries that read payloads: a switch counts
    who passes the gate, and copies only those packets.
    """

    name: str
    """The field of the tuples that must have passed."""
    key: Expression
    """That field of the packets that the gate counts."""
    condition: Expression
    """Of the packets that the gate counts."""
    count: int

    def text(self) -> str:
        """Write it as in a query's text.

        Returns:
            One line.
        """
        name = self.name if self.key == Field(self.name) else f"{self.name} = {text_of(self.key)}"
        return f"gate {name}: count() >= {self.count} where {text_of(self.condition)}"


Step: TypeAlias = Filter | Map | Distinct | Reduce | Join
Pipeline: TypeAlias = tuple[Step, ...]

ETHERTYPE_ARP: Final = 0x0806
PACKET_KINDS: Final[dict[str, Kind]] = {name: kind for name, (kind, _) in PACKET_FIELDS.items()}
MIN_WINDOW_MS: Final = 10
MAX_WINDOW_MS: Final = 3_600_000
MOST_GATE: Final = 1_000_000_000


class Aggregate(msgspec.Struct, frozen=True):
    """How a reduce combines the tuples of a key."""

    function: Function
    value: Expression


def count() -> Aggregate:
    """Number of tuples.

    Returns:
        For `Query.reduce`.
    """
    return Aggregate("sum", Number(1))


def total(value: Term) -> Aggregate:
    """Sum of a value over the tuples.

    Args:
        value: a number for each tuple.

    Returns:
        For `Query.reduce`.
    """
    return Aggregate("sum", value.node)


def largest(value: Term) -> Aggregate:
    """Largest value among the tuples.

    Args:
        value: a number for each tuple.

    Returns:
        For `Query.reduce`.
    """
    return Aggregate("max", value.node)


class Query(msgspec.Struct, frozen=True):
    """A pipeline of steps over the packets of windows [n·W, (n+1)·W) of capture time.

    Raises:
        QueryError: the window is shorter than 10 ms or longer than an hour.
    """

    name: str
    window_ms: int = 3_000
    steps: Pipeline = ()
    gated: Gate | None = None
    """Of all its packets, those of joined queries too."""

    def __post_init__(self) -> None:
        if not MIN_WINDOW_MS <= self.window_ms <= MAX_WINDOW_MS:
            raise QueryError(
                f"{self.name}: a window is {MIN_WINDOW_MS} ms to {MAX_WINDOW_MS} ms, not {self.window_ms} ms"
            )

    @property
    def window_us(self) -> int:
        """Length of a window, microseconds."""
        return self.window_ms * 1000

    def gate(self, condition: Term, at_least: int, **key: Term) -> "Query":
        """Look at a key's packets only from the one on with which enough of a kind have come in the window.

        Args:
            condition: which packets are counted, for instance `udp.sport == 53`.
            at_least: how many of them open the gate, 1 or more; the last of these is looked at.
            key: one field, such as `dst=ip.dst`, under the name that it has in the first `map` of the query and of all
                queries that it is joined with.

        Returns:
            The query with this gate.

        Raises:
            QueryError: there are steps already, not exactly one field, or an expression does not fit.
        """
        if self.steps or len(key) != 1:
            raise QueryError(f"{self.name}: a gate comes first, and has one field, as in dst=ip.dst")
        ((name, value),) = key.items()
        made = Gate(name, as_node(value), as_node(condition), at_least)
        if kind_of(made.condition, PACKET_KINDS) != "condition":
            raise QueryError(f"{self.name}: a gate needs a condition, not {text_of(made.condition)}")
        kind_of(made.key, PACKET_KINDS)
        if not 1 <= at_least <= MOST_GATE:
            raise QueryError(f"{self.name}: a gate opens at 1 to {MOST_GATE:,} packets, not {at_least}")
        return Query(self.name, self.window_ms, (), made)

    def filter(self, condition: Term) -> "Query":
        """Keep the tuples that meet a condition.

        Args:
            condition: for instance `tcp.flags == SYN`.

        Returns:
            The query with this step.

        Raises:
            QueryError: not a condition, or a field does not exist.
        """
        return self._with(Filter(as_node(condition)))

    def map(self, *names: str, **fields: Term | int) -> "Query":
        """Make new tuples.

        Args:
            names: fields that are kept.
            fields: new fields by name: expressions or whole numbers.

        Returns:
            The query with this step.

        Raises:
            QueryError: there is no field, or an expression does not fit.
        """
        chosen: dict[str, Expression] = {name: Field(name) for name in names}
        chosen |= {name: as_node(value) for name, value in fields.items()}
        return self._with(Map(tuple(sorted(chosen.items()))))

    def distinct(self) -> "Query":
        """Keep the first of equal tuples in a window.

        Returns:
            The query with this step.

        Raises:
            QueryError: no map before it has chosen the fields.
        """
        return self._with(Distinct())

    def reduce(self, *keys: str, **values: Aggregate) -> "Query":
        """Group tuples: one per value of the keys, with one new field.

        Args:
            keys: fields to group by.
            values: one new field: its name and `count()`, `total(…)` or `largest(…)`.

        Returns:
            The query with this step.

        Raises:
            QueryError: there are no keys, not exactly one new field, or a field does not exist.
        """
        if len(values) != 1:
            raise QueryError(f"{self.name}: reduce makes one field, as in reduce('dst', count=count())")
        ((name, made),) = values.items()
        return self._with(Reduce(tuple(sorted(keys)), name, made.function, made.value))

    def join(self, other: "Query", *on: str, kind: JoinKind = "inner") -> "Query":
        """Join with the tuples of another query, at the end of a window.

        Args:
            other: a query with the same window, and with a distinct or a reduce.
            on: fields that must be equal on both sides.
            kind: inner, left, outer or anti, see `Join`.

        Returns:
            The query with this step.

        Raises:
            QueryError: the windows or gates differ, or fields are missing, of another kind or on both sides.
        """
        if other.window_ms != self.window_ms:
            raise QueryError(
                f"{self.name}: windows of {self.window_ms} and {other.window_ms} ms cannot be joined"
            )
        if other.gated != self.gated:
            raise QueryError(f"{self.name}: both sides of a join have the same gate")
        return self._with(Join(other.steps, tuple(sorted(on)), kind))

    def _with(self, step: Step) -> "Query":
        steps = (*self.steps, step)
        try:
            output_kinds(steps)
        except QueryError as error:
            raise QueryError(f"{self.name}: step {len(steps)}: {error}") from None
        return Query(self.name, self.window_ms, steps, self.gated)

    @property
    def fields(self) -> dict[str, Kind]:
        """Name and kind of each field of the results."""
        return output_kinds(self.steps)

    def text(self) -> str:
        """The query in its text form.

        Returns:
            Lines that `text.parse_queries` reads back.
        """
        head = [f"query {self.name}(window={duration_text(self.window_ms)}):"]
        head += [] if self.gated is None else [f"    {self.gated.text()}"]
        return "\n".join((*head, *text_lines(self.steps)))


def output_kinds(steps: Iterable[Step]) -> dict[str, Kind]:
    """The fields after a number of steps.

    Args:
        steps: steps of a query, in order.

    Returns:
        Name to kind.

    Raises:
        QueryError: the steps do not fit together.
    """
    kinds = dict(PACKET_KINDS)
    stateful = False
    for step in steps:
        kinds = _after(step, kinds, stateful)
        stateful = stateful or isinstance(step, Distinct | Reduce | Join)
    return kinds


def _after(step: Step, kinds: dict[str, Kind], stateful: bool) -> dict[str, Kind]:
    match step:
        case Filter(condition):
            if kind_of(condition, kinds) != "condition":
                raise QueryError(f"filter needs a condition, not {text_of(condition)}")
            return kinds
        case Map(fields):
            if not fields:
                raise QueryError("map needs at least one field")
            return {name: kind_of(value, kinds) for name, value in fields}
        case Distinct():
            if kinds.keys() >= PACKET_KINDS.keys():
                raise QueryError("distinct needs a map before it that names its fields")
            return kinds
        case Reduce():
            return _after_reduce(step, kinds)
        case Join():
            if not stateful:
                raise QueryError("join needs a distinct or a reduce before it")
            return _after_join(step, kinds)


def _after_reduce(step: Reduce, kinds: dict[str, Kind]) -> dict[str, Kind]:
    if not step.keys:
        raise QueryError("reduce needs at least one key")
    if kind_of(step.value, kinds) != "number":
        raise QueryError(f"reduce adds up numbers, not {text_of(step.value)}")
    if step.name in step.keys:
        raise QueryError(f"reduce: {step.name} is a key and cannot be the new field, too")
    return {**{key: kind_of(Field(key), kinds) for key in step.keys}, step.name: "number"}


def _after_join(step: Join, kinds: dict[str, Kind]) -> dict[str, Kind]:
    if not any(isinstance(inner, Distinct | Reduce) for inner in step.other):
        raise QueryError("the other side of a join needs a distinct or a reduce")
    other = output_kinds(step.other)
    for key in step.keys:
        if kind_of(Field(key), kinds) != kind_of(Field(key), other):
            raise QueryError(f"join: {key} is {kinds[key]} on one side and {other[key]} on the other")
    if not step.keys:
        raise QueryError("join needs at least one field to join on")
    if step.kind == "anti":
        return kinds
    both = (kinds.keys() & other.keys()) - set(step.keys)
    if both:
        raise QueryError(f"join: both sides have {', '.join(sorted(both))}; rename one with map")
    return {**kinds, **other}


def text_lines(steps: Pipeline, indent: str = "    ") -> list[str]:
    """Steps in the text form, the other side of a join indented below it.

    Args:
        steps: steps of a query, in order.
        indent: white space before each line.

    Returns:
        One line per step.
    """
    lines = []
    for step in steps:
        match step:
            case Filter(condition):
                lines.append(f"{indent}filter {text_of(condition)}")
            case Map(fields):
                parts = (n if v == Field(n) else f"{n} = {text_of(v)}" for n, v in fields)
                lines.append(f"{indent}map {', '.join(parts)}")
            case Distinct():
                lines.append(f"{indent}distinct")
            case Reduce(keys, name, function, value):
                made = (
                    "count()" if (function, value) == ("sum", Number(1)) else f"{function}({text_of(value)})"
                )
                lines.append(f"{indent}reduce by {', '.join(keys)}: {name} = {made}")
            case Join(other, keys, kind):
                lines.append(f"{indent}join {kind} on {', '.join(keys)} with:")
                lines += text_lines(other, indent + "    ")
    return lines


def duration_text(milliseconds: int) -> str:
    """A duration in the largest unit that divides it: `3000` → `3s`.

    Args:
        milliseconds: the duration, ms.

    Returns:
        A whole number with h, m, s or ms.
    """
    for unit, size in (("h", 3_600_000), ("m", 60_000), ("s", 1000)):
        if milliseconds % size == 0:
            return f"{milliseconds // size}{unit}"
    return f"{milliseconds}ms"


def field(name: str) -> Term:
    """Refer to a field of the tuples from the step before.

    Args:
        name: its name.

    Returns:
        A term for conditions and expressions.
    """
    return Term(Field(name))


def payload_contains(pattern: bytes) -> Term:
    """Condition: the payload, as far as it was copied from the switch, contains a pattern.

    Args:
        pattern: the bytes to search for.

    Returns:
        A term for conditions.
    """
    return Term(Contains(pattern))


def entropy(text: Term) -> Term:
    """Shannon entropy of a packet's text, in thousandths of a bit per byte.

    Args:
        text: `dns.name` or `payload`.

    Returns:
        A term for conditions and expressions.

    Raises:
        QueryError: another field.
    """
    return _measured("entropy", text)


def length_of(text: Term) -> Term:
    """Length of a packet's text in bytes; `len(…)` in the text form.

    Args:
        text: `dns.name` or `payload`.

    Returns:
        A term for conditions and expressions.

    Raises:
        QueryError: another field.
    """
    return _measured("len", text)


def _measured(function: str, text: Term) -> Term:
    made = f"{function}({text})"
    if made not in PACKET_FIELDS:
        raise QueryError(f"{made}: give dns.name or payload")
    return field(made)


class _Ip:
    """Fields of the IP header."""

    src = field("ip.src")
    dst = field("ip.dst")
    proto = field("ip.proto")
    version = field("ip.version")


class _Tcp:
    """Fields of the TCP header."""

    sport = field("tcp.sport")
    dport = field("tcp.dport")
    flags = field("tcp.flags")
    payload_len = field("tcp.payload_len")
    seq = field("tcp.seq")
    ack = field("tcp.ack")


class _Udp:
    """Fields of the UDP header."""

    sport = field("udp.sport")
    dport = field("udp.dport")


class _Icmp:
    """Fields of the ICMP header."""

    type = field("icmp.type")
    code = field("icmp.code")


class _Eth:
    """Fields of the Ethernet header."""

    src = field("eth.src")
    dst = field("eth.dst")
    type = field("eth.type")


class _Arp:
    """Fields of ARP messages."""

    op = field("arp.op")
    src = field("arp.src")
    dst = field("arp.dst")


class _Dns:
    """Fields of DNS messages over UDP."""

    response = field("dns.response")
    qtype = field("dns.qtype")
    type = qtype
    name = field("dns.name")


ip: Final = _Ip
tcp: Final = _Tcp
udp: Final = _Udp
icmp: Final = _Icmp
eth: Final = _Eth
arp: Final = _Arp
dns: Final = _Dns
length: Final = field("length")
port: Final = field("port")
vlan: Final = field("vlan")
payload: Final = field("payload")
"""For `entropy` and `length_of`; see `payload_contains`, too."""
