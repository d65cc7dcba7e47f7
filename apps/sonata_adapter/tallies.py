"""Counts that are read from the switch at a window's end, for the keys that may become results.

report: a key reached its candidate count ─► when the window is over, read its cells of all sources
report: a key has no cell                 ─► counted here, exactly
answers ─► the query's own steps over these keys ─► results

When a window is over is known from the switch's clock, that is, from what it sends.  Where it sends
nothing for a whole window and a while, this machine's clock decides, and the results say so.
"""

from collections.abc import Iterator
from itertools import count
from typing import Final

import msgspec
import numpy as np

from apps.sonata_adapter.columns import Packets, Tuples, address_number, column_of, plain_value
from apps.sonata_adapter.dataflow import (
    VALUE,
    DistinctNode,
    ReduceNode,
    Table,
    compile_query,
    kinds_of,
    sources,
)
from apps.sonata_adapter.expressions import Expression, Field, Number, text_of
from apps.sonata_adapter.placement import Entry
from apps.sonata_adapter.planner import QueryPlan
from apps.sonata_adapter.query import Query
from apps.sonata_adapter.relations import relation_of
from apps.sonata_adapter.results import Result
from due import RecordBatch

TIMEOUT_S: Final = 10.0
PATIENCE_S: Final = 10.0
"""A switch that is silent for a window and so long is taken to have nothing to say, not to be slow."""
MOST_KEYS: Final = 16_384
"""Keys of one window that are asked for; a result that would need more says that it is an estimate."""
_Key = tuple[tuple[int, ...], ...]
"""Parts of each key column, in the order of their names under the query."""
_NUMBERS: Final = count(1)


class CellRead(msgspec.Struct, frozen=True, kw_only=True):
    """A question to the switch: the count of a key in a window."""

    id: int
    """Unlike that of any other question of this process."""
    bit: int
    source: int
    destination: int
    port: int
    length: int
    source_port: int
    time_us: int


