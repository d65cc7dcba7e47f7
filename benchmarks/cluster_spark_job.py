"""One driver of Spark that runs queries over all that is on Kafka, twice; prints how long the second time took."""

import json
import sys
import time
from pathlib import Path
from typing import Any

import msgspec

from apps.sonata_adapter.arrivals import data_in
from apps.sonata_adapter.host.spark_jars import kafka_connector_jars
from apps.sonata_adapter.host.spark_place import SparkPlace, cluster_session
from apps.sonata_adapter.host.spark_records import WindowJob
from apps.sonata_adapter.host.spark_stream import KafkaPackets, KafkaWindows
from apps.sonata_adapter.spark_service import APP, SWITCHES, requests
from due import Item
from due.drivers.kafka_names import parse_kafka_url

_WAIT_S = 600


def main(path: str) -> int:
    """Run what a file of settings says."""
    settings = json.loads(Path(path).read_text(encoding="utf-8"))
    source = KafkaPackets(
        address=parse_kafka_url(settings["kafka"]),
        pattern=settings["packets"],
        clocks=SWITCHES,
        group=APP,
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
        clock_in=no_time,
    )
    session = cluster_session(
        SparkPlace(master=settings["master"], jars=kafka_connector_jars(), options=settings["options"])
    )
    took = [_run(session, source, job, f"{settings['checkpoint']}/{turn}") for turn in range(2)]
    session.stop()
    print(json.dumps({"seconds": took[-1]}), flush=True)
    return 0


def no_time(_: Item) -> int:
    """Packets alone tell the time."""
    return 0


def _run(session: Any, source: KafkaPackets, job: WindowJob, checkpoint: str) -> float:
    began = time.monotonic()
    stream = KafkaWindows(
        session, source, job, lateness_us=500_000, checkpoint=checkpoint, take=lambda _: None, every_s=0
    )
    stream.wait(_WAIT_S)
    stream.check()
    return time.monotonic() - began


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
