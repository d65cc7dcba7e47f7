"""From a query to what its results say against somebody.

template ─► measure (the count in `filter count >= N`), who (src, dst, mac), kind and service of the attack
         ─► the query with any other threshold, reported at the crossing or with its count at the window's end
"""

import hashlib
from collections.abc import Mapping
from typing import Final

import msgspec

from apps.evidence import Kind as AttackKind
from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.query.catalogue import CATALOGUE, Template
from apps.sonata_adapter.query.dataflow import (
    Crossing,
    Node,
    PacketSource,
    WindowTable,
    compile_query,
    sources,
)
from apps.sonata_adapter.query.expressions import BinaryOperation, Expression, Field, Kind, Number
from apps.sonata_adapter.query.language import SYN, Filter, Map, Query, arp, output_kinds, tcp
from apps.sonata_adapter.query.parameters import Value

_LOWER: Final = 4
"""While a query learns, its threshold is the catalogue's divided by this, ..."""
_LOWEST: Final = 5
"""... but no lower than this, unless the catalogue's is lower itself: such thresholds already count single events."""
_WINDOW_MS: Final = 3_000
_SHORT_WINDOW_MS: Final = 1_000
"""For results that are known at the window's end only: the shortest whose counts the switch is asked for."""
_SYN_RST_ACK: Final = 0x16
_BEGINNING: Final = (tcp.flags & _SYN_RST_ACK == 0x02) | (tcp.flags & _SYN_RST_ACK == 0)
"""Segments that begin a conversation or should: SYN, and those of FIN, NULL and Xmas scans."""
_BEGINS: Final = frozenset({(tcp.flags == SYN).node, (arp.op == 1).node, _BEGINNING.node})
_MEANT: Final[dict[str, tuple[AttackKind, str]]] = {
    "port_scan": ("scan", ""),
    "superspreader": ("scan", ""),
    "arp_scan": ("scan", "arp"),
    "new_tcp": ("flood", ""),
    "ddos": ("flood", ""),
    "syn_flood": ("flood", ""),
    "incomplete_flows": ("flood", ""),
    "slowloris": ("flood", ""),
    "dns_reflection": ("flood", "from-udp/53"),
    "ssh_brute_force": ("guessing", "tcp/22"),
    "zorro": ("guessing", "tcp/23"),
    "dns_tunnel": ("other", "udp/53"),
}


class EvidenceRecipe(msgspec.Struct, frozen=True, kw_only=True):
    """How results of a query become evidence."""

    name: str
    meaning: str
    kind: AttackKind
    service: str
    measure: str
    """The result's field that is compared with what training saw."""
    unit: str
    low: int
    """Threshold while the query learns: what is below it, training does not see."""
    declared: int
    """The threshold of the query as it is declared."""
    crosses: bool
    """Whether a result is reported at the threshold, in the middle of a window."""
    supporting: bool
    """Whether a count may consist of answers, which others can call forth with forged questions."""
    query: Query

    @property
    def text(self) -> str:
        """What a baseline belongs to: the query with its lowest threshold."""
        return self._with(self.low).text()

    def learning(self, key: str) -> QueryRequest:
        """The query that reports each count from `low` on, when its window is over.

        It has the same identity for all that learn the same, so that it is counted once.
        """
        told = hashlib.blake2s(self.text.encode(), digest_size=8).hexdigest()
        return self._request(key, f"{self.name} {told} at counts", self._with(self.low, whole=True))

    def at(self, key: str, threshold: int) -> QueryRequest:
        """The query with a threshold."""
        return self._request(key, f"{key} at {threshold}", self._with(threshold))

    def _request(self, key: str, identity: str, query: Query) -> QueryRequest:
        query = msgspec.structs.replace(query, name=identity)
        return QueryRequest(key, "query", self.name, identity, identity, query)

    def _with(self, threshold: int, *, whole: bool = False) -> Query:
        """The query with this threshold; `whole`: with the count of the whole window, not at the crossing."""
        place, _ = _compared(self.query)
        steps = list(self.query.steps)
        steps[place] = Filter(BinaryOperation(">=", Field(self.measure), Number(threshold)))
        if whole and self.crosses:
            # a map before the threshold leaves the decision to the window's end
            fields = sorted(output_kinds(steps[:place]))
            steps.insert(place, Map(tuple((name, Field(name)) for name in fields)))
        return msgspec.structs.replace(self.query, steps=tuple(steps))


