"""The Sonata adapter as a DUE app: turns requested keys into queries in the switch, and writes the results.

    network.traffic_query.sonata.*  ─ wanted ─► network.p4_command.sonata_adapter.*
    network.packets|frames|digests|counts.p4runtime_ctrl.*.q<bit> ─► operators ─► results under the keys wanted
    network.evidence.sonata_adapter.<query> ─ wanted ─► the query runs, and what goes beyond training is written

While nobody wants a result, nothing is observed and nothing is requested: without an interest the switch
has no entry and sends nothing.
"""

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import numpy as np

import due.service
from apps.evidence import TRAINING, Evidence, TrainingState
from apps.messages import Intake, MessageError, TableCommand, TableUpdate, one_line, read_latest
from apps.packets import SteadyTime
from apps.sonata_adapter.arrivals import (
    SwitchPrograms,
    baseline_in,
    cells_in,
    command_in,
    counters_in,
    data_in,
    state_in,
    training_in,
)
from apps.sonata_adapter.control import Control, Written
from apps.sonata_adapter.controller_updates import ControllerUpdates, Source, leftovers
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.evidence.auto_thresholds import AutoThresholds, auto_keys
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from apps.sonata_adapter.evidence.evidence_queries import EVIDENCE_PREFIX, EvidenceQueries
from apps.sonata_adapter.host.engine import DEFAULT_LATENESS_US, DEFAULT_LIMIT, HostEngine, WindowEngine
from apps.sonata_adapter.keys import (
    CAPTURE_PREFIX,
    HANDSHAKE,
    PROTOCOLS,
    QUERY_PREFIX,
    QueryRequest,
    capture_parameters,
)
from apps.sonata_adapter.plan_answer import OF, PLAN, asked_of, plan_answer
from apps.sonata_adapter.planner.placement import SwitchLimits
from apps.sonata_adapter.query.catalogue import CATALOGUE, Template
from apps.sonata_adapter.query.templates import QueryFolder, own_queries
from apps.sonata_adapter.results import Captured, QueryResult
from apps.sonata_adapter.switch.cell_read import CellRead
from due import NO_WAIT, PUB_ONLY, Assignment, Capability, Engine, Interest, Item, RecordBatch

SWITCHES: Final = "network.switch.p4runtime_ctrl.*"
COMMAND: Final = "network.p4_command.sonata_adapter"
CELL_REQUEST: Final = "network.cell_request.sonata_adapter"
CELLS: Final = "network.cell.p4runtime_ctrl.*"
COUNTERS: Final = "network.telemetry_counters.p4runtime_ctrl.*"
INCOMPATIBLE: Final = "network.incompatible.sonata_adapter"
BASELINE: Final = "network.baseline.sonata_adapter"
TRAININGS: Final = f"{TRAINING}.*"
_OWN_PARAMETERS: Final = sorted(
    {each.name for template in CATALOGUE.values() for each in template.parameters}
)


def _offering(path: str, names: Iterable[str]) -> str:
    return f"{path}:{','.join(f'{name}=*' for name in sorted(names))}"


INTERESTS = (Interest(SWITCHES), Interest(TRAININGS))
CAPABILITIES = (
    *(
        Capability(
            _offering(f"{QUERY_PREFIX}.{template.name}", (each.name for each in template.parameters)),
            delivery="reliable",
        )
        for template in CATALOGUE.values()
    ),
    # user queries; and wrong parameters, which are answered with what is accepted
    Capability(_offering(f"{QUERY_PREFIX}.*", _OWN_PARAMETERS), delivery="reliable"),
    *(
        Capability(_offering(f"{CAPTURE_PREFIX}.{name}", capture_parameters(protocol)), delivery="reliable")
        for name, protocol in PROTOCOLS.items()
    ),
    Capability(HANDSHAKE, delivery="reliable", archive="always"),
    Capability(f"{COMMAND}.*", delivery="reliable", archive="always"),
    Capability(f"{CELL_REQUEST}.*", delivery="reliable"),
    Capability(f"{INCOMPATIBLE}.*", archive="always"),
    Capability(f"{PLAN}:{OF}=*"),
    Capability(f"{EVIDENCE_PREFIX}.*", delivery="reliable", archive="always"),
    Capability(f"{BASELINE}.*", delivery="reliable", archive="always"),
)