class _Window:
    """What is known of one window."""

    def __init__(self) -> None:
        self.candidates: dict[_Key, None] = {}
        self.beyond = 0
        self.counts: dict[tuple[int, _Key], int] = {}
        """By bit of the reduce: frames or bytes of keys without a cell, or the cell's value."""
        self.tuples: dict[tuple[int, _Key], set[_Key]] = {}
        """By bit of the reduce: new tuples of the distinct before it that had no cell."""
        self.reported: set[tuple[int, _Key]] = set()
        self.waiting: set[int] = set()
        self.asked: float | None = None
        self.errors: dict[str, None] = {}


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
        self._reduces = {entry.bit: entry for entry in found.entries if entry.role == "reduce"}
        self._windows: dict[int, _Window] = {}
        self._questions: dict[int, tuple[int, int, _Key]] = {}
        self.tuples = 0
        self.missed = 0
        """Cells that were read too late: a later window had overwritten them."""

    def take(self, bit: int, batch: RecordBatch) -> list[Result]:
        """Note candidates and keys without a cell; results come with the answers."""
        self.tuples += len(batch)
        packets = Packets(batch)
        numbers = ((batch["time_us"] - self._base_us) // self._query.window_us).tolist()
        entry = self._reduces.get(bit)
        if entry is not None:
            self._counted(entry, packets, numbers, batch)
        for behind in [each for each in self._reduces.values() if each.behind == bit]:
            self._distinct(behind, packets, numbers)
        return []

    def _counted(self, entry: Entry, packets: Packets, numbers: list[int], batch: RecordBatch) -> None:
        """Keys that reached the candidate count, and frames whose key has no cell."""
        over = batch["overflow"].tolist()
        amounts = batch["length"].tolist() if entry.by_bytes else [1] * len(batch)
        fields = [Field(name) for _, name in self._keys[entry.source]]
        for number, key, without_cell, amount in zip(
            numbers, _rows(fields, packets), over, amounts, strict=True
        ):
            window = self._windows.setdefault(number, _Window())
            place = (entry.bit, key)
            if without_cell:
                window.counts[place] = window.counts.get(place, 0) + amount
            else:
                window.reported.add(place)
            if entry.threshold and window.counts.get(place, entry.threshold) >= entry.threshold:
                _remember(window, key)

    def _distinct(self, entry: Entry, packets: Packets, numbers: list[int]) -> None:
        """Tuples that found no cell in the stage of the distinct: they are told apart here."""
        node = self._nodes[entry.source].source
        assert isinstance(node, DistinctNode)  # noqa: S101 - else nothing would stand behind a distinct
        keys = _rows([Field(name) for _, name in self._keys[entry.source]], packets)
        for number, key, values in zip(numbers, keys, _rows(node.values, packets), strict=True):
            window = self._windows.setdefault(number, _Window())
            if entry.threshold:
                _remember(window, key)
            held = window.tuples.setdefault((entry.bit, key), set())
            if len(held) < MOST_KEYS:
                held.add(values)
            elif values not in held:
                window.errors["a key had too many tuples without a cell in the switch"] = None

    def due(self, now_us: int, now: float, *, idle_s: float = 0.0) -> list[CellRead]:
        """Questions about windows that are over at capture time `now_us`.

        `idle_s`: so long the switch's clock has not been heard of.
        """
        asked: list[CellRead] = []
        for number, window in self._windows.items():
            is_over = self._end(number) <= now_us
            if not is_over and idle_s >= self._query.window_us / 1e6 + PATIENCE_S:
                is_over = True
                window.errors["the switch sent nothing; the end was taken from this machine's clock"] = None
            if window.asked is None and is_over:
                asked += self._begin(number, window, now)
        return asked

    def finish(self, now: float) -> list[CellRead]:
        """Questions about all windows: nothing more will come."""
        return [
            read
            for number, window in self._windows.items()
            if window.asked is None
            for read in self._begin(number, window, now)
        ]

    def waits_for(self, question: int) -> bool:
        return question in self._questions

    @property
    def waiting(self) -> bool:
        """Whether an answer is outstanding."""
        return bool(self._questions)

    @property
    def open(self) -> int:
        """Windows that results may still come of."""
        return len(self._windows)

    def answer(self, question: int, counted: int, now_us: int) -> list[Result]:
        """The count of a key; results once all of its window are there."""
        number, bit, key = self._questions.pop(question, (None, 0, ()))
        window = None if number is None else self._windows.get(number)
        if number is None or window is None:
            return []
        self.tuples += 1
        window.counts[bit, key] = counted
        window.waiting.discard(question)
        missed = (bit, key) in window.reported and counted < self._reduces[bit].threshold
        self.missed += missed
        if missed or now_us >= self._end(number + 1):
            window.errors["cells were read when a later window had begun to overwrite them"] = None
        return self._finished(number, window)

    def expire(self, now: float) -> list[Result]:
        """Results of windows that have nothing to wait for, or whose answers are overdue: as estimates."""
        found: list[Result] = []
        for number, window in list(self._windows.items()):
            overdue = window.asked is not None and now - window.asked >= TIMEOUT_S
            if overdue and window.waiting:
                window.errors[f"{len(window.waiting)} cells could not be read"] = None
                for question in window.waiting:
                    self._questions.pop(question, None)
                window.waiting.clear()
            if window.asked is not None and not window.waiting:
                found += self._finished(number, window)
        return found

    def _end(self, number: int) -> int:
        return self._base_us + (number + 1) * self._query.window_us

    def _begin(self, number: int, window: _Window, now: float) -> list[CellRead]:
        window.asked = now
        if window.beyond:
            window.errors[f"{window.beyond} keys beyond the bound of {MOST_KEYS} were not looked at"] = None
        return list(self._ask(number, window))

    def _ask(self, number: int, window: _Window) -> Iterator[CellRead]:
        for key in window.candidates:
            for entry in self._reduces.values():
                if (entry.bit, key) in window.counts:
                    continue
                question = next(_NUMBERS)
                self._questions[question] = (number, entry.bit, key)
                window.waiting.add(question)
                parts = dict.fromkeys(_PART.values(), 0)
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
                exact=not window.errors,
                partial=self._since_us is not None and self._since_us > start,
                error="; ".join(window.errors),
            )
            for row in range(relation.size)
        ]

    def _tuples(self, node: object, window: _Window) -> Tuples:
        """The candidates' counts in one source, as its operator would hold them."""
        place = next(place for place, other in enumerate(self._nodes) if other == node)
        bits = [entry.bit for entry in self._reduces.values() if entry.source == place]
        held: list[tuple[_Key, int]] = []
        for key in window.candidates:
            value = sum(window.counts.get((bit, key), 0) for bit in bits)
            value += sum(len(window.tuples.get((bit, key), ())) for bit in bits)
            if value:
                held.append((key, value))
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
    "tcp.sport": "source_port",
    "udp.sport": "source_port",
    "tcp.dport": "port",
    "udp.dport": "port",
    "length": "length",
}


def _remember(window: _Window, key: _Key) -> None:
    if key in window.candidates:
        return
    if len(window.candidates) < MOST_KEYS:
        window.candidates[key] = None
    else:
        window.beyond += 1


def _rows(values: "list[Field] | tuple[Expression, ...]", packets: Packets) -> list[_Key]:
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
