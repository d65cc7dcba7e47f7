"""Splitting a query into independent shards, by keys that all its steps share.

ddos counts sources by destination: packets to one destination stay together, and no shard needs to
know of another.  If no key runs through all steps, there is one shard.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.evaluation import column_of
from apps.sonata_adapter.host.operators import filtered
from apps.sonata_adapter.query.dataflow import (
    DistinctNode,
    Node,
    Outcome,
    PacketSource,
    ReduceNode,
    TableJoin,
    TableStep,
    WindowTable,
    compile_query,
    conjuncts,
)
from apps.sonata_adapter.query.expressions import PACKET_FIELDS, Expression, Field
from apps.sonata_adapter.query.language import Distinct, Filter, Map, Query, Reduce

_ODD: Final = np.uint64(0x9E3779B97F4A7C15)
_SHIFT: Final = np.uint64(40)

Part = tuple[PacketSource, tuple[Expression, ...]]
"""Packets of one source, and the fields that choose the shard; none: all to shard 0."""


def parts_of(query: Query) -> list[Part]:
    """The packet sources of a query, with the fields that choose the shard."""
    outcome = compile_query(query)
    if not isinstance(outcome, WindowTable):
        return [(_packets(outcome.node), _own_keys(outcome))]
    gate = query.gated
    counted = [] if gate is None else [PacketSource(conjuncts(gate.condition))]
    for name in dict(outcome.names):
        fields = _follow(outcome, name)
        if fields is not None and (gate is None or name == gate.name):
            found = zip(_sources(outcome), fields, strict=True)
            gates = [(source, (gate.key,)) for source in counted if gate is not None]
            return [*gates, *((_packets(node), (field,)) for node, field in found)]
    return [*((source, ()) for source in counted), *((_packets(node), ()) for node in _sources(outcome))]


def shard_rows(part: Part, packets: PacketColumns, shards: int) -> dict[int, NDArray[np.intp]]:
    """For each shard that gets any: the rows of the batch that one source gives it."""
    source, fields = part
    rows = filtered(packets, source.filters)
    if not len(rows):
        return {}
    mixed = np.zeros(len(rows), dtype=np.uint64)
    for field in fields:
        for half in column_of(field, rows):
            mixed = (mixed ^ half.astype(np.uint64)) * _ODD
    numbers = (mixed >> _SHIFT) % np.uint64(shards)
    return {int(number): rows.origin[numbers == number] for number in np.unique(numbers)}


def _packets(node: Node) -> PacketSource:
    while not isinstance(node, PacketSource):
        node = node.source
    return node


def _sources(table: WindowTable) -> list[Node]:
    found = [table.node]
    for step in table.steps:
        if isinstance(step, TableJoin):
            found += _sources(step.other)
    return found


def _own_keys(outcome: Outcome) -> tuple[Expression, ...]:
    """Keys of what is reported as it crosses; tuples of a distinct go by all their values."""
    match outcome.node:
        case ReduceNode(_, _, keys):
            return tuple(key for key in keys if _is_field(key)) if all(map(_is_field, keys)) else ()
        case DistinctNode(_, _, values):
            return values if all(map(_is_field, values)) else ()
        case _:
            return ()


def _follow(table: WindowTable, name: str) -> list[Expression] | None:
    """The packet field behind a name in each source, if the name runs through all steps unchanged."""
    first = dict(table.names).get(name)
    if first is None or not _is_field(first):
        return None
    found = [first]
    for step in table.steps:
        more = _through(step, name)
        if more is None:
            return None
        found += more
    return found


def _through(step: TableStep, name: str) -> list[Expression] | None:
    match step:
        case Filter() | Distinct():
            return []
        case Map(fields):
            return [] if dict(fields).get(name) == Field(name) else None
        case Reduce(keys=keys):
            return [] if name in keys else None
        case TableJoin(other, keys):
            return _follow(other, name) if name in keys else None


def _is_field(value: Expression) -> bool:
    return isinstance(value, Field) and value.name in PACKET_FIELDS


def union(rows: Sequence[NDArray[np.intp]]) -> NDArray[np.intp]:
    """Rows of several sources, each once, in order."""
    return np.unique(np.concatenate(rows))
