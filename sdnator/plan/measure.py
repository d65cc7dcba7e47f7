"""Measures what the parts of a pipeline cost on this machine: `sdnator plan --measure`.

One switch idle, then at several rates, with more queries, with more consumers; then a few idle switches.
"""

import datetime as dt
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from due import CONSUMER, DueError, Engine, Item, Options
from due.codec import pack
from due.drivers.sqlite import SqliteArchive
from sdnator.errors import PipelineError
from sdnator.plan.costs import Costs, ProcessCost
from sdnator.plan.measured_pipeline import FIRST_SWITCH, LoadPhase, MeasuredPipeline
from sdnator.report.flow_picture import SERVICES

PER_SWITCH = ("switch", "spare")
TRAIN_S = 20.0
"""At the highest rate, so that what follows is no surprise to Kitsune, and no work for the firewall."""
_SCORES = "network.anomaly.kitsune.score"
_QUERIES = tuple(
    f"network.traffic_query.sonata.{name}:threshold=1000,window=5s"
    for name in ("superspreader", "port_scan", "ddos", "dns_tunnel")
)
_CONSUMERS = 4
_SERVED_S = 5.0
"""Until new queries are in force."""
_ROWS, _ROW_BYTES, _BATCH = 2_000, 16_384, 20
_NOISE_S, _NOISE = 0.03, 0.05
"""Of CPU: three ticks of the kernel's clock, or a share of it."""
_DAY = "%Y-%m-%d"

Tell = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """What is measured, and for how long."""

    rates: tuple[float, ...] = (100.0, 1000.0, 4000.0)
    """Packets a second at one switch, ascending."""
    seconds: float = 10.0
    """Of each phase."""
    more: bool = True
    """Also with more queries, more consumers, more switches."""
    further_switches: int = 2


def measured(schedule: Schedule, tell: Tell) -> Costs:
    """The costs on this machine; takes about two minutes.

    Args:
        schedule: what to measure.
        tell: gets a line of progress before each phase.

    Raises:
        BadInput: no root.
        PipelineError: the pipeline does not start, or cannot carry the lowest rate.
    """
    with tempfile.TemporaryDirectory(prefix="sdnator-plan-") as name:
        folder = Path(name)
        tell("starting a pipeline with one switch")
        train = round(schedule.rates[-1] * TRAIN_S)
        with MeasuredPipeline(folder / "1", 1, train) as pipeline:
            begun = pipeline.mib()
            costs = one_switch(pipeline, schedule, train, tell)
        if schedule.more:
            number = 1 + schedule.further_switches
            tell(f"starting a pipeline with {number} switches, without packets")
            with MeasuredPipeline(folder / "2", number, train, ports=False) as pipeline:
                costs = _with_switches(costs, begun, pipeline, schedule)
        tell("filling an archive")
        return replace(costs, sqlite_bytes_per_s=_sqlite_bytes_per_s(folder))


def one_switch(pipeline: MeasuredPipeline, schedule: Schedule, train: int, tell: Tell) -> Costs:
    """Costs from a pipeline with one switch that has just started."""
    tell(f"{schedule.seconds:g} s without packets")
    idle = pipeline.idle(schedule.seconds)
    tell(f"training on {train:,} packets")
    pipeline.loaded(schedule.rates[-1], TRAIN_S)
    carried: list[LoadPhase] = []
    for rate in schedule.rates:
        tell(f"{schedule.seconds:g} s at {rate:,.0f} packets a second")
        phase = pipeline.loaded(rate, schedule.seconds)
        if not phase.carried:
            break
        carried.append(phase)
    if not carried:
        raise PipelineError(
            f"this machine cannot carry {schedule.rates[0]:,.0f} packets a second now: stop what else runs here"
        )
    reference_us = carried[-1].reference_us
    idle, carried = idle.at(reference_us), [each.at(reference_us) for each in carried]
    note = "" if len(carried) == len(schedule.rates) else f"{rate:,.0f} packets a second were too many"
    costs = replace(_costs(idle, carried, pipeline), note=note)
    return _with_more(costs, idle, carried, pipeline, schedule, tell) if schedule.more else costs


def _costs(idle: LoadPhase, phases: Sequence[LoadPhase], pipeline: MeasuredPipeline) -> Costs:
    mib = pipeline.mib()
    processes = {
        name: ProcessCost(
            per_switch=name in PER_SWITCH,
            idle_cores=idle.cpu_s[name] / idle.elapsed_s,
            us_per_packet=tuple(1e6 * over_idle(phase, idle, name) / phase.sent for phase in phases),
            mib=mib.get(name, 0.0),
        )
        for name in sorted(idle.cpu_s)
    }
    paths = _paths(pipeline.health())
    return Costs(
        machine=processor(),
        cores=os.cpu_count() or 1,
        measured=dt.datetime.now(dt.UTC).strftime(_DAY),
        reference_us=phases[-1].reference_us,
        rates=tuple(phase.sent / phase.load_s for phase in phases),
        processes=processes,
        updates_in=_per_packet(phases, idle, "updates_in"),
        updates_out=_per_packet(phases, idle, "updates_out"),
        archive=_per_packet(phases, idle, "archived"),
        archive_idle=max(0.0, idle.archived / idle.elapsed_s),
        keys=len(paths),
        switch_keys=sum(FIRST_SWITCH in path.split(".") for path in paths),
        topics=_topics(),
    )


def over_idle(phase: LoadPhase, idle: LoadPhase, name: str) -> float:
    """CPU seconds of a phase that its packets have caused."""
    return max(0.0, phase.cpu_s.get(name, 0.0) - idle.cpu_s.get(name, 0.0) / idle.elapsed_s * phase.elapsed_s)


