"""Counts of single keys → the rows that a query makes of them."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import msgspec
import numpy as np

from apps.sonata_adapter.columns import Packets, Tuples, plain_value
from apps.sonata_adapter.dataflow import (
    VALUE,
    DistinctNode,
    ReduceNode,
    Table,
    TableJoin,
    TableStep,
    kinds_of,
    sources,
)
from apps.sonata_adapter.evaluation import column_of
from apps.sonata_adapter.expressions import Expression, Field, Number, text_of
from apps.sonata_adapter.query import Filter, Query
from apps.sonata_adapter.relations import relation_of

Key = tuple[tuple[int, ...], ...]
"""Parts of each key column, in the order of their names under the query."""

PART: Final = {
    "ip.src": "source",
    "ip.dst": "destination",
    "tcp.sport": "source_port",
    "udp.sport": "source_port",
    "tcp.dport": "port",
    "udp.dport": "port",
    "length": "length",
}
"""Where a key's value stands in the question about its cell."""


class TallyTables:
    """What one query makes of the counts of keys: `sources` in the order of `dataflow.sources`."""

    def __init__(self, query: Query, table: Table) -> None:
        self._kinds = query.fields
        self._table = table
        self._open = _unfiltered(table)
        self._nodes = [node for node in sources(table) if isinstance(node, ReduceNode)]
        self._keys = [_key_names(each) for each in _tables(table)]

    def fields(self, source: int) -> list[str]:
        """The packet field of each part of a key."""
        return [name for _, name in self._keys[source]]

    def keys(self, source: int, packets: Packets) -> list[Key]:
        """The key of each packet."""
        return _rows([Field(name) for name in self.fields(source)], packets)

    def tuples(self, source: int, packets: Packets) -> list[Key]:
        """What the distinct before a source tells apart, of each packet."""
        node = self._nodes[source].source
        assert isinstance(node, DistinctNode)  # noqa: S101 - else nothing would stand behind a distinct
        return _rows(node.values, packets)

    def results(self, counts: Iterable[tuple[Key, Mapping[int, int]]]) -> list[dict[str, Any]]:
        """The rows that the query reports for these keys; counts by source."""
        return self._made(self._table, list(counts))

    def guesses(self, counts: Iterable[tuple[Key, Mapping[int, int]]]) -> list[dict[str, Any]]:
        """A row for each key, whether or not it meets the query's conditions."""
        return self._made(self._open, list(counts))

    def _made(self, table: Table, counts: list[tuple[Key, Mapping[int, int]]]) -> list[dict[str, Any]]:
        if not counts:
            return []
        relation = relation_of(table, lambda node: self._held(node, counts))
        columns = sorted(relation.columns.items())
        return [
            {name: plain_value(self._kinds[name], column, row) for name, column in columns}
            for row in range(relation.size)
        ]

    def _held(self, node: object, counts: list[tuple[Key, Mapping[int, int]]]) -> Tuples:
        """The counts of one source, as its operator would hold them."""
        place = next(place for place, other in enumerate(self._nodes) if other == node)
        held = [(key, values[place]) for key, values in counts if values.get(place)]
        inner = kinds_of(self._nodes[place])
        columns: dict[str, tuple[np.ndarray, ...]] = {}
        for column, (_, name) in enumerate(self._keys[place]):
            width = 2 if inner[name] == "address" else 1
            dtype = np.uint64 if width == 2 else np.int64
            columns[name] = tuple(
                np.array([key[column][part] for key, _ in held], dtype=dtype) for part in range(width)
            )
        columns[VALUE] = (np.array([n for _, n in held], dtype=np.int64),)
        return Tuples(columns, len(held))


def _unfiltered(table: Table) -> Table:
    """The table without its conditions: a key that one source holds makes a row."""
    steps: list[TableStep] = []
    for step in table.steps:
        match step:
            case Filter():
                continue
            case TableJoin(other):
                steps.append(msgspec.structs.replace(step, other=_unfiltered(other), kind="outer"))
            case _:
                steps.append(step)
    return msgspec.structs.replace(table, filters=(), steps=tuple(steps))


def _rows(values: "list[Field] | tuple[Expression, ...]", packets: Packets) -> list[Key]:
    """The values of each packet, plain."""
    columns = [column_of(value, packets) for value in values]
    parts = [list(zip(*(part.tolist() for part in column), strict=True)) for column in columns]
    return list(zip(*parts, strict=True))


def _tables(table: Table) -> Iterator[Table]:
    """The table and those joined to it, in the order of `sources`."""
    yield table
    for step in table.steps:
        other = getattr(step, "other", None)
        if isinstance(other, Table):
            yield from _tables(other)


def _key_names(table: Table) -> list[tuple[str, str]]:
    """(name under the query, packet field) of each key, sorted: the same order for all sources."""
    return [
        (name, text_of(value))
        for name, value in table.names
        if not isinstance(value, Number) and text_of(value) != VALUE
    ]
