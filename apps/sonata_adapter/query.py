"""Queries: operators over packet tuples as typed values, and the fluent way to write them.

    Query("new_tcp", window_ms=3000)
        .filter(tcp.flags == SYN)
        .map(dst=ip.dst)
        .reduce("dst", count=count())
        .filter(field("count") >= 40)

Values are immutable: every call returns a new query.  Building one checks it: fields exist, kinds
fit, joins have what they join on.  Errors are `InvalidQuery`.
"""

from collections.abc import Iterable
from typing import Final, Literal, TypeAlias

import msgspec

from apps.sonata_adapter.errors import InvalidQuery
from apps.sonata_adapter.expressions import (
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

__all__ = ["ACK", "FIN", "RST", "SYN", "SYN_ACK", "Query", "arp", "count", "dns", "eth", "field", "icmp", "ip", "largest", "length", "payload_contains", "port", "tcp", "total", "udp", "vlan"]  # fmt: skip

JoinKind = Literal["inner", "left", "outer", "anti"]
Function = Literal["sum", "max"]


class Filter(msgspec.Struct, frozen=True, tag=True):
    """Keep tuples for which the condition holds."""

    condition: Expression


class Map(msgspec.Struct, frozen=True, tag=True):
    """Make tuples with these fields, sorted by name, and no others."""

    fields: tuple[tuple[str, Expression], ...]


class Distinct(msgspec.Struct, frozen=True, tag=True):
    """Keep the first of equal tuples in a window."""


class Reduce(msgspec.Struct, frozen=True, tag=True):
    """One tuple for each value of the keys: the keys and the sum or maximum of `value`."""

    keys: tuple[str, ...]
    name: str
    function: Function
    value: Expression


class Join(msgspec.Struct, frozen=True, tag=True):
    """Tuples of two queries with equal keys, at the end of a window.

    inner: where both have one.  left: all of this side.  outer: all of both.  anti: those of this side
    that the other has not.  Fields that are missing are 0.
    """

    other: "Pipeline"
    keys: tuple[str, ...]
    kind: JoinKind


Step: TypeAlias = Filter | Map | Distinct | Reduce | Join
Pipeline: TypeAlias = tuple[Step, ...]

PACKET_KINDS: Final[dict[str, Kind]] = {name: kind for name, (kind, _) in PACKET_FIELDS.items()}
MIN_WINDOW_MS: Final = 10
MAX_WINDOW_MS: Final = 3_600_000


class Aggregate(msgspec.Struct, frozen=True):
    """What a reduce makes of the tuples of a key."""

    function: Function
    value: Expression


def count() -> Aggregate:
    """How many tuples."""
    return Aggregate("sum", Number(1))


def total(value: Term) -> Aggregate:
    """Their sum."""
    return Aggregate("sum", value.node)


def largest(value: Term) -> Aggregate:
    """The largest."""
    return Aggregate("max", value.node)


class Query(msgspec.Struct, frozen=True):
    """A pipeline of steps over the packets of windows [n·W, (n+1)·W) of capture time."""

    name: str
    window_ms: int = 3_000
    steps: Pipeline = ()

    def __post_init__(self) -> None:
        if not MIN_WINDOW_MS <= self.window_ms <= MAX_WINDOW_MS:
            raise InvalidQuery(
                f"{self.name}: a window is {MIN_WINDOW_MS} ms to {MAX_WINDOW_MS} ms, not {self.window_ms} ms"
            )

    @property
    def window_us(self) -> int:
        return self.window_ms * 1000

    def filter(self, condition: Term) -> "Query":
        """Keep tuples for which the condition holds."""
        return self._with(Filter(as_node(condition)))

    def map(self, *names: str, **fields: Term | int) -> "Query":
        """Tuples of `names` as they are and of new fields."""
        chosen: dict[str, Expression] = {name: Field(name) for name in names}
        chosen |= {name: as_node(value) for name, value in fields.items()}
        return self._with(Map(tuple(sorted(chosen.items()))))

    def distinct(self) -> "Query":
        """Keep the first of equal tuples in a window."""
        return self._with(Distinct())

    def reduce(self, *keys: str, **values: Aggregate) -> "Query":
        """One tuple for each value of the keys, with one new field."""
        if len(values) != 1:
            raise InvalidQuery(f"{self.name}: reduce makes one field, as in reduce('dst', count=count())")
        ((name, made),) = values.items()
        return self._with(Reduce(tuple(sorted(keys)), name, made.function, made.value))

    def join(self, other: "Query", *on: str, kind: JoinKind = "inner") -> "Query":
        """Tuples of both queries that are equal in the fields `on`."""
        if other.window_ms != self.window_ms:
            raise InvalidQuery(
                f"{self.name}: windows of {self.window_ms} and {other.window_ms} ms cannot be joined"
            )
        return self._with(Join(other.steps, tuple(sorted(on)), kind))

    def _with(self, step: Step) -> "Query":
        steps = (*self.steps, step)
        try:
            output_kinds(steps)
        except InvalidQuery as error:
            raise InvalidQuery(f"{self.name}: step {len(steps)}: {error}") from None
        return Query(self.name, self.window_ms, steps)

    @property
    def fields(self) -> dict[str, Kind]:
        """Fields of the query's results."""
        return output_kinds(self.steps)

    def text(self) -> str:
        """The query in its text form."""
        return "\n".join(
            (f"query {self.name}(window={duration_text(self.window_ms)}):", *text_lines(self.steps))
        )


def output_kinds(steps: Iterable[Step]) -> dict[str, Kind]:
    """Name and kind of each field after the steps; raises `InvalidQuery`."""
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
                raise InvalidQuery(f"filter needs a condition, not {text_of(condition)}")
            return kinds
        case Map(fields):
            if not fields:
                raise InvalidQuery("map needs at least one field")
            return {name: kind_of(value, kinds) for name, value in fields}
        case Distinct():
            if kinds.keys() >= PACKET_KINDS.keys():
                raise InvalidQuery("distinct needs a map before it that says of which fields")
            return kinds
        case Reduce():
            return _after_reduce(step, kinds)
        case Join():
            if not stateful:
                raise InvalidQuery("join needs a distinct or a reduce before it")
            return _after_join(step, kinds)


def _after_reduce(step: Reduce, kinds: dict[str, Kind]) -> dict[str, Kind]:
    if not step.keys:
        raise InvalidQuery("reduce needs at least one key")
    if kind_of(step.value, kinds) != "number":
        raise InvalidQuery(f"reduce adds up numbers, not {text_of(step.value)}")
    if step.name in step.keys:
        raise InvalidQuery(f"reduce: {step.name} is a key and cannot be the new field, too")
    return {**{key: kind_of(Field(key), kinds) for key in step.keys}, step.name: "number"}


def _after_join(step: Join, kinds: dict[str, Kind]) -> dict[str, Kind]:
    if not any(isinstance(inner, Distinct | Reduce) for inner in step.other):
        raise InvalidQuery("the other side of a join needs a distinct or a reduce")
    other = output_kinds(step.other)
    for key in step.keys:
        if kind_of(Field(key), kinds) != kind_of(Field(key), other):
            raise InvalidQuery(f"join: {key} is {kinds[key]} on one side and {other[key]} on the other")
    if not step.keys:
        raise InvalidQuery("join needs at least one field to join on")
    if step.kind == "anti":
        return kinds
    both = (kinds.keys() & other.keys()) - set(step.keys)
    if both:
        raise InvalidQuery(f"join: both sides have {', '.join(sorted(both))}; rename one with map")
    return {**kinds, **other}


def text_lines(steps: Pipeline, indent: str = "    ") -> list[str]:
    """Steps in the text form, joins with the other side beneath them."""
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
    """`3000` → `3s`; the largest unit that is whole."""
    for unit, size in (("h", 3_600_000), ("m", 60_000), ("s", 1000)):
        if milliseconds % size == 0:
            return f"{milliseconds // size}{unit}"
    return f"{milliseconds}ms"


def field(name: str) -> Term:
    """A field of the tuples that the step before makes."""
    return Term(Field(name))


def payload_contains(pattern: bytes) -> Term:
    """The payload, as far as it was copied, contains the pattern."""
    return Term(Contains(pattern))


class _Ip:
    src = field("ip.src")
    dst = field("ip.dst")
    proto = field("ip.proto")
    version = field("ip.version")


class _Tcp:
    sport = field("tcp.sport")
    dport = field("tcp.dport")
    flags = field("tcp.flags")
    seq = field("tcp.seq")
    ack = field("tcp.ack")


class _Udp:
    sport = field("udp.sport")
    dport = field("udp.dport")


class _Icmp:
    type = field("icmp.type")
    code = field("icmp.code")


class _Eth:
    src = field("eth.src")
    dst = field("eth.dst")
    type = field("eth.type")


class _Arp:
    op = field("arp.op")


class _Dns:
    response = field("dns.response")
    qtype = field("dns.qtype")
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
