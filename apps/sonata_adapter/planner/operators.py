"""Where each operator of a query runs, and why.

filter tcp.flags & 23 == 2     switch   bits 0, 1 of the classifier
reduce by dst: count = …       switch   counting stage 1, 8,192 cells
filter count >= 40             switch   a key is reported once a window, when it reaches 40
"""

from collections.abc import Iterator, Mapping
from typing import Literal

import msgspec

from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.planner.conditions import conditions_of
from apps.sonata_adapter.planner.placement import StageEntry
from apps.sonata_adapter.planner.plan import QueryPlan
from apps.sonata_adapter.query.dataflow import Crossing, compile_query, conjuncts
from apps.sonata_adapter.query.expressions import PAYLOAD_FIELDS, Expression, fields_of, text_of
from apps.sonata_adapter.query.language import Distinct, Filter, Join, Map, Pipeline, Reduce, Step, text_lines

Place = Literal["switch", "host"]


class PlacedOperator(msgspec.Struct, frozen=True):
    """One operator of a query."""

    text: str
    """As in the query's text, indented within a join."""
    place: Place
    why: str


def placed_operators(
    request: QueryRequest, one: QueryPlan, cells: Mapping[int, str] | None = None
) -> list[PlacedOperator]:
    """Every operator of a query, in the order of its text.

    Args:
        request: the query.
        one: its plan.
        cells: by bit, the cells of its entries in words; by default their number.
    """
    told = cells or {}
    walk: _Walk = _InSwitch(request, one, told) if one.in_switch else _OnHost(one)
    gated = request.query.gated
    if gated is None:
        return list(walk.steps(request.query.steps, ""))
    gate = one.gate
    if gate is None:
        first = PlacedOperator(gated.text(), "host", one.reason)
    else:
        walk = _BehindGate(gate)
        first = PlacedOperator(gated.text(), "switch", _stages([gate], told))
    return [first, *walk.steps(request.query.steps, "")]


class _Walk:
    """Goes through the steps; filters of packets come before any other operator but map."""

    def steps(self, steps: Pipeline, indent: str) -> Iterator[PlacedOperator]:
        first = True
        source = self._begin()
        for step in steps:
            if isinstance(step, Join):
                (head, *_) = text_lines((step,), indent)
                place, why = self._later(step)
                yield PlacedOperator(head, place, why)
                yield from self.steps(step.other, indent + "    ")
                first = False
                continue
            place, why = self._packets(step, source) if first else self._behind(step, source)
            first = first and isinstance(step, Filter | Map)
            yield PlacedOperator(text_lines((step,), indent)[0], place, why)

    def _begin(self) -> int:
        return 0

    def _packets(self, step: Step, source: int) -> tuple[Place, str]:
        raise NotImplementedError

    def _behind(self, step: Step, source: int) -> tuple[Place, str]:
        raise NotImplementedError

    def _later(self, step: Step) -> tuple[Place, str]:
        raise NotImplementedError


class _InSwitch(_Walk):
    """A query that counting stages execute."""

    def __init__(self, request: QueryRequest, one: QueryPlan, cells: Mapping[int, str]) -> None:
        self._cells = cells
        self._entries = one.entries
        self._crossing = isinstance(compile_query(request.query), Crossing)
        self._sources = -1
        self._reduced: set[int] = set()

    def _begin(self) -> int:
        self._sources += 1
        return self._sources

    def _mine(self, role: str, source: int) -> list[StageEntry]:
        found = [entry for entry in self._entries if entry.role == role and entry.source == source]
        if role == "distinct":
            behind = {bit for entry in self._mine("reduce", source) for bit in entry.behind}
            return [entry for entry in self._entries if entry.bit in behind]
        return found

    def _counting(self, source: int) -> list[StageEntry]:
        return self._mine("difference", source) or self._mine("reduce", source)

    def _packets(self, step: Step, source: int) -> tuple[Place, str]:
        match step:
            case Filter():
                bits = sorted(
                    {each.bit for each in (self._mine("distinct", source) or self._counting(source))}
                )
                return "switch", f"classifier, bit {', '.join(map(str, bits))}"
            case Map():
                return "switch", "chooses the parts of a cell's key"
            case _:
                return self._behind(step, source)

    def _behind(self, step: Step, source: int) -> tuple[Place, str]:
        match step:
            case Distinct() if source not in self._reduced:
                return "switch", _stages(self._mine("distinct", source), self._cells)
            case Reduce() if source not in self._reduced:
                self._reduced.add(source)
                return "switch", _stages(self._counting(source), self._cells)
            case Map() if source not in self._reduced:
                return "switch", "chooses the parts of a cell's key"
        return self._later(step)

    def _later(self, step: Step) -> tuple[Place, str]:
        entry = self._entries[-1]
        if entry.role == "difference":
            what = "both sides count in one cell" if isinstance(step, Join) else "on the cell's difference"
            return (
                "switch",
                f"{what}; keys of at least {entry.threshold} are reported when the window is over",
            )
        if self._crossing and isinstance(step, Filter):
            return "switch", f"a key is reported once a window, when it reaches {entry.threshold}"
        if self._crossing:
            return "host", "names the fields of a result"
        return "host", "needs all counts of a key, which are read when the window is over"


class _OnHost(_Walk):
    """A query of which the switch only copies packets."""

    def __init__(self, one: QueryPlan) -> None:
        self._one = one

    def _packets(self, step: Step, source: int) -> tuple[Place, str]:  # noqa: ARG002
        if not isinstance(step, Filter):
            return self._later(step)
        parts = conjuncts(step.condition)
        left = [part for part in parts if not conditions_of((part,)).exact]
        if not left:
            bits = ", ".join(str(copy.bit) for copy in self._one.copies)
            return (
                "switch",
                f"classifier: only such packets are copied (bit {bits}); checked again on the host",
            )
        return "host", "; ".join(f"{text_of(part)}: {_unplaced(part)}" for part in left)

    def _behind(self, step: Step, source: int) -> tuple[Place, str]:  # noqa: ARG002
        return self._later(step)

    def _later(self, step: Step) -> tuple[Place, str]:  # noqa: ARG002
        return "host", self._one.reason


class _BehindGate(_Walk):
    """A query of which the switch copies what has passed the gate."""

    def __init__(self, gate: StageEntry) -> None:
        self._why = f"on the copies of what has passed the gate (bit {gate.opens})"

    def _packets(self, step: Step, source: int) -> tuple[Place, str]:  # noqa: ARG002
        return "host", self._why

    def _behind(self, step: Step, source: int) -> tuple[Place, str]:  # noqa: ARG002
        return "host", self._why

    def _later(self, step: Step) -> tuple[Place, str]:  # noqa: ARG002
        return "host", self._why


def _unplaced(condition: Expression) -> str:
    names = set(fields_of(condition))
    if names & (PAYLOAD_FIELDS | {"payload"}):
        return "the switch does not read payloads"
    return "the classifier cannot express it"


def _stages(entries: list[StageEntry], cells: Mapping[int, str]) -> str:
    parts = dict.fromkeys(
        f"counting stage {entry.stage}, {cells.get(entry.bit, f'{entry.size:,} cells')}" for entry in entries
    )
    return "; ".join(parts)
