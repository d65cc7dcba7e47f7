"""Reports of the switch's counting stages → results.

A report is a frame with which a key reached its threshold (`crossed`), or whose key found no cell
(`overflow`).  Keys without a cell are counted here, with the query's own operators; a window in which
there were any is marked as an estimate, because a key may be split between the switch (its tuples that
had a cell) and the host.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np

from apps.sonata_adapter.host.columns import PacketColumns, plain_value
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.host.evaluation import column_of
from apps.sonata_adapter.host.key_tables import Column
from apps.sonata_adapter.planner.plan import QueryPlan
from apps.sonata_adapter.query.dataflow import Crossing, ReduceNode, compile_query, kinds_of
from apps.sonata_adapter.query.expressions import Field, Kind, kind_of
from apps.sonata_adapter.query.language import PACKET_KINDS, Query
from apps.sonata_adapter.results import QueryResult
from due import RecordBatch

_KEPT: Final = 4
"""Windows whose reported keys are remembered, against a report that comes twice."""
OVERFLOWS_KEPT: Final = 64
"""Windows of which it is remembered that a key had no cell."""


class CountReportReader:
    """Reads the reports of one query from one switch."""

    def __init__(
        self, query: Query, found: QueryPlan, *, base_us: int = 0, since_us: int | None = None
    ) -> None:
        outcome = compile_query(query)
        assert isinstance(outcome, Crossing)  # noqa: S101 - the planner puts nothing else into the switch
        assert isinstance(outcome.node, ReduceNode)  # noqa: S101
        self._query = query
        self._outcome = outcome
        self._base_us = base_us
        self._since_us = since_us
        self._reduces = {entry.bit for entry in found.entries if entry.role == "reduce"}
        self._host: HostEngine | None = None
        self._seen: dict[int, set[tuple[int | str, ...]]] = {}
        self._overflows: set[int] = set()
        """Windows in which a key had no cell."""
        inner = kinds_of(outcome.node)
        self._columns: list[tuple[str, Kind]] = [
            (name, kind_of(value, inner)) for name, value in outcome.names
        ]
        self.tuples = 0
        self.overflow = 0
        """Tuples that came because a key had no cell."""

    def take(self, bit: int, batch: RecordBatch) -> list[QueryResult]:
        """Results of the reports of one of the query's bits."""
        self.tuples += len(batch)
        outputs: list[QueryResult] = []
        over = np.flatnonzero(batch["overflow"])
        self.overflow += len(over)
        if len(over):
            outputs += self._overflowed(batch.take(over))
        crossed = np.flatnonzero(batch["crossed"])
        if bit in self._reduces and len(crossed):
            outputs += self._crossed(batch.take(crossed))
        return outputs

    def set_back(self, now_us: int) -> list[QueryResult]:
        """The switch's clock was set back to `now_us`: begin anew; all results were reported at once."""
        self._host = None
        self._seen.clear()
        self._overflows.clear()
        self._since_us = now_us
        return []

    def _crossed(self, batch: RecordBatch) -> Iterator[QueryResult]:
        packets = PacketColumns(batch)
        columns: list[tuple[str, Kind, Column | None]] = []
        for (name, value), (_, kind) in zip(self._outcome.names, self._columns, strict=True):
            from_packet = isinstance(value, Field) and value.name in PACKET_KINDS
            columns.append((name, kind, column_of(value, packets) if from_packet else None))
        for row, time_us in enumerate(batch["time_us"].tolist()):
            fields = {
                name: self._outcome.threshold if column is None else plain_value(kind, column, row)
                for name, kind, column in columns
            }
            yield from self._once(self._window(time_us), fields, time_us)

    def _overflowed(self, batch: RecordBatch) -> Iterator[QueryResult]:
        if self._host is None:
            self._host = HostEngine(lateness_us=0, base_us=self._base_us)
            self._host.add(self._query)
        for number in np.unique((batch["time_us"] - self._base_us) // self._query.window_us).tolist():
            window = self._base_us + number * self._query.window_us
            self._overflows.add(window)
        for output in self._host.process(batch):
            assert isinstance(output, QueryResult)  # noqa: S101 - of a crossing query
            yield from self._once(self._window(output.at_us), output.fields, output.at_us)
        while len(self._overflows) > OVERFLOWS_KEPT:
            self._overflows.discard(min(self._overflows))

    def _window(self, time_us: int) -> int:
        length = self._query.window_us
        return (time_us - self._base_us) // length * length + self._base_us

    def _once(self, window: int, fields: dict[str, int | str], at_us: int) -> Iterator[QueryResult]:
        key = tuple(value for name, value in sorted(fields.items()))
        seen = self._seen.setdefault(window, set())
        if key in seen:
            return
        seen.add(key)
        while len(self._seen) > _KEPT:
            del self._seen[min(self._seen)]
        overflows = window in self._overflows
        yield QueryResult(
            query=self._query.name,
            window_us=window,
            length_us=self._query.window_us,
            at_us=at_us,
            fields=fields,
            exact=not overflows,
            partial=self._since_us is not None and self._since_us > window,
            error="keys without a cell in the switch were counted apart" if overflows else "",
        )
