"""Counts of single keys → the rows that a query computes from them."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec
import numpy as np

from apps.sonata_adapter.host.columns import PacketColumns, Tuples, address_number, plain_value
from apps.sonata_adapter.host.evaluation import SIX, column_of
from apps.sonata_adapter.host.relations import relation_of
from apps.sonata_adapter.query.dataflow import (
    VALUE,
    DistinctNode,
    ReduceNode,
    TableJoin,
    TableStep,
    WindowTable,
    compile_query,
    key_fields,
    kinds_of,
    sources,
)
from apps.sonata_adapter.query.expressions import Expression, Field
from apps.sonata_adapter.query.language import Filter, Query
from apps.sonata_adapter.switch.cell_read import CellRead
from due import RecordBatch

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
"""Where a key's value is in the request to read its cell."""

_TOLD_ADDRESSES: Final = {"source": "src", "destination": "dst"}


class RegisterTables:
    """What one query computes from the counts of keys: `sources` in the order of `dataflow.sources`."""

    def __init__(self, query: Query) -> None:
        table = compile_query(query)
        assert isinstance(table, WindowTable)  # noqa: S101 - the planner sees to it
        self._kinds = query.fields
        self._table = table
        self._open = _unfiltered(table)
        self._nodes = [node for node in sources(table) if isinstance(node, ReduceNode)]
        self._keys = key_fields(table)

    def fields(self, source: int) -> list[str]:
        """The packet field of each part of a key."""
        return [name for _, name in self._keys[source]]

    def question(self, bit: int, source: int, key: Key, time_us: int) -> CellRead:
        """The question about the cell of a key."""
        parts = dict.fromkeys(PART.values(), 0)
        for name, value in zip(self.fields(source), key, strict=True):
            parts[PART[name]] = address_number(value) if len(value) == 2 else value[0]
        return CellRead(
            bit=bit,
            time_us=time_us,
            source=parts["source"],
            destination=parts["destination"],
            port=parts["port"],
            length=parts["length"],
            source_port=parts["source_port"],
        )

    def keys(self, source: int, packets: PacketColumns) -> list[Key]:
        """The key of each packet."""
        return _rows([Field(name) for name in self.fields(source)], packets)

    def told(self, source: int, batch: RecordBatch) -> list[Key]:
        """The key of each count that the switch reported by itself."""
        parts = {
            name: list(zip(*(column.tolist() for column in _told(name, batch)), strict=True))
            for name in self.fields(source)
        }
        return list(zip(*parts.values(), strict=True))

    def tuples(self, source: int, packets: PacketColumns) -> list[Key]:
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

    def _made(self, table: WindowTable, counts: list[tuple[Key, Mapping[int, int]]]) -> list[dict[str, Any]]:
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


def _told(name: str, batch: RecordBatch) -> tuple[np.ndarray, ...]:
    """A part of the keys, as columns of packets have it."""
    place = _TOLD_ADDRESSES.get(PART[name])
    if place is None:
        return (batch[PART[name]],)
    high = batch[f"{place}_hi"]
    return np.where(high == 0, high, high ^ np.uint64(SIX)), batch[f"{place}_lo"]


def _unfiltered(table: WindowTable) -> WindowTable:
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


def _rows(values: "list[Field] | tuple[Expression, ...]", packets: PacketColumns) -> list[Key]:
    """The values of each packet, plain."""
    columns = [column_of(value, packets) for value in values]
    parts = [list(zip(*(part.tolist() for part in column), strict=True)) for column in columns]
    return list(zip(*parts, strict=True))