def _per_packet(phases: Sequence[LoadPhase], idle: LoadPhase, what: str) -> tuple[float, ...]:
    rest = getattr(idle, what) / idle.elapsed_s
    return tuple(max(0.0, (getattr(each, what) - rest * each.elapsed_s) / each.sent) for each in phases)


def _with_more(
    costs: Costs,
    idle: LoadPhase,
    phases: Sequence[LoadPhase],
    pipeline: MeasuredPipeline,
    schedule: Schedule,
    tell: Tell,
) -> Costs:
    """Costs of queries and consumers, at the middle rate."""
    place = len(phases) // 2
    rate, before = schedule.rates[place], phases[place]
    tell(f"the same with {len(_QUERIES)} more queries")
    with _readers(pipeline, 1, _QUERIES):
        queries = pipeline.loaded(rate, schedule.seconds).at(costs.reference_us)
    tell(f"the same with {_CONSUMERS} more consumers")
    with _readers(pipeline, _CONSUMERS, (_SCORES,)):
        consumers = pipeline.loaded(rate, schedule.seconds).at(costs.reference_us)
    processes = {
        name: replace(
            cost,
            us_per_query=1e6 * _more_cpu(queries, before, idle, name) / len(_QUERIES),
            us_per_consumer=1e6 * _more_cpu(consumers, before, idle, name) / _CONSUMERS,
        )
        for name, cost in costs.processes.items()
    }
    return replace(
        costs,
        processes=processes,
        query_updates_in=_more_bytes(queries, before, "updates_in") / len(_QUERIES),
        query_updates_out=_more_bytes(queries, before, "updates_out") / len(_QUERIES),
        query_archive=_more_bytes(queries, before, "archived") / len(_QUERIES),
        consumer_updates_out=_more_bytes(consumers, before, "updates_out") / _CONSUMERS,
    )


def _more_cpu(phase: LoadPhase, before: LoadPhase, idle: LoadPhase, name: str) -> float:
    """Seconds a packet; none where the difference is what repeating a phase makes, too."""
    now, then = over_idle(phase, idle, name), over_idle(before, idle, name) * phase.sent / before.sent
    return (now - then) / phase.sent if now - then > max(_NOISE_S, _NOISE * then) else 0.0


def _more_bytes(phase: LoadPhase, before: LoadPhase, what: str) -> float:
    more: float = getattr(phase, what) / phase.sent - getattr(before, what) / before.sent
    return max(0.0, more)


@contextmanager
def _readers(pipeline: MeasuredPipeline, number: int, keys: Sequence[str]) -> Iterator[None]:
    """So many apps that observe each of these keys."""
    found = pipeline.running
    with ExitStack() as stack:
        try:
            for each in range(number):
                directory = str(pipeline.folder / f"reader{each}")
                engine = Engine(Options(directory=directory, updates=found.updates, archive=found.archive))
                stack.callback(engine.close)
                engine.init(f"plan_reader{each}", CONSUMER)
                for key in keys:
                    engine.observe(key).subscribe(_forget)
        except DueError as error:
            raise PipelineError(f"an app to be measured did not start: {error}") from None
        time.sleep(_SERVED_S)
        yield


def _forget(_: Item) -> None:
    pass


def _with_switches(
    costs: Costs, begun: Mapping[str, float], pipeline: MeasuredPipeline, schedule: Schedule
) -> Costs:
    """What further switches cost that forward nothing; `begun` is the memory of one with one switch, when it began."""
    mib, further = pipeline.mib(), pipeline.switches - 1
    idle = pipeline.idle(schedule.seconds).at(costs.reference_us)

    def more(name: str, cost: ProcessCost) -> ProcessCost:
        if cost.per_switch:
            return cost
        cores = idle.cpu_s.get(name, 0.0) / idle.elapsed_s - cost.idle_cores
        memory = mib.get(name, 0.0) - begun.get(name, 0.0)
        return replace(cost, switch_cores=max(0.0, cores / further), switch_mib=max(0.0, memory / further))

    return replace(costs, processes={name: more(name, cost) for name, cost in costs.processes.items()})


def _paths(health: Mapping[str, Any]) -> set[str]:
    """Paths that apps have written to; each has a stream or a channel of its own."""
    found: set[str] = set()
    for told in health.values():
        found |= set(told.get("health", {}).get("engine", {}).get("keys", {}))
    return found


def _topics() -> tuple[int, int]:
    """Topics on Kafka of all keys that the product's apps declare: the first three segments of a path name one."""
    reliable: set[tuple[str, ...]] = set()
    others: set[tuple[str, ...]] = set()
    for module in SERVICES.values():
        for one in import_module(module).CAPABILITIES:
            topic = tuple(str(one.key).partition(":")[0].split(".")[:3])
            (reliable if one.delivery == "reliable" else others).add(topic)
    return len(reliable), len(others - reliable)


def _sqlite_bytes_per_s(folder: Path) -> float:
    """How many bytes of frames an archive takes a second."""
    values = np.random.default_rng(1).bytes(_ROW_BYTES)
    frames = [pack([Item("plan.archive", values, n, n, "plan", "i", n)]) for n in range(_ROWS)]
    archive = SqliteArchive(f"sqlite://{folder}/filled.db")
    began = time.perf_counter()
    try:
        for start in range(0, _ROWS, _BATCH):
            archive.insert_frames(frames[start : start + _BATCH])
    finally:
        archive.close()
    return _ROWS * _ROW_BYTES / (time.perf_counter() - began)


def processor() -> str:
    """The model of this machine's processor."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return "unknown"