def recipe_of(template: Template) -> EvidenceRecipe:
    """How results of a query become evidence; raises `InvalidRequest` if they name nobody or count nothing."""
    recipe = plain_recipe_of(template)
    query = template.query()
    if template.name in CATALOGUE and not recipe.crosses and query.window_ms == _WINDOW_MS:
        query = template.query({"window": _SHORT_WINDOW_MS})
    if template.name == "port_scan":
        # a flooded server answers to as many ports as a scanner asks
        query = msgspec.structs.replace(query, steps=(Filter(_BEGINNING.node), *query.steps))
    supporting = recipe.supporting and not _begins(query)
    return msgspec.structs.replace(recipe, query=query, supporting=supporting)


def plain_recipe_of(template: Template, values: Mapping[str, Value] | None = None) -> EvidenceRecipe:
    """What a query with these values counts, just as it is declared; raises `InvalidRequest` as `recipe_of` does."""
    query = template.query(values)
    kinds = query.fields
    if kinds.get("src") != "address" and kinds.get("dst") != "address" and not _is_frame_sender(kinds):
        raise InvalidRequest(
            f"query {template.name} names nobody: its results need src or dst, an address, or port and mac"
        )
    _, condition = _compared(query)
    if not isinstance(condition, BinaryOperation) or not isinstance(condition.left, Field):
        raise InvalidRequest(
            f"query {template.name} has no count to compare with training: end it with a filter such as count >= 40"
        )
    measure, threshold = condition.left.name, _least(condition)
    if kinds.get(measure) != "number":
        raise InvalidRequest(
            f"query {template.name} leaves {measure} out of its results, which evidence needs"
        )
    crosses = isinstance(compile_query(query), Crossing)
    kind, service = _MEANT.get(template.name, ("other", ""))
    return EvidenceRecipe(
        name=template.name,
        meaning=template.meaning,
        kind=kind,
        service=service,
        measure=measure,
        unit=_unit(template, measure),
        low=max(1, threshold // _LOWER, min(threshold, _LOWEST)),
        declared=threshold,
        crosses=crosses,
        supporting=bool({"src", "mac"} & kinds.keys()) and not _begins(query),
        query=query,
    )


def _begins(query: Query) -> bool:
    """Whether all packets that are counted begin something."""
    outcome = compile_query(query)
    found = sources(outcome) if isinstance(outcome, WindowTable) else [outcome.node]
    return all(_BEGINS.intersection(_packets(node).filters) for node in found)


def _packets(node: Node) -> PacketSource:
    return node if isinstance(node, PacketSource) else _packets(node.source)


def _unit(template: Template, measure: str) -> str:
    """What is counted, in words."""
    for name in (measure, "threshold"):
        parameter = template.parameter(name)
        if parameter is not None and parameter.unit:
            return parameter.unit
    return measure


def _is_frame_sender(kinds: Mapping[str, Kind]) -> bool:
    return kinds.get("mac") == "mac" and kinds.get("port") == "number"


def _compared(query: Query) -> tuple[int, Expression | None]:
    """The last filter that is a field's lower bound: its place, and the condition."""
    for place in range(len(query.steps) - 1, -1, -1):
        step = query.steps[place]
        if isinstance(step, Filter):
            match step.condition:
                case BinaryOperation(">=" | ">", Field(), Number()) as condition if place:
                    return place, condition
    return 0, None


def _least(condition: BinaryOperation) -> int:
    assert isinstance(condition.right, Number)  # noqa: S101 - else it is none of `_compared`
    return condition.right.value + (condition.operator == ">")
