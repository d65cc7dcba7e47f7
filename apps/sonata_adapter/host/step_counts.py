"""Tuples that go into each operator of a query and come out of it, over a capture.

A step's output is the result of the query that ends with it: all of these run in one engine, which shares their
operators.  For people who write a query; a running pipeline does not count like this.
"""

import msgspec

from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.language import Distinct, Join, Map, Pipeline, Query, Reduce, text_lines
from apps.sonata_adapter.results import Captured, QueryResult
from due import RecordBatch


class StepCount(msgspec.Struct):
    """One step."""

    text: str
    """As in the query's text, indented within a join."""
    name: str
    """Of the query that ends with it; empty: it changes no number."""
    above: int
    """Place of the step whose output it takes; -1: packets."""
    rows_in: int = 0
    rows_out: int = 0


class StepCounts:
    """Counts the rows of all steps of one query.

    Args:
        query: whose steps count.
        base_us: clock zero of its windows, absolute us.
    """

    def __init__(self, query: Query, *, base_us: int = 0) -> None:
        self._query = query
        self._engine = HostEngine(base_us=base_us)
        self._steps: list[StepCount] = []
        self._rows: dict[str, int] = {}
        self._packets = 0
        self._add(query.steps, "")

    def _add(self, steps: Pipeline, indent: str) -> None:
        above = -1
        for end, step in enumerate(steps, 1):
            name = "" if isinstance(step, Map) else f"step{len(self._steps)}"
            (head, *_) = text_lines((step,), indent)
            self._steps.append(StepCount(head, name, above))
            above = len(self._steps) - 1
            if name:
                self._rows[name] = 0
                self._engine.add(self._up_to(name, steps[:end]))
            if isinstance(step, Join):
                self._add(step.other, indent + "    ")

    def _up_to(self, name: str, steps: Pipeline) -> Query:
        """The query that ends with these steps; those before the first distinct or reduce see all packets."""
        behind = any(isinstance(step, Distinct | Reduce) for step in steps)
        return Query(name, self._query.window_ms, steps, self._query.gated if behind else None)

    def take(self, batch: RecordBatch) -> None:
        """Count packets in."""
        self._packets += len(batch)
        self._count(self._engine.process(batch))

    def finish(self) -> list[StepCount]:
        """No more packets will come: the counts of all steps, in the order of the query's text."""
        self._count(self._engine.finish())
        outputs: list[int] = []
        for step in self._steps:
            rows_in = self._packets if step.above < 0 else outputs[step.above]
            step.rows_in, step.rows_out = rows_in, self._rows[step.name] if step.name else rows_in
            outputs.append(step.rows_out)
        return self._steps

    def _count(self, outputs: list[QueryResult | Captured]) -> None:
        for output in outputs:
            self._rows[output.query] += len(output.batch) if isinstance(output, Captured) else 1
