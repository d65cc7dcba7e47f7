"""`sdnator queries fields` and `test`: the fields of queries, and what a query does with a capture."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.step_counts import StepCount, StepCounts
from apps.sonata_adapter.keys import QueryRequest, request_of
from apps.sonata_adapter.planner.conditions import conditions_of
from apps.sonata_adapter.planner.explain import explain
from apps.sonata_adapter.planner.field_places import field_places
from apps.sonata_adapter.planner.operators import PlacedOperator, placed_operators
from apps.sonata_adapter.planner.plan import QueryPlan, QueryPlans, packet_filters, plan
from apps.sonata_adapter.planner.refinement import coarsest
from apps.sonata_adapter.query.templates import read_text
from apps.sonata_adapter.query.text import parse_queries
from due import RecordBatch
from sdnator.capture.captures import CaptureError
from sdnator.cli.plain_table import plain_table
from sdnator.cli.queries_run import PastPackets, Piece, as_line, as_text, captured
from sdnator.errors import BadInput
from sdnator.plurals import counted

_MILLION: Final = 1_000_000


def fields_text() -> str:
    """The fields of the query language as a table."""
    rows = (
        (one.name, one.type, one.unit or "-", _place(one.switch, payload=one.payload), one.meaning)
        for one in field_places()
    )
    return plain_table(("field", "type", "unit", "runs", "meaning"), rows)


def _place(uses: tuple[str, ...], *, payload: bool) -> str:
    if uses:
        return f"switch: {', '.join(uses)}"
    return "host, with payload" if payload else "host"


def fields_value() -> list[dict[str, Any]]:
    """The same for programs."""
    return [msgspec.to_builtins(one) for one in field_places()]


class Tested(msgspec.Struct, frozen=True):
    """What a query did with a capture."""

    request: QueryRequest
    plans: QueryPlans
    operators: list[PlacedOperator]
    steps: list[StepCount]
    results: list[Any]
    """At most as many as were asked for."""
    found: int
    """How many results there were."""
    packets: int
    copied: int
    """Packets that the switch would copy to the host; those that are counted in the switch are not copied."""
    cpu_s: float
    """Of the host's operators, for the query alone."""
    notes: str

    @property
    def plan(self) -> QueryPlan:
        """Of the query, in a switch that has no other."""
        return self.plans.of(coarsest(self.request).identity)

    @property
    def tuples(self) -> int:
        """What reaches the host: copies (behind a gate: at most), or reports of the switch."""
        return self.found if self.plan.in_switch and self.plan.gate is None else self.copied


def tested(file: Path, captures: list[Path], most: int) -> Iterator[Tested]:
    """Run each query of a file over captures, each alone.

    Args:
        file: text of queries.
        captures: read one after the other.
        most: results to keep of each query.

    Raises:
        BadInput: the file or a capture cannot be read, or a query is wrong.
    """
    try:
        found = {one.name: one for one in parse_queries(read_text(file, str(file)), str(file))}
        for name in found:
            request = request_of(f"network.traffic_query.sonata.{name}", found)
            if request is not None:
                yield _tested(request, captures, most)
    except OSError as error:
        raise BadInput(f"{file}: cannot be read ({error.strerror}); give a text file with queries") from None
    except (CaptureError, SonataError) as error:
        raise BadInput(str(error)) from None


def _tested(request: QueryRequest, captures: list[Path], most: int) -> Tested:
    watch = _Watch(request)
    past = PastPackets(request)
    results: list[Any] = []
    found, cpu_s = 0, 0.0
    outputs = past.run(watch.pieces(captures))
    while True:
        begin = time.process_time() - watch.cpu_s
        output = next(outputs, None)
        cpu_s += time.process_time() - watch.cpu_s - begin
        if output is None:
            break
        found += 1
        if len(results) < most:
            results.append(output)
    plans = plan([coarsest(request)])
    return Tested(
        request=request,
        plans=plans,
        operators=placed_operators(coarsest(request), plans.of(coarsest(request).identity)),
        steps=watch.steps(),
        results=results,
        found=found,
        packets=watch.packets,
        copied=watch.copied,
        cpu_s=cpu_s,
        notes=past.notes,
    )


