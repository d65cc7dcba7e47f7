"""All host queries over one stream of packet batches, windowed on capture time.

    batch ─► windows [n·W, (n+1)·W) ─► operators, shared among queries ─► crossings at once
                                                                      └─► tables when the window closes

A window closes when a packet is `lateness_us` beyond its end (at most a quarter of the window), or on
`advance` or `finish`.  Packets of a closed window are left out and counted in `late`.  Captured packets pass
at once, whatever their window.

A window's packets are held back until there are as many as a query needs to report anything: most windows of
a network at peace end before, and cost nothing.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Set
from itertools import pairwise
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.columns import Numberings, PacketColumns, Tuples, plain_value
from apps.sonata_adapter.host.evaluation import TupleRows, column_of
from apps.sonata_adapter.host.flows import SeenFlows
from apps.sonata_adapter.host.gates import GateOperator, split_by_payload
from apps.sonata_adapter.host.operators import (
    Crossed,
    DistinctOperator,
    ReduceOperator,
    Reported,
    Update,
    filtered,
)
from apps.sonata_adapter.host.relations import Relation, relation_of
from apps.sonata_adapter.query.dataflow import (
    Crossing,
    DistinctNode,
    Node,
    Outcome,
    PacketSource,
    ReduceNode,
    TupleStream,
    WindowTable,
    compile_query,
    kinds_of,
    sources,
)
from apps.sonata_adapter.query.expressions import Kind, kind_of
from apps.sonata_adapter.query.language import PACKET_KINDS, Gate, Query
from apps.sonata_adapter.query.least_packets import least_packets
from apps.sonata_adapter.results import Captured, QueryResult
from due import RecordBatch

DEFAULT_LIMIT: Final = 1 << 20
DEFAULT_LATENESS_US: Final = 500_000
_ROOM: Final = 2
"""Initial table size relative to the previous window's; fuller tables are slower."""
_MOST_HELD: Final = 64
"""Batches of which a window holds packets back; each stays in memory as a whole."""
_Rows = slice | NDArray[np.intp] | None
"""Rows of a batch; None: all."""
_NEW_FLOWS: Final = PacketSource((), once=True)
"""The source of all nodes that need only the first packet of each flow."""


class _Running:
    """A query in force."""

    def __init__(self, query: Query, since_us: int | None) -> None:
        self.name = query.name
        self.window_us = query.window_us
        self.outcome: Outcome = compile_query(query)
        self.least = least_packets(self.outcome)
        self.kinds = query.fields
        self.since_us = since_us
        """Capture time when it came into force, or the clock was set back; None: before the first packet."""

    def nodes(self) -> list[Node]:
        return sources(self.outcome) if isinstance(self.outcome, WindowTable) else [self.outcome.node]


