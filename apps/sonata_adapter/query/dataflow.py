"""A query as a graph that several queries can share, and the steps that remain for a window's end.

    packets ─filter─► Distinct ─filter─► Reduce ──► crossing: value >= threshold, at once
                                           └──────► table: filter, map, join … at the window's end

The graph does not use the query's field names: columns are named by the text of their
expression, so that two queries that compute the same under other names share one operator.
"""

from typing import Final, TypeAlias

import msgspec

from apps.sonata_adapter.errors import QueryError
from apps.sonata_adapter.query.expressions import (
    BinaryOperation,
    Expression,
    Field,
    Kind,
    Number,
    fields_of,
    kind_of,
    substitute,
    text_of,
)
from apps.sonata_adapter.query.language import (
    PACKET_KINDS,
    Distinct,
    Filter,
    Function,
    Gate,
    Join,
    JoinKind,
    Map,
    Pipeline,
    Query,
    Reduce,
    Step,
)

FLOW_FIELDS: Final = frozenset(
    {"ip.src", "ip.dst", "ip.version", "ip.proto", "tcp.sport", "tcp.dport", "udp.sport", "udp.dport"}
)
"""Fields that all packets of a flow have in common."""
VALUE: Final = "#"
"""Column of a reduce's value."""

Names: TypeAlias = tuple[tuple[str, Expression], ...]


class PacketSource(msgspec.Struct, frozen=True, tag=True):
    """Packets that meet all conditions."""

    filters: tuple[Expression, ...]
    once: bool = False
    """The first packet of each flow in a window is enough."""
    gate: Gate | None = None
    gate_key: Expression | None = None
    """The packets' field that must have passed the gate."""


class DistinctNode(msgspec.Struct, frozen=True, tag=True):
    """New combinations of values; columns are called by the text of their expressions."""

    source: "Node"
    filters: tuple[Expression, ...]
    """Over the source's columns; a packet source has none here but its own."""
    values: tuple[Expression, ...]


class ReduceNode(msgspec.Struct, frozen=True, tag=True):
    """Sum or maximum for each key."""

    source: "Node"
    filters: tuple[Expression, ...]
    keys: tuple[Expression, ...]
    function: Function
    value: Expression


Node: TypeAlias = PacketSource | DistinctNode | ReduceNode


class WindowTable(msgspec.Struct, frozen=True, tag=True):
    """The content of a node at the window's end, under the query's names, and the remaining steps."""

    node: Node
    filters: tuple[Expression, ...]
    names: Names
    steps: "tuple[TableStep, ...]"


class TableJoin(msgspec.Struct, frozen=True, tag=True):
    """A join with another table."""

    other: WindowTable
    keys: tuple[str, ...]
    kind: JoinKind


TableStep: TypeAlias = Filter | Map | Distinct | Reduce | TableJoin


class Crossing(msgspec.Struct, frozen=True, tag=True):
    """Report a key once in a window, when its value reaches the threshold.

    For a node without values (distinct) every tuple is reported.
    """

    node: Node
    threshold: int
    names: Names


class TupleStream(msgspec.Struct, frozen=True, tag=True):
    """Report packets (no names) or tuples of packets one by one, without a window."""

    node: PacketSource
    names: Names | None


Outcome: TypeAlias = WindowTable | Crossing | TupleStream


def compile_query(query: Query) -> Outcome:
    """The graph of a query and how it reports results; raises `QueryError`."""
    if not query.steps:
        raise QueryError(f"{query.name}: a query needs at least one step")
    table = _compile(query.steps, query.gated)
    if isinstance(table.node, PacketSource):
        if query.gated is not None:
            raise QueryError(f"{query.name}: a gate needs a distinct or a reduce behind it")
        mapped = any(isinstance(step, Map) for step in query.steps)
        return TupleStream(table.node, table.names if mapped else None)
    return _crossing(table) or table


def sources(table: WindowTable) -> list[Node]:
    """The node of a table and those of all tables joined to it."""
    found = [table.node]
    for step in table.steps:
        if isinstance(step, TableJoin):
            found += sources(step.other)
    return found


def key_fields(table: WindowTable) -> list[list[tuple[str, str]]]:
    """For each of `sources` the (name under the query, column) of each part of its key, in one order for all."""
    found = [
        [
            (name, text_of(value))
            for name, value in table.names
            if not isinstance(value, Number) and text_of(value) != VALUE
        ]
    ]
    for step in table.steps:
        if isinstance(step, TableJoin):
            found += key_fields(step.other)
    return found


def kinds_of(node: Node) -> dict[str, Kind]:
    """Columns of a node."""
    match node:
        case PacketSource():
            return dict(PACKET_KINDS)
        case DistinctNode(source, _, values):
            inner = kinds_of(source)
            return {text_of(value): kind_of(value, inner) for value in values}
        case ReduceNode(source, _, keys):
            inner = kinds_of(source)
            return {**{text_of(key): kind_of(key, inner) for key in keys}, VALUE: "number"}