class _Watch:
    """Counts the packets that pass, and what each step would make of them."""

    def __init__(self, request: QueryRequest) -> None:
        self._query = request.query
        self._filters = packet_filters(request)
        self._counts: StepCounts | None = None
        self.packets = 0
        self.copied = 0
        self.cpu_s = 0.0
        """Time of reading and counting, which is not the query's."""

    def pieces(self, captures: list[Path]) -> Iterator[Piece]:
        begin = time.process_time()
        for piece in captured(captures):
            if self._counts is None:
                self._counts = StepCounts(self._query, base_us=piece.base_us)
            self._counts.take(piece.batch)
            self.packets += len(piece.batch)
            self.copied += self._copies(piece.batch)
            self.cpu_s += time.process_time() - begin
            yield piece
            begin = time.process_time()
        self.cpu_s += time.process_time() - begin

    def _copies(self, batch: RecordBatch) -> int:
        """Packets that meet what the classifier can express of at least one side of the query."""
        met = np.zeros(len(batch), dtype=np.bool_)
        for filters in self._filters:
            rows = PacketColumns(batch)
            for condition in filters:
                if conditions_of((condition,)).exact:
                    rows = rows.where(condition)
            met[rows.origin] = True
        return int(np.count_nonzero(met))

    def steps(self) -> list[StepCount]:
        return self._counts.finish() if self._counts is not None else []


def tested_value(one: Tested) -> dict[str, Any]:
    """What `queries test --json` prints for a query."""
    found = one.plan
    return {
        "name": one.request.name,
        "key": one.request.identity,
        "query": one.request.query.text(),
        "plan": {
            "of": "an empty switch",
            "in_switch": found.in_switch,
            "reason": found.reason,
            "operators": [msgspec.to_builtins(each) for each in one.operators],
        },
        "steps": [
            {"operator": each.text.strip(), "rows_in": each.rows_in, "rows_out": each.rows_out}
            for each in one.steps
        ],
        "cost": {
            "packets": one.packets,
            "tuples_to_host": one.tuples,
            "host_cpu_s_per_million_packets": _per_million(one),
        },
        "results": [as_line(each) for each in one.results],
        "found": one.found,
        "notes": one.notes,
    }


def _per_million(one: Tested) -> float:
    return round(one.cpu_s * _MILLION / max(1, one.packets), 3)


def tested_text(one: Tested) -> str:
    """What `queries test` prints for a query."""
    rows = [("packets", "", f"{one.packets:,}")]
    rows += [
        (each.text.removeprefix("    "), f"{each.rows_in:,}", f"{each.rows_out:,}") for each in one.steps
    ]
    width = max(len(row[0]) for row in rows)
    lines = [explain(one.request, one.plans), "", "  (planned for a switch without other queries)", ""]
    lines.append(f"  {'operator':<{width}}  {'rows in':>12}  {'rows out':>12}")
    lines += [f"  {text:<{width}}  {rows_in:>12}  {rows_out:>12}" for text, rows_in, rows_out in rows]
    lines += ["", f"  cost: {_cost(one)}", "", f"  {counted(one.found, 'result')}"]
    lines += [f"    {as_text(each)}" for each in one.results]
    if one.found > len(one.results):
        lines.append(f"    … {one.found - len(one.results):,} more; raise --most to see them")
    if one.notes:
        lines.append(f"  note: {one.notes}")
    return "\n".join(lines)


def _cost(one: Tested) -> str:
    cpu = f"on the host alone it takes {_per_million(one):.2f} s of CPU per million packets"
    share = one.tuples / max(1, one.packets)
    if one.plan.gate is not None:
        return f"the switch counts up to the gate, and copies {counted(one.tuples, 'packet')} at most; {cpu}"
    if one.plan.in_switch:
        return (
            f"the switch counts; {counted(one.found, 'report')} to the host, and keys without a cell; {cpu}"
        )
    return f"{counted(one.tuples, 'packet')} copied to the host, {share:.1%} of all; {cpu}"