class _Window:
    """State of all operators of one window length in one window."""

    def __init__(
        self, start_us: int, length_us: int, limit: int, flows: SeenFlows, expected: Mapping[Node, int]
    ) -> None:
        self.start_us = start_us
        self.length_us = length_us
        self._limit = limit
        self._expected = expected
        """Number of keys per node in the previous window."""
        self._distincts: dict[DistinctNode, DistinctOperator] = {}
        self._reduces: dict[ReduceNode, ReduceOperator] = {}
        self._reported: dict[str, Reported] = {}
        self._gates: dict[Gate, GateOperator] = {}
        self._flows = flows
        self._kept: Set[Node] = frozenset()
        self.packets = 0
        self.held: list[tuple[RecordBatch, _Rows]] = []
        """Packets that no operator has seen yet."""
        self.fed = False

    def keep(self, nodes: Set[Node]) -> None:
        """Keep the tables of these nodes until the window's end."""
        self._kept = nodes
        for node, distinct in self._distincts.items():
            distinct.kept = node in nodes

    def feed(
        self, node: Node, packets: PacketColumns, memo: dict[Node, TupleRows | Update]
    ) -> TupleRows | Update:
        """The output of a node for the packets; each node processes them once."""
        found = memo.get(node)
        if found is None:
            found = memo[node] = self._feed(node, packets, memo)
        return found

    def _feed(
        self, node: Node, packets: PacketColumns, memo: dict[Node, TupleRows | Update]
    ) -> TupleRows | Update:
        if isinstance(node, PacketSource):
            return self._packets(node, packets, memo)
        rows = self.feed(node.source, packets, memo)
        assert not isinstance(rows, Update)  # noqa: S101 - a reduce has no successor in a graph
        if isinstance(node, DistinctNode):
            distinct = self._distincts.get(node)
            if distinct is None:
                distinct = self._distincts[node] = DistinctOperator(
                    node, self._limit, _ROOM * self._expected.get(node, 0)
                )
                distinct.kept = node in self._kept
            return distinct.take(rows)
        reduce = self._reduces.get(node)
        if reduce is None:
            expected = _ROOM * self._expected.get(node, 0)
            reduce = self._reduces[node] = ReduceOperator(node, self._limit, expected)
        return reduce.take(rows)

    def _packets(
        self, node: PacketSource, packets: PacketColumns, memo: dict[Node, TupleRows | Update]
    ) -> TupleRows | Update:
        if node == _NEW_FLOWS:
            self._flows.begin(self.start_us)
            return self._flows.new(packets)
        rows = self.feed(_NEW_FLOWS, packets, memo) if node.once else packets
        assert not isinstance(rows, Update)  # noqa: S101 - packets are rows
        if node.gate is None or node.gate_key is None:
            return filtered(rows, node.filters)
        headers, payloads = split_by_payload(node.filters)
        gate = self._gates.get(node.gate)
        if gate is None:
            gate = self._gates[node.gate] = GateOperator(node.gate, self._limit)
        some = filtered(packets, headers)
        assert isinstance(some, PacketColumns)  # noqa: S101 - packets stay packets
        return filtered(gate.passed(packets, some, node.gate_key), payloads)

    def reported(self, query: str) -> Reported:
        return self._reported.setdefault(query, Reported(self._limit))

    def sizes(self) -> dict[Node, int]:
        """How many keys each node holds."""
        found: dict[Node, int] = {node: operator.size for node, operator in self._distincts.items()}
        return found | {node: operator.size for node, operator in self._reduces.items()}

    def relation(self, table: WindowTable) -> Relation:
        """A table after all its steps."""
        return relation_of(table, self._table)

    def _table(self, node: Node) -> Tuples:
        if isinstance(node, DistinctNode):
            distinct = self._distincts.get(node) or DistinctOperator(node, 1)
            return distinct.table()
        assert isinstance(node, ReduceNode)  # noqa: S101 - packets alone make no table
        reduce = self._reduces.get(node) or ReduceOperator(node, 1)
        return reduce.table()

    def error(self, nodes: Iterable[Node]) -> str:
        """Why results from these nodes are estimates; empty: they are exact."""
        found = [text for node in nodes for text in self._errors(node)]
        return "; ".join(dict.fromkeys(text for text in found if text))

    def _errors(self, node: Node) -> Iterator[str]:
        if isinstance(node, PacketSource):
            if node.gate in self._gates:
                yield self._gates[node.gate].error
            return
        operator = self._distincts.get(node) if isinstance(node, DistinctNode) else self._reduces.get(node)
        if operator is not None and operator.error:
            yield operator.error
        yield from self._errors(node.source)


class WindowEngine(Protocol):
    """Runs queries over batches: `HostEngine` or Spark."""

    base_us: int
    watermark_us: int | None
    packets: int
    late: int
    without_payload: int

    @property
    def names(self) -> set[str]: ...
    def add(self, query: Query) -> None: ...
    def remove(self, name: str) -> None: ...
    def process(
        self, batch: RecordBatch, *, horizon_us: int | None = None
    ) -> list[QueryResult | Captured]: ...
    def advance(self, now_us: int) -> list[QueryResult | Captured]: ...
    def set_back(self, now_us: int) -> list[QueryResult | Captured]: ...
    def finish(self) -> list[QueryResult | Captured]: ...
    def close(self) -> None: ...