_LOG = logging.getLogger(__name__)
MOST_SWITCHES: Final = 256
_STATES_READ: Final = 2_000
_COMMANDS_READ: Final = 20_000
"""Most archived items that are read at start, the latest."""
_TRAININGS_READ: Final = 100
_BASELINES_READ: Final = 50
_STEP_US: Final = 3_600_000_000
"""A longer step of a switch's clock is accepted only after several items agree."""
_LAST_ANSWERS_S: Final = 3.0
_LOOK_S: Final = 0.01
_MOST_PLANS: Final = 64
"""Maximum number of plans answered at a time; further interests in plans get no answer."""
_PLAN_S: Final = 1.0
_MY_KEYS: Final = (QUERY_PREFIX, CAPTURE_PREFIX, HANDSHAKE)


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the Sonata adapter."""

    limits: SwitchLimits = SwitchLimits()
    """Resources of the switch that queries may use."""
    keys: int = DEFAULT_LIMIT
    """Keys that one operator keeps exactly in a window; beyond that, results are marked as estimates."""
    lateness_us: int = DEFAULT_LATENESS_US
    """Allowed lateness: how long after its end a window waits for late packets, us; at most a quarter of it."""
    base_us: dict[str, int] = {}
    """Switch to absolute time of its clock zero, us, if the controller does not report it."""
    engine: Literal["numpy", "spark"] = "numpy"
    """Engine of the host's operators: numpy in this process, or Spark Structured Streaming (extra `spark`)."""
    spark_master: str = "local[2]"
    """Where Spark runs: `local[N]`, `spark://host:7077`."""
    queries: str = ""
    """Folder of the user's own queries; empty: `$SDNATOR_QUERIES`, or one in the home folder."""