def conjuncts(condition: Expression) -> tuple[Expression, ...]:
    """`a and b` as (a, b)."""
    if isinstance(condition, BinaryOperation) and condition.operator == "and":
        return (*conjuncts(condition.left), *conjuncts(condition.right))
    return (condition,)


class _Walk:
    """Steps turned into nodes, up to the first that needs the whole window."""

    def __init__(self, gate: Gate | None) -> None:
        self._gate = gate
        self.node: Node = PacketSource(())
        self.filters: tuple[Expression, ...] = ()
        self.names: dict[str, Expression] = {name: Field(name) for name in PACKET_KINDS}

    def take(self, step: Step) -> bool:
        """Whether the step went into the graph."""
        match step:
            case Filter(condition):
                self.filters += conjuncts(substitute(condition, self.names))
            case Map(fields):
                self.names = {name: substitute(value, self.names) for name, value in fields}
            case Distinct():
                self._distinct()
            case Reduce():
                self._reduce(step)
            case Join():
                return False
        return True

    def _source(self) -> tuple[Node, tuple[Expression, ...]]:
        if isinstance(self.node, PacketSource):
            return PacketSource(self.node.filters + self.filters, False, self._gate, self._gate_key()), ()
        return self.node, self.filters

    def _gate_key(self) -> Expression | None:
        if self._gate is None:
            return None
        key = self.names.get(self._gate.name)
        if key is None or kind_of(key, PACKET_KINDS) != kind_of(self._gate.key, PACKET_KINDS):
            raise QueryError(
                f"a map before the first distinct or reduce makes {self._gate.name}, which has the gate"
            )
        return key

    def _distinct(self) -> None:
        source, filters = self._source()
        values = tuple(sorted(set(self.names.values()), key=text_of))
        if isinstance(source, PacketSource):
            used = {name for part in (*source.filters, *values) for name in fields_of(part)}
            # which packet of a flow is the first behind a gate, is not known before
            once = used <= FLOW_FIELDS and source.gate is None
            source = msgspec.structs.replace(source, once=once)
        self.node, self.filters = DistinctNode(source, filters, values), ()
        self.names = {name: Field(text_of(value)) for name, value in self.names.items()}

    def _reduce(self, step: Reduce) -> None:
        source, filters = self._source()
        keys = {name: self.names[name] for name in step.keys}
        value = substitute(step.value, self.names)
        ordered = tuple(sorted(set(keys.values()), key=text_of))
        self.node, self.filters = ReduceNode(source, filters, ordered, step.function, value), ()
        self.names = {name: Field(text_of(key)) for name, key in keys.items()}
        self.names[step.name] = Field(VALUE)


def _compile(steps: Pipeline, gate: Gate | None) -> WindowTable:
    walk = _Walk(gate)
    rest = list(steps)
    while rest and not isinstance(walk.node, ReduceNode) and walk.take(rest[0]):
        rest.pop(0)
    node, filters = walk._source()  # noqa: SLF001 - both belong together
    return WindowTable(
        node, filters, tuple(sorted(walk.names.items())), tuple(_table_step(step, gate) for step in rest)
    )


def _table_step(step: Step, gate: Gate | None) -> TableStep:
    if isinstance(step, Join):
        return TableJoin(_compile(step.other, gate), step.keys, step.kind)
    return step


def _crossing(table: WindowTable) -> Crossing | None:
    """The table as a crossing, where its value only grows and all that follows is one threshold."""
    names = dict(table.names)
    if isinstance(table.node, DistinctNode):
        only_maps = not table.filters and all(isinstance(step, Map) for step in table.steps)
        return Crossing(table.node, 1, _renamed(names, table.steps)) if only_maps else None
    if not _grows(table.node) or not table.steps or not isinstance(table.steps[0], Filter):
        return None
    threshold = _threshold(substitute(table.steps[0].condition, names))
    rest = table.steps[1:]
    if threshold is None or not all(isinstance(step, Map) for step in rest):
        return None
    return Crossing(table.node, threshold, _renamed(names, rest))


def _renamed(names: dict[str, Expression], steps: tuple[TableStep, ...]) -> Names:
    for step in steps:
        if isinstance(step, Map):
            names = {name: substitute(value, names) for name, value in step.fields}
    return tuple(sorted(names.items()))


def _grows(node: Node) -> bool:
    if not isinstance(node, ReduceNode) or node.function != "sum":
        return False
    value = node.value
    return (isinstance(value, Number) and value.value > 0) or value == Field("length")


def _threshold(condition: Expression) -> int | None:
    """N of `# >= N`; `# > N` is `# >= N + 1`."""
    match condition:
        case BinaryOperation(">=", Field("#"), Number(value)) if value >= 1:
            return value
        case BinaryOperation(">", Field("#"), Number(value)) if value >= 0:
            return value + 1
        case _:
            return None
