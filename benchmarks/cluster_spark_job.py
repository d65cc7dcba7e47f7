"""One driver of Spark that runs queries over all that is on Kafka, twice; prints how long the second time took."""

import json
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import msgspec

from apps.sonata_adapter.arrivals import data_in
from apps.sonata_adapter.host.slowest_switch import SlowestSwitch
from apps.sonata_adapter.host.spark_jars import kafka_connector_jars
from apps.sonata_adapter.host.spark_place import SparkPlace, cluster_session
from apps.sonata_adapter.host.spark_records import WindowJob
from apps.sonata_adapter.host.spark_stream import KafkaPackets, KafkaWindows
from apps.sonata_adapter.spark_service import APP, REACHED, reached_us, requests
from due import NO_WAIT, PUB_ONLY, Engine, Options
from due.drivers.kafka_names import parse_kafka_url
from sdnator.testing.waiting import wait_for

_WAIT_S: Final = 600.0
_QUIET_S: Final = 15.0
"""Without a result after the last packet: there will be none."""
_EVERY_S: Final = 0.2
_IDLE_S: Final = 3_600.0
"""All switches have packets to the end."""


def main(path: str) -> int:
    """Run what a file of settings says."""
    settings = json.loads(Path(path).read_text(encoding="utf-8"))
    source = KafkaPackets(
        address=parse_kafka_url(settings["kafka"]), pattern=settings["packets"], clocks=REACHED, group=APP
    )
    found = list(requests(settings["queries"]).values())
    job = WindowJob(
        queries=tuple(msgspec.json.encode(request.query).decode() for request in found),
        length_us=found[0].query.window_us,
        limit=1 << 20,
        bases=settings["bases"],
        pattern=settings["packets"],
        clocks=source.clock_topic,
        packets_in=data_in,
        clock_in=reached_us,
    )
    session = cluster_session(
        SparkPlace(master=settings["master"], jars=kafka_connector_jars(), options=settings["options"])
    )
    options = Options(directory=settings["directory"], updates=settings["kafka"], coordinated=False)
    with closing(Engine(options)) as engine:
        engine.init(APP)
        begin = _Runs(session, source, job, engine, settings["total"])
        results, _ = begin(f"{settings['checkpoint']}/0", None)
        _, seconds = begin(f"{settings['checkpoint']}/1", results)
    session.stop()
    print(json.dumps({"seconds": seconds, "results": results}), flush=True)
    return 0


class _Runs:
    """Runs the queries over all packets, as the app does: packets are read, and the driver tells the time."""

    def __init__(
        self, session: Any, source: KafkaPackets, job: WindowJob, engine: Engine, packets: int
    ) -> None:
        self._session, self._source, self._job = session, source, job
        self._engine, self._packets = engine, packets

    def __call__(self, checkpoint: str, results: int | None) -> tuple[int, float]:
        """How many results there were, and after how many seconds, s.

        Args:
            checkpoint: a new folder.
            results: how many there will be; None: wait until there are no more.
        """
        taken, last = 0, time.monotonic()

        def take(found: Any) -> None:
            nonlocal taken, last
            if found:
                taken, last = taken + len(found), time.monotonic()

        self._tell(0)
        self._engine.flush()
        began = time.monotonic()
        stream = KafkaWindows(
            self._session,
            self._source,
            self._job,
            lateness_us=500_000,
            checkpoint=checkpoint,
            take=take,
            every_s=_EVERY_S,
        )
        follow = self._follow(stream, began)

        def over() -> bool:
            all_read = follow() >= self._packets
            if results is None:
                return all_read and taken > 0 and time.monotonic() - last > _QUIET_S
            return all_read and taken >= results

        try:
            wait_for(over, _WAIT_S)
        finally:
            stream.stop()
        return taken, last - began

    def _follow(self, stream: KafkaWindows, began: float) -> Callable[[], int]:
        slowest = SlowestSwitch(self._job.bases, began, _IDLE_S)

        def follow() -> int:
            """Tell Spark how far time has come; returns how many packets it has read."""
            time.sleep(_EVERY_S)
            stream.check()
            now = time.monotonic()
            slowest.move(stream.read()[1], now)
            time_us = slowest.next(now)
            if time_us:
                self._tell(time_us)
            return stream.counts()["packets"]

        return follow

    def _tell(self, time_us: int) -> None:
        self._engine.write(REACHED, {"time": time_us * 1000}, [NO_WAIT, PUB_ONLY])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