class HostEngine:
    """Runs queries over batches; pure: time comes with the packets.

    `limit` is the number of keys that one operator keeps exactly in one window; windows are multiples
    of their length from `base_us`, the absolute time of the switch's clock zero.
    """

    def __init__(
        self, *, limit: int = DEFAULT_LIMIT, lateness_us: int = DEFAULT_LATENESS_US, base_us: int = 0
    ) -> None:
        self.base_us = base_us
        self._limit = limit
        self._lateness_us = lateness_us
        self._queries: dict[str, _Running] = {}
        self._windows: dict[tuple[int, int], _Window] = {}
        self._closed: dict[int, int] = {}
        self._flows: dict[int, SeenFlows] = {}
        self._numberings: Numberings = {}
        self._kept: Set[Node] = frozenset()
        self._sizes: dict[int, dict[Node, int]] = {}
        self.watermark_us: int | None = None
        self.packets = 0
        self.late = 0
        self.without_payload = 0
        self.results = 0

    @property
    def names(self) -> set[str]:
        """Queries in force."""
        return set(self._queries)

    def add(self, query: Query) -> None:
        """Bring a query into force under its name; raises `InvalidQuery`."""
        for (length, _), window in self._windows.items():
            # what came before a query is not the query's; so few packets have no result
            deque(self._released(window, self._by_length().get(length, [])), maxlen=0)
        self._queries[query.name] = _Running(query, self.watermark_us)
        self._keep_tables()
        for flows in self._flows.values():
            flows.forget()

    def remove(self, name: str) -> None:
        """Remove a query; its open windows are not reported."""
        self._queries.pop(name, None)
        lengths = {running.window_us for running in self._queries.values()}
        self._windows = {key: window for key, window in self._windows.items() if key[0] in lengths}
        self._flows = {length: flows for length, flows in self._flows.items() if length in lengths}
        self._sizes = {length: sizes for length, sizes in self._sizes.items() if length in lengths}
        self._numberings.clear()
        self._keep_tables()

    def _keep_tables(self) -> None:
        tables = [running for running in self._queries.values() if isinstance(running.outcome, WindowTable)]
        self._kept = frozenset(node for running in tables for node in running.nodes())
        for window in self._windows.values():
            window.keep(self._kept)

    def process(self, batch: RecordBatch, *, horizon_us: int | None = None) -> list[QueryResult | Captured]:
        """The results that the packets cause, in order.

        Windows close by the packets' own time; `horizon_us` says that earlier ones may still come.
        """
        if not len(batch) or not self._queries:
            return []
        self.packets += len(batch)
        times = batch["time_us"]
        first, last = int(times.min()), int(times.max())
        whole = PacketColumns(batch, self._numberings)
        outputs = list(self._streamed(whole))
        for length, queries in self._by_length().items():
            for index, rows in self._windows_of(whole, length, first - self.base_us, last - self.base_us):
                outputs += self._take(length, index, whole, rows, queries)
        self.without_payload += whole.missing.payloads
        whole.forget()
        outputs += self.advance(last if horizon_us is None else horizon_us)
        self.results += len(outputs)
        return outputs

    def advance(self, now_us: int) -> list[QueryResult | Captured]:
        """Advance capture time to `now_us` and close the windows that have ended."""
        self.watermark_us = max(now_us, self.watermark_us or now_us)
        over = [
            key
            for key in self._windows
            if self.base_us + (key[1] + 1) * key[0] + min(self._lateness_us, key[0] // 4) <= self.watermark_us
        ]
        return self._close(over)

    def set_back(self, now_us: int) -> list[QueryResult | Captured]:
        """The switch's clock was set back to `now_us`: close all windows, whose time it was not, and begin anew.

        The first windows are partial: their packets before `now_us` had another time.
        """
        found = self.finish()
        self._closed.clear()
        self._flows.clear()
        self.watermark_us = now_us
        for running in self._queries.values():
            running.since_us = now_us
        return found

    def finish(self) -> list[QueryResult | Captured]:
        """No more packets will come: close all windows."""
        return self._close(list(self._windows))

    def close(self) -> None:
        """There is nothing to release."""

    def _by_length(self) -> dict[int, list[_Running]]:
        found: dict[int, list[_Running]] = {}
        for running in self._queries.values():
            if not isinstance(running.outcome, TupleStream):
                found.setdefault(running.window_us, []).append(running)
        return found

    def _streamed(self, whole: PacketColumns) -> Iterator[QueryResult | Captured]:
        for running in self._queries.values():
            if isinstance(running.outcome, TupleStream):
                packets = filtered(whole, running.outcome.node.filters)
                yield from _captured(running, running.outcome, packets)

    def _windows_of(
        self, whole: PacketColumns, length: int, first: int, last: int
    ) -> Iterator[tuple[int, _Rows]]:
        closed = self._closed.get(length)
        if first // length == last // length:
            if closed is None or first // length > closed:
                yield first // length, None
            else:
                self.late += len(whole)
            return
        indices = (whole.batch["time_us"] - self.base_us) // length
        for index, rows in _parts(indices):
            if closed is None or index > closed:
                yield index, rows
            else:
                self.late += _count(rows, len(whole))

    def _take(
        self, length: int, index: int, whole: PacketColumns, rows: _Rows, queries: list[_Running]
    ) -> Iterator[QueryResult | Captured]:
        """Packets of a window: held back while they are too few for any result, then fed with those before."""
        window = self._windows.get((length, index))
        if window is None:
            flows = self._flows.setdefault(length, SeenFlows())
            start = self.base_us + index * length
            window = _Window(start, length, self._limit, flows, self._sizes.get(length, {}))
            window.keep(self._kept)
            self._windows[length, index] = window
        window.packets += _count(rows, len(whole))
        few = window.packets < min(running.least for running in queries)
        if few and not window.fed and len(window.held) < _MOST_HELD:
            window.held.append((whole.batch, rows))
            return
        yield from self._released(window, queries)
        yield from self._feed(window, _rows_of(whole, rows), whole.batch, queries)

    def _released(self, window: _Window, queries: list[_Running]) -> Iterator[QueryResult | Captured]:
        """Feed what was held back."""
        held, window.held, window.fed = window.held, [], True
        for batch, rows in held:
            packets = PacketColumns(batch, self._numberings)
            yield from self._feed(window, _rows_of(packets, rows), batch, queries)
            self.without_payload += packets.missing.payloads
            packets.forget()

    def _feed(
        self, window: _Window, packets: PacketColumns, batch: RecordBatch, queries: list[_Running]
    ) -> Iterator[QueryResult | Captured]:
        memo: dict[Node, TupleRows | Update] = {}
        for running in queries:
            for node in running.nodes():
                window.feed(node, packets, memo)
            if isinstance(running.outcome, Crossing):
                yield from self._crossings(running, running.outcome, window, memo, batch)

    def _crossings(
        self,
        running: _Running,
        outcome: Crossing,
        window: _Window,
        memo: dict[Node, TupleRows | Update],
        batch: RecordBatch,
    ) -> Iterator[QueryResult | Captured]:
        found = memo[outcome.node]
        if isinstance(found, Update):
            crossed = found.crossed(outcome.threshold, window.reported(running.name))
        else:
            crossed = Crossed(found, np.ones(len(found), dtype=np.bool_))
        tuples = crossed.tuples
        if not len(tuples):
            return
        inner = kinds_of(outcome.node)
        columns = [(name, kind_of(value, inner), column_of(value, tuples)) for name, value in outcome.names]
        times = batch["time_us"][tuples.origin].tolist()
        error = window.error([outcome.node])
        for row, time_us in enumerate(times):
            yield _result(running, window, columns, row, at_us=time_us, error=error)

    def _close(self, keys: list[tuple[int, int]]) -> list[QueryResult | Captured]:
        outputs: list[QueryResult | Captured] = []
        for key in sorted(keys, key=lambda key: ((key[1] + 1) * key[0], key[0])):
            window = self._windows.pop(key)
            self._closed[key[0]] = max(key[1], self._closed.get(key[0], key[1]))
            if not window.fed:
                continue
            self._sizes[key[0]] = window.sizes()
            for running in self._queries.values():
                if running.window_us == key[0] and isinstance(running.outcome, WindowTable):
                    outputs += _final(running, running.outcome, window)
        return outputs


def _parts(indices: NDArray[np.int64]) -> Iterator[tuple[int, slice | NDArray[np.intp]]]:
    """The rows of each window."""
    steps = np.diff(indices)
    if (steps < 0).any():
        for index in np.unique(indices).tolist():
            yield index, np.flatnonzero(indices == index)
        return
    edges = [0, *(np.flatnonzero(steps) + 1).tolist(), len(indices)]
    for first, end in pairwise(edges):
        yield int(indices[first]), slice(first, end)


def _count(rows: _Rows, size: int) -> int:
    if isinstance(rows, slice):
        return int(rows.stop - rows.start)
    return size if rows is None else len(rows)


def _rows_of(packets: PacketColumns, rows: _Rows) -> PacketColumns:
    """Some rows of a batch; rows in order share computed values."""
    if isinstance(rows, slice):
        return packets.between(rows.start, rows.stop)
    return packets if rows is None else packets.at(rows)


def _final(running: _Running, outcome: WindowTable, window: _Window) -> Iterator[QueryResult | Captured]:
    relation = window.relation(outcome)
    columns = [(name, running.kinds[name], column) for name, column in sorted(relation.columns.items())]
    error = window.error(running.nodes())
    end = window.start_us + window.length_us
    for row in range(relation.size):
        yield _result(running, window, columns, row, at_us=end, error=error)


def _result(
    running: _Running,
    window: _Window,
    columns: list[tuple[str, Kind, tuple[np.ndarray, ...]]],
    row: int,
    *,
    at_us: int,
    error: str,
) -> QueryResult:
    return QueryResult(
        query=running.name,
        window_us=window.start_us,
        length_us=window.length_us,
        at_us=at_us,
        fields={name: plain_value(kind, column, row) for name, kind, column in columns},
        exact=not error,
        partial=running.since_us is not None and running.since_us > window.start_us,
        error=error,
    )


def _captured(
    running: _Running, outcome: TupleStream, packets: TupleRows
) -> Iterator[QueryResult | Captured]:
    assert isinstance(packets, PacketColumns)  # noqa: S101 - a stream's node is a packet source
    if not len(packets):
        return
    batch = packets.batch
    last_us = int(batch["time_us"][-1])
    if outcome.names is not None:
        made = {"time_us": batch["time_us"]}
        for name, value in outcome.names:
            column = column_of(value, packets)
            kind = kind_of(value, PACKET_KINDS)
            made |= dict(
                zip((f"{name}_hi", f"{name}_lo") if kind == "address" else (name,), column, strict=True)
            )
        batch = RecordBatch(made)
    yield Captured(query=running.name, batch=batch, last_us=last_us)
