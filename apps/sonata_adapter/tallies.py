"""Counts that are read from the switch at a window's end, for the keys that may become results.

report: a key reached its candidate count ─► when the window is over, read its cells of all sources
report: a key has no cell                 ─► counted here, exactly
answers ─► the query's own steps over these keys ─► results
"""

from collections.abc import Iterator
from itertools import count
from typing import Final

import msgspec
import numpy as np

from apps.sonata_adapter.columns import Packets, Tuples, address_number, column_of, plain_value
from apps.sonata_adapter.dataflow import VALUE, ReduceNode, Table, compile_query, kinds_of, sources
from apps.sonata_adapter.expressions import Field, Number, text_of
from apps.sonata_adapter.planner import QueryPlan
from apps.sonata_adapter.query import Query
from apps.sonata_adapter.relations import relation_of
from apps.sonata_adapter.results import Result
from due import RecordBatch

TIMEOUT_S: Final = 2.0
_Key = tuple[tuple[int, ...], ...]
"""Parts of each key column, in the order of their names under the query."""


class CellRead(msgspec.Struct, frozen=True, kw_only=True):
    """A question to the switch: the count of a key in a window."""

    id: int
    bit: int
    source: int
    destination: int
    port: int
    length: int
    time_us: int


class _Window:
    """What is known of one window."""

    def __init__(self) -> None:
        self.candidates: dict[_Key, None] = {}
        self.counts: dict[tuple[int, _Key], int] = {}
        self.waiting: set[int] = set()
        self.asked: float | None = None
        self.error = ""


class Tallies:
    """One query on one switch."""

    def __init__(
        self, query: Query, found: QueryPlan, *, base_us: int = 0, since_us: int | None = None
    ) -> None:
        outcome = compile_query(query)
        assert isinstance(outcome, Table)  # noqa: S101 - the planner sees to it
        self._query = query
        self._table = outcome
        self._base_us = base_us
        self._since_us = since_us
        self._nodes = [node for node in sources(outcome) if isinstance(node, ReduceNode)]
        self._keys = [_key_names(table) for table in _tables(outcome)]
        self._entries = {entry.bit: entry for entry in found.entries}
        self._windows: dict[int, _Window] = {}
        self._questions: dict[int, tuple[int, int, _Key]] = {}
        self._numbers = count(1)
        self.tuples = 0

    def take(self, bit: int, batch: RecordBatch) -> list[Result]:
        """Note candidates and keys without a cell; results come with the answers."""
        self.tuples += len(batch)
        entry = self._entries[bit]
        packets = Packets(batch)
        columns = [column_of(Field(name), packets) for _, name in self._keys[entry.source]]
        times = ((batch["time_us"] - self._base_us) // self._query.window_us).tolist()
        over = batch["overflow"].tolist()
        amounts = batch["length"].tolist() if entry.by_bytes else [1] * len(batch)
        for row, number in enumerate(times):
            key = tuple(tuple(int(part[row]) for part in column) for column in columns)
            window = self._windows.setdefault(number, _Window())
            window.candidates[key] = None
            if over[row]:
                place = (entry.source, key)
                window.counts[place] = window.counts.get(place, 0) + amounts[row]
        return []

    def due(self, now_us: int, now: float) -> list[CellRead]:
        """Questions about windows that are over at capture time `now_us`."""
        asked: list[CellRead] = []
        for number, window in self._windows.items():
            if window.asked is None and self._end(number) <= now_us:
                window.asked = now
                asked += self._ask(number, window)
        return asked

    def answer(self, question: int, counted: int, now_us: int) -> list[Result]:
        """The count of a key; results once all of its window are there."""
        number, source, key = self._questions.pop(question, (None, 0, ()))
        window = None if number is None else self._windows.get(number)
        if number is None or window is None:
            return []
        self.tuples += 1
        window.counts[source, key] = counted
        window.waiting.discard(question)
        if now_us >= self._end(number + 1):
            window.error = "cells were read when a later window had begun to overwrite them"
        return self._finished(number, window)

    def expire(self, now: float) -> list[Result]:
        """Results of windows whose answers are overdue, as estimates."""
        found: list[Result] = []
        for number, window in list(self._windows.items()):
            if window.asked is not None and now - window.asked >= TIMEOUT_S:
                window.error = f"{len(window.waiting)} cells could not be read"
                for question in window.waiting:
                    self._questions.pop(question, None)
                window.waiting.clear()
                found += self._finished(number, window)
        return found

    def _end(self, number: int) -> int:
        return self._base_us + (number + 1) * self._query.window_us

    def _ask(self, number: int, window: _Window) -> Iterator[CellRead]:
        for key in window.candidates:
            for entry in self._entries.values():
                if (entry.source, key) in window.counts:
                    continue
                question = next(self._numbers)
                self._questions[question] = (number, entry.source, key)
                window.waiting.add(question)
                parts = dict.fromkeys(("source", "destination", "port", "length"), 0)
                for (_, name), value in zip(self._keys[entry.source], key, strict=True):
                    parts[_PART[name]] = address_number(value) if len(value) == 2 else value[0]
                yield CellRead(
                    id=question,
                    bit=entry.bit,
                    time_us=self._end(number) - self._query.window_us // 2,
                    **parts,
                )

    def _finished(self, number: int, window: _Window) -> list[Result]:
        if window.waiting:
            return []
        del self._windows[number]
        relation = relation_of(self._table, lambda node: self._tuples(node, window))
        kinds = self._query.fields
        start = self._base_us + number * self._query.window_us
        return [
            Result(
                query=self._query.name,
                window_us=start,
                length_us=self._query.window_us,
                at_us=self._end(number),
                fields={
                    name: plain_value(kinds[name], column, row)
                    for name, column in sorted(relation.columns.items())
                },
                exact=not window.error,
                partial=self._since_us is not None and self._since_us > start,
                error=window.error,
            )
            for row in range(relation.size)
        ]

    def _tuples(self, node: object, window: _Window) -> Tuples:
        """The candidates' counts in one source, as its operator would hold them."""
        place = next(place for place, other in enumerate(self._nodes) if other == node)
        held = [(key, n) for (source, key), n in window.counts.items() if source == place and n > 0]
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


_PART: Final = {
    "ip.src": "source",
    "ip.dst": "destination",
    "tcp.dport": "port",
    "udp.dport": "port",
    "length": "length",
}


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
