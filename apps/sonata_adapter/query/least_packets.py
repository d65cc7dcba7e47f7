"""How many packets a window needs before a query can report anything.

A count grows by one a packet, so `syns + syn_acks - acks >= 40` cannot hold in a window of nineteen packets:
the host need not evaluate it.  Most windows of a network at peace are of that kind.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

from apps.sonata_adapter.query.dataflow import (
    VALUE,
    Crossing,
    DistinctNode,
    Node,
    Outcome,
    PacketSource,
    ReduceNode,
    TableJoin,
    WindowTable,
    conjuncts,
    sources,
)
from apps.sonata_adapter.query.expressions import (
    PAYLOAD_FIELDS,
    BinaryOperation,
    Expression,
    Field,
    Number,
    fields_of,
)
from apps.sonata_adapter.query.language import Filter, Map, Reduce

_ANY: Final = 1


class _Most(NamedTuple):
    """A value is at most `slope` times the packets, plus `offset`, and not negative where `sound` says so."""

    slope: int
    offset: int
    sound: bool


_Bounds = Mapping[str, _Most]


def least_packets(outcome: Outcome) -> int:
    """The fewest packets of a window with which the query can report anything; 1 where that is not known.

    Payloads are always looked at: that they were not copied has to be told, also where nothing would cross.
    """
    if any(_reads_payload(node) for node in _nodes(outcome)):
        return _ANY
    match outcome:
        case Crossing(node, threshold):
            most = _value_of(node)
            return _ANY if most is None else _reached(most, threshold)
        case WindowTable():
            return _table(outcome)[0]
        case _:
            return _ANY


def _nodes(outcome: Outcome) -> list[Node]:
    return sources(outcome) if isinstance(outcome, WindowTable) else [outcome.node]


def _reads_payload(node: Node) -> bool:
    made = [] if isinstance(node, PacketSource) else _made(node)
    names = {name for value in (*node.filters, *made) for name in fields_of(value)}
    if names & (PAYLOAD_FIELDS | {"payload"}):
        return True
    return not isinstance(node, PacketSource) and _reads_payload(node.source)


def _made(node: DistinctNode | ReduceNode) -> tuple[Expression, ...]:
    return node.values if isinstance(node, DistinctNode) else (*node.keys, node.value)


def _value_of(node: Node) -> _Most | None:
    """The bound of a node's value."""
    match node:
        case ReduceNode(function="sum", value=Number(value)) if value > 0:
            return _Most(value, 0, sound=True)
        case _:
            return None


def _table(table: WindowTable) -> tuple[int, dict[str, _Most]]:
    """Packets that a table needs to have a row after all its steps, and the bounds of its columns."""
    value = _value_of(table.node)
    columns: dict[str, _Most] = {} if value is None else {VALUE: value}
    least = max((_needed(each, columns) for each in table.filters), default=_ANY)
    bounds = {name: most for name, made in table.names if (most := _most(made, columns)) is not None}
    # a row a packet at most, until a join may pair one row with many
    few_rows = True
    for step in table.steps:
        match step:
            case Filter(condition):
                least = max(least, *(_needed(each, bounds) for each in conjuncts(condition)))
            case Map(fields):
                bounds = {name: most for name, made in fields if (most := _most(made, bounds)) is not None}
            case Reduce(function="sum", value=Number(number), name=name) if few_rows and number > 0:
                bounds = {name: _Most(number, 0, sound=True)}
            case Reduce():
                bounds = {}
            case TableJoin(other, keys, kind):
                needed, more = _table(other)
                if kind == "inner":
                    least = max(least, needed)
                if kind != "anti":
                    few_rows = False
                    # a row without a partner has 0 there
                    bounds = {**{name: most for name, most in more.items() if name not in keys}, **bounds}
            case _:
                pass
    return least, bounds


def _most(value: Expression, bounds: _Bounds) -> _Most | None:
    match value:
        case Field(name):
            return bounds.get(name)
        case Number(number):
            return _Most(0, number, number >= 0)
        case BinaryOperation("+" | "-" as operator, left, right):
            mine, other = _most(left, bounds), _most(right, bounds)
            if mine is None or other is None:
                return None
            if operator == "+":
                return _Most(mine.slope + other.slope, mine.offset + other.offset, mine.sound and other.sound)
            return _Most(mine.slope, mine.offset, sound=False) if other.sound else None
        case _:
            return None


def _needed(condition: Expression, bounds: _Bounds) -> int:
    """Packets without which a condition cannot hold."""
    match condition:
        case BinaryOperation(">=" | ">" | "==" as operator, left, Number(number)):
            most = _most(left, bounds)
            return _ANY if most is None else _reached(most, number + (operator == ">"))
        case _:
            return _ANY


def _reached(most: _Most, least: int) -> int:
    return max(_ANY, -((most.offset - least) // most.slope)) if most.slope > 0 else _ANY