class SonataAdapterService:
    """Turns interests into queries."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._bases = settings.base_us
        self._folder = QueryFolder(Path(settings.queries) if settings.queries else own_queries())
        self._control = Control(
            self._templates(),
            limits=settings.limits,
            keys_limit=settings.keys,
            lateness_us=settings.lateness_us,
            engine=_engine(settings),
        )
        self._lock = threading.RLock()
        self._intake = Intake(_LOG)
        self._times: dict[str, SteadyTime] = {}
        """Clocks of the switches, us."""
        self._set_back = 0
        """Steps back of these clocks."""
        self._observed: dict[Source, Any] = {}
        self._cells: Any = None
        self._counters: Any = None
        self._switches: dict[str, Any] = {}
        self._wanted: frozenset[str] = frozenset()
        self._evidence = EvidenceQueries(self._stored)
        self._auto = AutoThresholds(self._stored)
        self._evidence_wanted: frozenset[str] = frozenset()
        self._auto_wanted: frozenset[str] = frozenset()
        self._running: tuple[QueryRequest, ...] = ()
        """What runs for evidence, and at thresholds of its own."""
        self._swept: set[str] = set()
        self._active = False
        self._ending = False
        self._heard: frozenset[str] = frozenset()
        self._plans: dict[str, str] = {}
        """Keys of plans that are wanted, and what they ask of."""
        self._plans_at = 0.0
        self._results: dict[str, tuple[int, int]] = {}
        """By key: results written, and capture time of the last, ns."""
        self._commands = count(1)
        self._written = 0

    def start(self) -> None:
        """Subscribe to assignments and to the states of switches."""
        on_switch = self._intake.reading("switch", state_in, self._on_switch)
        for item in read_latest(self._engine, {"dataKey": SWITCHES}, 0, _STATES_READ):
            on_switch(item)
        self._engine.observe(SWITCHES).subscribe(on_switch)
        on_training = self._intake.reading("training", training_in, self._on_training)
        for item in read_latest(self._engine, {"dataKey": TRAININGS}, 0, _TRAININGS_READ):
            on_training(item)
        self._engine.observe(TRAININGS).subscribe(on_training)
        self._engine.on_assignments(self._on_assignments)

    def tick(self) -> None:
        """Process packets that waited for other streams; end the training of queries whose time has come."""
        with self._lock:
            self._write(self._control.tick(time.monotonic()))
            self._read_cells()
            self._refine()
            self._weigh()
            self._hear()
            self._tell_plans()

    def stop(self) -> None:
        """Report open results, and remove all entries from the switch."""
        with self._lock:
            self._ending = True
        deadline = time.monotonic() + _LAST_ANSWERS_S
        waits = True
        while waits and time.monotonic() < deadline:
            with self._lock:
                self._ask(self._control.last_reads(time.monotonic()))
                waits = self._control.waits_for_cells(time.monotonic())
            time.sleep(_LOOK_S if waits else 0.0)
        with self._lock:
            self._write(self._control.finish())
            self._apply(self._control.want(()))
            self._control.close()

    def health(self) -> dict[str, Any]:
        """Counters for `health`."""
        with self._lock:
            return {
                **self._control.health(),
                "results": self._written,
                "switches": sorted(self._switches),
                "times_doubted": sum(each.doubted for each in self._times.values()),
                "clocks_set_back": self._set_back,
                "evidence": self._evidence.written,
                "evidence_queries": self._evidence.health(),
                "auto_thresholds": self._auto.health(),
                **self._intake.health(),
            }

    def _clock(self, item: Item, switch: str) -> SteadyTime | None:
        """The clock of a switch; None, counted, for a switch beyond the limit."""
        clock = self._times.get(switch)
        if clock is None and len(self._times) < MOST_SWITCHES:
            clock = self._times[switch] = SteadyTime(_STEP_US)
        if clock is None:
            text = f"switch {switch}: {MOST_SWITCHES} are known already"
            self._intake.refuse("switch", MessageError("size", text), item.key)
        return clock

    def _hears(self, clock: SteadyTime, switch: str, at_us: int) -> bool:
        """Whether a time that a switch tells is accepted."""
        before_us = clock.now
        accepted = clock.hear(at_us)
        if accepted and before_us is not None and at_us < before_us - _STEP_US:
            self._begin_anew(switch, before_us, at_us)
        return accepted

    def _begin_anew(self, switch: str, before_us: int, now_us: int) -> None:
        """The clock of a switch was set back."""
        self._set_back += 1
        _LOG.warning("switch %s: its clock was set back by %d s", switch, (before_us - now_us) // 1_000_000)
        self._write(self._control.set_back(switch, now_us))
        self._apply(self._control.renew(), only=switch)

    def _templates(self) -> dict[str, Template]:
        try:
            return self._folder.templates()
        except (SonataError, OSError) as error:
            _LOG.error("own queries are left out: %s", error)
            return dict(CATALOGUE)

    def _on_assignments(self, assignments: tuple[Assignment, ...]) -> None:
        keys = frozenset(each.key for each in assignments)
        wanted = frozenset(key for key in keys if key.startswith(_MY_KEYS))
        evidence = frozenset(key for key in keys if key.startswith(f"{EVIDENCE_PREFIX}."))
        plans = sorted(key for key in keys if key.startswith(f"{PLAN}:"))
        heard = keys - wanted - evidence - frozenset(plans)
        with self._lock:
            self._active = bool(assignments)
            self._sweep()
            auto = auto_keys(wanted)
            if (wanted, evidence) != (self._auto_wanted | self._wanted, self._evidence_wanted):
                self._wanted, wanted_before = wanted - auto, self._auto_wanted
                templates = self._templates()
                self._control.know(templates)
                if evidence != self._evidence_wanted:
                    self._evidence_wanted = evidence
                    for key, reason in self._evidence.want(evidence, templates).items():
                        self._refuse(key, reason)
                if auto != wanted_before:
                    self._auto_wanted = auto
                    for key, reason in self._auto.want(auto, templates).items():
                        self._refuse(key, reason)
                self._running = self._learning_requests()
                self._apply(self._control.want(self._wanted, self._running))
            if heard - self._heard:
                # a new controller does not know earlier requests
                self._apply(self._control.everything())
            self._heard = heard
            asked = {key: asked_of(key) for key in plans}
            self._plans = dict([(key, of) for key, of in asked.items() if of][:_MOST_PLANS])
            served = self._wanted.union(request.output for request in self._control.requests)
            served |= self._auto.outputs(self._auto_wanted)
            self._results = {key: found for key, found in self._results.items() if key in served}
            self._plans_at = 0.0

    def _tell_plans(self) -> None:
        """Once a second, tell those who ask what is done for a key."""
        now = time.monotonic()
        if not self._plans or now < self._plans_at:
            return
        self._plans_at = now + _PLAN_S
        templates = self._templates()
        for key, of in self._plans.items():
            told = plan_answer(of, self._control, templates, self._auto)
            written, last = self._results.get(told.get("output", ""), (0, 0))
            told |= {"results": written, "last_result": last, "monotonic_s": now}
            told |= {"switches": sorted(self._switches), "adapter_cpu_s": time.process_time()}
            self._engine.write(key, told, [PUB_ONLY])

    def _on_switch(self, item: Item, state: SwitchPrograms) -> None:
        name = item.key.rpartition(".")[2]
        with self._lock:
            clock = self._clock(item, name)
            if clock is None:
                return
            base_us = self._bases.get(name, 0) if state.base_us is None else state.base_us
            fresh = self._control.switch(name, base_us) or name not in self._switches
            again = state.primary and not self._switches.get(name, False)
            self._switches[name] = state.primary
            self._sweep()
            if fresh or again:
                self._apply(self._control.everything(), only=name)
            if state.event_time and self._hears(clock, name, state.event_time // 1000):
                self._control.advance(name, state.event_time // 1000)

    def _sweep(self) -> None:
        """Once active, remove the entries that a killed instance left in the switches."""
        for switch in sorted(self._switches.keys() - self._swept) if self._active else ():
            self._swept.add(switch)
            archived = read_latest(self._engine, {"dataKey": f"{COMMAND}.{switch}"}, 0, _COMMANDS_READ)
            past = (self._intake.read("command", command_in, item) for item in archived)
            self._command(switch, leftovers(command.updates for command in past if command is not None))

    def _command(
        self, switch: str, updates: tuple[TableUpdate, ...], requests: tuple[dict[str, Any], ...] = ()
    ) -> None:
        if updates or requests:
            name = f"sonata-{time.time_ns()}-{next(self._commands)}"
            command = TableCommand(id=name, updates=updates, requests=requests)
            self._engine.write(f"{COMMAND}.{switch}", command.to_value(), [NO_WAIT])

    def _apply(self, changes: ControllerUpdates, only: str = "") -> None:
        """Send changes to the controller, in one message for each switch."""
        for switch in [only] if only else sorted(self._switches):
            self._command(switch, changes.updates, (*changes.withdraw, *changes.offer))
        for key, reason in changes.refused:
            self._refuse(key, reason)
        self._observe(self._control.sources)
        if self._control.needs_cells and self._cells is None:
            on_cells = self._intake.reading("cell", cells_in, self._on_cells)
            self._cells = self._engine.observe(CELLS).subscribe(on_cells)
        elif not self._control.needs_cells and self._cells is not None:
            self._cells.dispose()
            self._cells = None

        if self._control.needs_rates and self._counters is None:
            on_counters = self._intake.reading("counters", counters_in, self._on_counters)
            self._counters = self._engine.observe(COUNTERS).subscribe(on_counters)
        elif not self._control.needs_rates and self._counters is not None:
            self._counters.dispose()
            self._counters = None

    def _refuse(self, key: str, reason: str) -> None:
        _LOG.warning("%s", one_line(reason))
        name = key.split(":", maxsplit=1)[0].rpartition(".")[2]
        self._engine.write(f"{INCOMPATIBLE}.{name}", {"key": key, "reason": reason}, [NO_WAIT])

    def _stored(self, query: str, text: str) -> CountBaseline | None:
        """The newest baseline in the archive of a query of this name that counts just this."""
        for item in reversed(
            read_latest(self._engine, {"dataKey": f"{BASELINE}.{query}"}, 0, _BASELINES_READ)
        ):
            found = self._intake.read("baseline", baseline_in, item)
            if found is not None and found.text == text:
                return found
        return None

    def _on_training(self, item: Item, state: TrainingState) -> None:
        with self._lock:
            self._report(self._auto.train(item.app_id, state))
            self._say(self._evidence.train(item.app_id, state))

    def _hear(self) -> None:
        now_us = self._control.now_us
        if now_us is not None:
            self._report(self._auto.hear(now_us))
            self._say(self._evidence.hear(now_us))

    def _learning_requests(self) -> tuple[QueryRequest, ...]:
        """What runs for evidence and at thresholds of its own; what both learn alike runs once."""
        found = {each.identity: each for each in (*self._evidence.requests, *self._auto.requests)}
        return tuple(found.values())

    def _report(self, found: Iterable[tuple[str, QueryResult]]) -> None:
        """Write results that have reached a threshold of their query's own."""
        for key, result in found:
            query = self._auto.of(key)
            if query is not None:
                self._put(query.output, result.to_value(), result.at_us)

    def _say(self, found: Iterable[tuple[str, Evidence]]) -> None:
        """Write evidence and baselines; follow the thresholds, which change when training ends."""
        for key, evidence in found:
            self._engine.write(key, evidence.to_value(), [NO_WAIT], event_time=evidence.event_time)
        for query, baseline in (*self._evidence.learnt(), *self._auto.learnt()):
            self._engine.write(
                f"{BASELINE}.{query}", baseline.to_value(), [NO_WAIT], event_time=baseline.event_time
            )
        running = self._learning_requests()
        if running != self._running:
            self._running = running
            self._apply(self._control.want(self._wanted, self._running))

    def _observe(self, sources: set[Source]) -> None:
        for source in self._observed.keys() - sources:
            self._observed.pop(source).dispose()
        for source in sorted(sources - self._observed.keys()):
            key = f"network.{source.kind}.p4runtime_ctrl.*.{source.name}"
            on_data = self._intake.reading(source.kind, data_in, self._on_data)
            self._observed[source] = self._engine.observe(key).subscribe(on_data)

    def _on_data(self, item: Item, batch: RecordBatch) -> None:
        _, kind, _, switch, name = item.key.split(".")
        with self._lock:
            clock = self._clock(item, switch)
            if clock is None:
                return
            if kind == "counts":
                self._counted(clock, switch, name, batch)
                return
            before_us = clock.now
            rows = clock.believed(batch["time_us"])
            batch = batch if rows is None else batch.take(rows)
            if before_us is not None and clock.now is not None and clock.now < before_us:
                ahead = batch["time_us"] > clock.now + _STEP_US
                self._take(kind, switch, name, batch.take(ahead))
                batch = batch.take(~ahead)
                self._begin_anew(switch, before_us, int(batch["time_us"].min()))
            self._take(kind, switch, name, batch)
            self._read_cells()
            self._hear()

    def _take(self, kind: str, switch: str, name: str, batch: RecordBatch) -> None:
        if kind == "digests":
            self._write(self._control.digests(switch, name, batch))
            self._refine()
        else:
            self._write(self._control.packets(switch, name, batch, time.monotonic()))
            self._control.busy(switch, time.monotonic())

    def _counted(self, clock: SteadyTime, switch: str, name: str, batch: RecordBatch) -> None:
        """Differences over their threshold; at the end they carry the far time of our own last questions."""
        if not self._ending and len(batch):
            newest_us = int(batch["time_us"].max())
            if self._hears(clock, switch, newest_us):
                self._control.advance(switch, newest_us)
        self._write(self._control.counts(switch, name, batch, time.monotonic()))
        self._read_cells()
        self._hear()

    def _on_cells(self, item: Item, answers: tuple[list[int], list[int]]) -> None:
        """Answers of a switch: `id` and `count` of each question."""
        switch = item.key.rpartition(".")[2]
        numbers, counts = answers
        with self._lock:
            if self._clock(item, switch) is None:
                return
            self._write(self._control.cells(switch, numbers, counts))
            self._read_cells()

    def _read_cells(self) -> None:
        self._ask(self._control.reads(time.monotonic()))

    def _refine(self) -> None:
        changes = self._control.refine()
        if changes is not None:
            self._apply(changes)

    def _weigh(self) -> None:
        changes = self._control.weigh(time.monotonic())
        if changes is not None:
            self._apply(changes)

    def _on_counters(self, item: Item, counters: dict[int, int]) -> None:
        switch = item.key.rpartition(".")[2]
        with self._lock:
            clock = self._clock(item, switch)
            if clock is None or not item.event_time:
                return
            if self._hears(clock, switch, item.event_time // 1000):
                self._control.measured(switch, counters, item.event_time // 1000)

    def _ask(self, questions: dict[str, list[CellRead]]) -> None:
        for switch, reads in questions.items():
            self._engine.write(f"{CELL_REQUEST}.{switch}", cell_request(reads), [NO_WAIT])

    def _write(self, written: Iterable[Written]) -> None:
        weighed: list[tuple[str, str, QueryResult]] = []
        for one in written:
            output = one.output
            value: Any = output.batch if isinstance(output, Captured) else output.to_value()
            at_us = output.last_us if isinstance(output, Captured) else output.at_us
            for key in one.keys:
                if self._evidence.owns(key) or self._auto.owns(key):
                    if isinstance(output, QueryResult):
                        weighed.append((key, one.switch, output))
                    continue
                self._put(key, value, at_us)
        if weighed:
            self._report(self._auto.take(weighed))
            self._say(self._evidence.take(weighed))

    def _put(self, key: str, value: Any, at_us: int) -> None:
        """Write one result."""
        self._written += 1
        self._results[key] = (self._results.get(key, (0, 0))[0] + 1, at_us * 1000)
        self._engine.write(key, value, [NO_WAIT], event_time=at_us * 1000)


def _engine(settings: Settings) -> Callable[..., WindowEngine]:
    """A factory for engines; raises `SparkMissing` if Spark is configured but not installed."""
    if settings.engine == "numpy":
        return HostEngine
    from apps.sonata_adapter.host.spark import SparkEngine, spark_session

    spark_session(settings.spark_master)
    return partial(SparkEngine, master=settings.spark_master)


def cell_request(reads: Sequence[CellRead]) -> RecordBatch:
    """Requests for cells in the controller's format: addresses as two halves."""
    low = (1 << 64) - 1
    return RecordBatch(
        {
            "id": np.array([read.id for read in reads], dtype=np.uint64),
            "query": np.array([read.bit for read in reads], dtype=np.uint8),
            "src_hi": np.array([read.source >> 64 for read in reads], dtype=np.uint64),
            "src_lo": np.array([read.source & low for read in reads], dtype=np.uint64),
            "dst_hi": np.array([read.destination >> 64 for read in reads], dtype=np.uint64),
            "dst_lo": np.array([read.destination & low for read in reads], dtype=np.uint64),
            "port": np.array([read.port for read in reads], dtype=np.uint16),
            "length": np.array([read.length for read in reads], dtype=np.uint16),
            "source_port": np.array([read.source_port for read in reads], dtype=np.uint16),
            "time_us": np.array([read.time_us for read in reads], dtype=np.int64),
            "sweep": np.array([read.sweep for read in reads], dtype=np.uint8),
        }
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the adapter until it is stopped."""
    return int(
        due.service.run("sonata_adapter", SonataAdapterService, Settings, INTERESTS, CAPABILITIES, argv)
    )


if __name__ == "__main__":
    sys.exit(main())
