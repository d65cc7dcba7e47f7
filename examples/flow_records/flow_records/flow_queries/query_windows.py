"""Sonata queries over flow records, without I/O.

keys wanted ─► queries ─► an engine of the Sonata adapter for each exporter ◄─ packet rows ◄─ flows
                                       └─► results, under the keys that asked

A record tells of packets that went by before it was exported: up to `delay_us`, the exporter's active time-out and
some more.  Windows therefore close so much later than records arrive; thresholds that only count are reached at once.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from apps.packets import SteadyTime
from apps.sonata_adapter.errors import InvalidRequest, SonataError
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.keys import QUERY_PREFIX, QueryRequest, request_of
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.query.expressions import PACKET_FIELDS, PAYLOAD_FIELDS, Expression, fields_of
from apps.sonata_adapter.query.language import Filter, Join, Map, Pipeline, Reduce
from apps.sonata_adapter.results import Captured, QueryResult
from due import Key, RecordBatch
from due.errors import DueError
from flow_records.packet_rows import packet_groups, single_packets

RESULTS: Final = "network.traffic_query.flow_queries"
MOST_QUERIES: Final = 64
MOST_EXPORTERS: Final = 256
NOT_IN_FLOWS: Final = frozenset(
    (PAYLOAD_FIELDS | {"payload"})
    | {name for name in PACKET_FIELDS if name.startswith("arp.") or name in ("tcp.seq", "tcp.ack")}
)
"""Fields of packets that no flow record tells."""
_KEYS: Final = 1 << 16
"""Keys that one operator keeps exactly in a window."""
_STEP_US: Final = 3_600_000_000
"""A longer step of an exporter's clock is accepted only after several records agree."""


class FlowResult(NamedTuple):
    """A result, and where it belongs."""

    key: str
    exporter: str
    result: QueryResult

    def to_value(self) -> dict[str, Any]:
        """As the Sonata adapter's results, with the exporter."""
        return self.result.to_value() | {"exporter": self.exporter}


class _Exporter:
    """What is kept for one exporter."""

    def __init__(self) -> None:
        self.engine = HostEngine(limit=_KEYS)
        self.clock = SteadyTime(_STEP_US)
        self.heard_s = 0.0
        """When its clock was read last."""


