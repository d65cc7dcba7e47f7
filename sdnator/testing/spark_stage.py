"""Queries on a Spark cluster that reads from Kafka: all servers on this machine, and traffic that stands for a switch's.

controller's engine ─► Kafka ─► Spark's two workers ─► apps.sonata_adapter.spark_service ─► Kafka ─► `results`
                                      └► HDFS: the checkpoint
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from apps.p4runtime_ctrl.service import CAPABILITIES as CONTROLLER
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.results import QueryResult
from apps.sonata_adapter.spark_service import RESULTS, requests
from due import NO_WAIT, PUB_ONLY, Engine, Item, Options
from sdnator.supervisor import Child
from sdnator.testing.hdfs_server import HdfsServer
from sdnator.testing.kafka_servers import KafkaServers
from sdnator.testing.query_traffic import TimedFrame, batch_of
from sdnator.testing.spark_cluster import SparkCluster

QUERIES = tuple(f"{name}:window=2s" for name in CATALOGUE)
"""The whole catalogue, in windows of one length."""
PACKETS = "network.frames.p4runtime_ctrl.*.all"
APP = "apps.sonata_adapter.spark_service"
_READY_S = 300.0


class SparkStage:
    """Kafka, HDFS and a Spark cluster, between enter and exit.

    Args:
        folder: for data, logs and settings.
        workers: of Spark, with a core each.
        memory: of the executor on each worker.
    """

    def __init__(self, folder: Path, workers: int = 2, memory: str = "512m") -> None:
        self.folder = folder
        self.kafka = KafkaServers(folder / "kafka")
        self.hdfs = HdfsServer(folder / "hdfs")
        self.cluster = SparkCluster(folder / "spark", workers, memory)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with self._stack as stack:
            for server in (self.kafka, self.hdfs, self.cluster):
                stack.enter_context(server)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def engine(self, app_id: str, **init: Any) -> Engine:
        """An engine of this process, closed at the end."""
        options = Options(directory=str(self.folder / "due"), updates=self.kafka.url, coordinated=False)
        engine = Engine(options)
        self._stack.callback(engine.close)
        engine.init(app_id, **init)
        return engine

    def controller(self) -> "SwitchesOnKafka":
        """What writes the switches' packets."""
        return SwitchesOnKafka(self.engine("p4runtime_ctrl", capabilities=CONTROLLER))

    def results(self) -> list[Item]:
        """Results, from now on; the list grows."""
        found: list[Item] = []
        self.engine("observer").observe(f"{RESULTS}.*").subscribe(found.append)
        return found

    def app(self, queries: Sequence[str] = QUERIES, **settings: Any) -> Child:
        """Start the app that runs the queries, and return when it is ready."""
        content = {
            "queries": queries,
            "packets": PACKETS,
            "spark_master": self.cluster.url,
            "checkpoint": f"{self.hdfs.url}/sdnator",
            "options": self.cluster.options,
            **settings,
        }
        file = self.folder / "settings.json"
        file.write_text(json.dumps(content), encoding="utf-8")
        command = [APP, "--updates", self.kafka.url, "--archive", f"sqlite://{self.folder / 'archive.db'}"]
        command += ["--directory", str(self.folder / "due"), "--settings", str(file)]
        process = Child(APP, command, self.folder)
        self._stack.callback(process.stop)
        process.wait_ready(_READY_S)
        return process


class SwitchesOnKafka:
    """Writes frames and states as the controller does."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def write(self, switch: str, frames: Sequence[TimedFrame], first: int = 0, size: int = 500) -> None:
        """Frames of a switch; `first` is the arrival number of the first."""
        for at in range(0, len(frames), size):
            part = frames[at : at + size]
            self._engine.write(
                f"network.frames.p4runtime_ctrl.{switch}.all", frames_value(part, first + at), [NO_WAIT]
            )
        self._engine.flush()

    def state(self, switch: str, base_us: int, time_us: int = 0) -> None:
        """A switch's clock zero, and how far its time has come."""
        value = {"switch": switch, "base_us": base_us, "primary": True, "event_time": time_us * 1000}
        self._engine.write(
            f"network.switch.p4runtime_ctrl.{switch}",
            value,
            [NO_WAIT, PUB_ONLY],
            event_time=time_us * 1000 or None,
        )
        self._engine.flush()


def frames_value(frames: Sequence[TimedFrame], first: int) -> dict[str, Any]:
    """What the controller writes for frames of which `first` is the first arrival number."""
    batch = batch_of(list(frames), first)
    return {
        "frames": [frame.data for frame in frames],
        "lengths": batch["length"],
        "times_us": batch["time_us"],
        "ports": batch["port"],
        "sequence": batch["sequence"],
        "arrival": batch["arrival"],
    }


def truth(
    traffic: Mapping[str, Sequence[TimedFrame]], bases: Mapping[str, int], queries: Sequence[str] = QUERIES
) -> list[str]:
    """What the host engine finds in each switch's frames, as `texts` writes it."""
    found: list[tuple[str, Any]] = []
    for switch, frames in traffic.items():
        engine = HostEngine(base_us=bases[switch])
        outputs = {request.query.name: request.output for request in requests(queries).values()}
        for request in requests(queries).values():
            engine.add(request.query)
        results = [*engine.process(batch_of(list(frames))), *engine.finish()]
        found += [(outputs[each.query], each.to_value()) for each in results if isinstance(each, QueryResult)]
    return sorted(_text(key, value) for key, value in found)


def texts(items: Iterable[Item]) -> list[str]:
    """Results of Spark, to be compared."""
    return sorted(_text(item.key, item.value) for item in items)


def _text(key: str, value: Mapping[str, Any]) -> str:
    path, _, specs = key.partition(":")
    return f"{path.rpartition('.')[2]} {specs} {sorted(value.items())}"
