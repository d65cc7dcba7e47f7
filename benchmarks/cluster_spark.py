"""`benchmarks.cluster`: queries on a Spark standalone cluster of two workers that reads the packets from Kafka itself.

    packets of two switches ─► Kafka ─► two workers, one killed in between ─► results, compared with the host engine's
    packets of eight ─► Kafka ─► one worker, then two, from first record to last result ─► spark_speedup_2_workers

`spark_equal_queries`: how many of the catalogue's queries found something, and exactly what the host engine finds, field
by field; `spark_queries` names them.  The workers share no folder: Spark's checkpoint is on HDFS, and as root each has
a /tmp and process numbers of its own.  On two cores the speed-up shows that the work divides, and no more than that:
workers, driver, Kafka and HDFS take turns on them.
"""

import json
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from apps.sonata_adapter.host.spark import SparkMissing
from apps.sonata_adapter.host.spark_jars import kafka_connector_jars
from apps.sonata_adapter.query.catalogue import CATALOGUE
from benchmarks.cluster_stage import PartMissing
from benchmarks.measure import interleaved
from sdnator.supervisor import Child
from sdnator.testing.kafka_servers import KafkaMissing, kafka_jars
from sdnator.testing.query_traffic import BASE_US, TimedFrame, mixed
from sdnator.testing.spark_stage import PACKETS, QUERIES, SparkStage, texts, truth
from sdnator.testing.waiting import wait_for

_BASES: Final = {"s1": BASE_US + 300_000, "s2": BASE_US - 7_123_456}
_HALF_US: Final = 9_000_000
_SECONDS: Final = 18.0
_WAIT_S: Final = 600.0
_STATE_S: Final = 0.5
"""Between two states of a switch; the controller writes one a second."""
_SETTINGS: Final[dict[str, Any]] = {"every_s": 0.2, "idle_s": 3_600.0}
"""Other than the default: the time of both switches stands still while a worker dies, and neither may go on alone."""
_SWITCHES: Final = 8
_MOST_TIMED: Final = 3
_MEMORY: Final = "1g"
"""Of each executor where time is taken, as Spark has it by default."""
_NOTE: Final = (
    "a core for each worker; on a machine of two cores workers, driver, Kafka and HDFS share them, "
    "so that 2 cannot be reached"
)


def figures(rounds: int, scale: float, end: float) -> dict[str, Any]:
    """Queries with equal results, and the rates of one worker and of two; no timed round begins after `end`."""
    try:
        kafka_jars()
        kafka_connector_jars()
    except (KafkaMissing, SparkMissing) as error:
        raise PartMissing(str(error)) from None
    with tempfile.TemporaryDirectory(prefix="cluster-") as name:
        folder = Path(name)
        with SparkStage(folder / "equal") as stage:
            names = _equal(stage)
        found: dict[str, Any] = {"spark_equal_queries": len(names), "spark_queries": names}
        found["spark_settings"] = _SETTINGS
        if time.monotonic() >= end:
            return found
        with SparkStage(folder / "timed", memory=_MEMORY) as stage:
            return found | _speed(stage, min(rounds, _MOST_TIMED), scale)


def _equal(stage: SparkStage) -> list[str]:
    """Names of the queries that found what the host engine finds, though a worker died."""
    traffic = {"s1": mixed(CATALOGUE, seconds=_SECONDS), "s2": mixed(CATALOGUE, seconds=_SECONDS, seed=2)}
    found = stage.results()
    controller = stage.controller()
    for switch, base_us in _BASES.items():
        controller.state(switch, base_us)
    halves = {
        switch: sum(frame.time_us < BASE_US + _HALF_US for frame in frames)
        for switch, frames in traffic.items()
    }
    for switch, half in halves.items():
        controller.write(switch, traffic[switch][:half])
    app = stage.app(**_SETTINGS)

    def arrived(reached_us: int) -> int:
        app.check()
        for switch, base_us in _BASES.items():
            controller.state(switch, base_us, BASE_US + reached_us)
        time.sleep(_STATE_S)
        return len(found)

    wait_for(lambda: arrived(_HALF_US), _WAIT_S)
    stage.cluster.kill_worker(0)
    for switch, half in halves.items():
        controller.write(switch, traffic[switch][half:], half)
    wanted = truth(traffic, _BASES)
    wait_for(lambda: arrived(10 * _HALF_US) >= len(wanted), _WAIT_S)
    return equal(texts(found), wanted, sorted(CATALOGUE))


def equal(given: Sequence[str], wanted: Sequence[str], names: Iterable[str]) -> list[str]:
    """Those of the queries that found something, and exactly what was wanted; lines begin with the query's name."""
    return [name for name in names if _of(wanted, name) and _of(given, name) == _of(wanted, name)]


def _of(lines: Sequence[str], name: str) -> list[str]:
    return [line for line in lines if line.startswith(f"{name} ")]


def _speed(stage: SparkStage, rounds: int, scale: float) -> dict[str, Any]:
    controller = stage.controller()
    packets = 0
    for number in range(_SWITCHES):
        frames = _long(mixed(CATALOGUE, seconds=_SECONDS, seed=number), max(1, round(10 * scale)))
        controller.state(f"s{number}", BASE_US)
        controller.write(f"s{number}", frames)
        packets += len(frames)
    rates = interleaved(
        {
            "one": lambda: packets / _seconds(stage, 1, packets),
            "two": lambda: packets / _seconds(stage, 2, packets),
        },
        rounds,
    )
    return {
        "spark_packets": packets,
        "spark_packets_per_s": rates,
        "spark_speedup_2_workers": rates["two"] / rates["one"],
        "spark_speedup_note": _NOTE,
    }


def _long(frames: list[TimedFrame], times: int) -> list[TimedFrame]:
    """The same traffic over and over."""
    step = int(_SECONDS * 1e6)
    return [
        frame._replace(time_us=frame.time_us + turn * step)
        for turn in range(times)
        for frame in frames
        if frame.time_us < BASE_US + step
    ]


def _seconds(stage: SparkStage, cores: int, packets: int) -> float:
    """From the first record to the last result, by a driver that has done it once before."""
    settings = {
        "kafka": stage.kafka.url,
        "directory": str(stage.folder / "due"),
        "packets": PACKETS,
        "total": packets,
        "queries": QUERIES,
        "bases": {f"s{number}": BASE_US for number in range(_SWITCHES)},
        "master": stage.cluster.url,
        "checkpoint": f"{stage.hdfs.url}/timed{time.monotonic_ns()}",
        "options": {**stage.cluster.options, "spark.cores.max": str(cores)},
    }
    file = stage.folder / "job.json"
    file.write_text(json.dumps(settings), encoding="utf-8")
    process = Child("benchmarks.cluster_spark_job", ["benchmarks.cluster_spark_job", str(file)], stage.folder)
    try:
        return float(process.wait_ready(_WAIT_S)["seconds"])
    finally:
        process.stop()