class QueryWindows:
    """All queries over all exporters.  Not thread-safe.

    Args:
        delay_us: how long after its packets a record may come; older packets are counted at this age.
        most_packets: packet rows of one item of flows; see `single_packets`.
    """

    def __init__(self, delay_us: int, most_packets: int) -> None:
        self._delay_us = delay_us
        self._most_packets = most_packets
        self._queries: dict[str, QueryRequest] = {}
        self._outputs: dict[str, tuple[str, ...]] = {}
        """Keys of the results, by the identity of their query."""
        self._exporters: dict[str, _Exporter] = {}
        self.left_out = 0
        """Packets beyond `most_packets`: counts of packets are too small by these."""
        self.not_kept = 0
        """Items of exporters beyond MOST_EXPORTERS."""
        self.clocks_set_back = 0
        """Times that an exporter's clock was set back: all its windows were closed."""

    def want(self, keys: Iterable[str], templates: Mapping[str, Template]) -> dict[str, str]:
        """Replace the set of wanted keys.

        Returns:
            Keys that cannot be answered, and why.
        """
        wanted: dict[str, QueryRequest] = {}
        outputs: dict[str, set[str]] = {}
        refused: dict[str, str] = {}
        for key in sorted(keys):
            try:
                request = _request(key, templates)
                if request is not None and request.identity not in wanted and len(wanted) >= MOST_QUERIES:
                    raise InvalidRequest(f"{key}: {MOST_QUERIES} queries run already")
            except (SonataError, DueError) as error:
                refused[key] = str(error)
                continue
            if request is not None:
                wanted[request.identity] = request
                outputs.setdefault(request.identity, set()).add(_own(request.output))
        for state in self._exporters.values():
            _change(state.engine, self._queries, wanted)
        self._queries = wanted
        self._outputs = {identity: tuple(sorted(found)) for identity, found in outputs.items()}
        return refused

    def take(self, exporter: str, flows: RecordBatch, now_s: float) -> list[FlowResult]:
        """Results that flow records cause.

        Args:
            exporter: their exporter.
            flows: columns of `FLOW_COLUMNS`.
            now_s: s, of a clock that never goes back.
        """
        state = self._state_of(exporter)
        if state is None or not self._queries or not len(flows):
            return []
        before_us = state.clock.now
        # one vote for each time of export, since hundreds of records share it
        exports = np.unique(flows["time_us"])
        believed = state.clock.believed(exports)
        if believed is not None:
            flows = flows.take(np.isin(flows["time_us"], exports[believed]))
        if not len(flows) or state.clock.now is None:
            return []
        state.heard_s = now_s
        groups = packet_groups(self._in_time(flows))
        packets = single_packets(groups, self._most_packets)
        self.left_out += max(0, int(groups["packets"].sum(dtype=np.float64)) - len(packets))
        horizon_us = state.clock.now - self._delay_us
        outputs: list[QueryResult | Captured] = []
        if before_us is not None and state.clock.now < before_us - _STEP_US:
            self.clocks_set_back += 1
            outputs += state.engine.set_back(horizon_us)
        outputs += state.engine.process(packets, horizon_us=horizon_us)
        return list(self._addressed(exporter, outputs))

    def advance(self, now_s: float) -> list[FlowResult]:
        """Results of windows that are over although no records come any more."""
        found: list[FlowResult] = []
        for exporter, state in self._exporters.items():
            if state.clock.now is not None:
                passed_us = int((now_s - state.heard_s) * 1e6)
                over = state.engine.advance(state.clock.now + passed_us - self._delay_us)
                found += self._addressed(exporter, over)
        return found

    def finish(self) -> list[FlowResult]:
        """Results of all open windows."""
        return [
            found
            for exporter, state in self._exporters.items()
            for found in self._addressed(exporter, state.engine.finish())
        ]

    def health(self) -> dict[str, Any]:
        """Counters since the start."""
        states = self._exporters.values()
        return {
            "queries": sorted(self._queries),
            "exporters": sorted(self._exporters),
            "packets": sum(state.engine.packets for state in states),
            "late": sum(state.engine.late for state in states),
            "times_doubted": sum(state.clock.doubted for state in states),
            "clocks_set_back": self.clocks_set_back,
            "left_out": self.left_out,
            "not_kept": self.not_kept,
        }

    def _state_of(self, exporter: str) -> _Exporter | None:
        state = self._exporters.get(exporter)
        if state is None:
            if len(self._exporters) >= MOST_EXPORTERS:
                self.not_kept += 1
                return None
            state = self._exporters[exporter] = _Exporter()
            _change(state.engine, {}, self._queries)
        return state

    def _in_time(self, flows: RecordBatch) -> RecordBatch:
        """Flows whose first and last packet lie at most `delay_us` before their export, and not after it."""
        export = flows["time_us"]
        times = {
            name: np.clip(flows[name], export - self._delay_us, export) for name in ("first_us", "last_us")
        }
        return RecordBatch({**flows, **times})

    def _addressed(self, exporter: str, outputs: Iterable[QueryResult | Captured]) -> Iterator[FlowResult]:
        for output in outputs:
            if isinstance(output, QueryResult):
                for key in self._outputs.get(output.query, ()):
                    yield FlowResult(key, exporter, output)


def _request(key: str, templates: Mapping[str, Template]) -> QueryRequest | None:
    """The query that a key of ours asks for, as the adapter reads its own; None for a wildcard.

    Raises SonataError, DueError.
    """
    if not key.startswith(f"{RESULTS}.") or len(Key.parse(key).segments) != 4:
        raise InvalidRequest(f"{key}: not a key of flow_queries; write {RESULTS}.<query>")
    try:
        request = request_of(QUERY_PREFIX + key.removeprefix(RESULTS), templates)
    except SonataError as error:
        raise InvalidRequest(str(error).replace(QUERY_PREFIX, RESULTS)) from None
    missing = () if request is None else sorted(_fields(request.query.steps) & NOT_IN_FLOWS)
    if missing:
        raise InvalidRequest(f"{key}: flow records do not tell {', '.join(missing)}")
    return request


def _own(key: str) -> str:
    return RESULTS + key.removeprefix(QUERY_PREFIX)


def _fields(steps: Pipeline) -> frozenset[str]:
    """Names of all fields that steps use, those of tuples among them."""
    found: set[str] = set()
    for step in steps:
        for value in _expressions(step):
            found.update(fields_of(value))
        if isinstance(step, Join):
            found |= _fields(step.other)
    return frozenset(found)


def _expressions(step: object) -> tuple[Expression, ...]:
    match step:
        case Filter(condition):
            return (condition,)
        case Map(fields):
            return tuple(value for _, value in fields)
        case Reduce():
            return (step.value,)
        case _:
            return ()


def _change(
    engine: HostEngine, before: Mapping[str, QueryRequest], after: Mapping[str, QueryRequest]
) -> None:
    for identity in before.keys() - after.keys():
        engine.remove(identity)
    for identity in sorted(after.keys() - before.keys()):
        engine.add(after[identity].query)
