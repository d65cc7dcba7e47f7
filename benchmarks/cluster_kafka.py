"""`benchmarks.cluster`: three Kafka brokers on this machine, three copies of each topic, two of which must be in sync.

Rates and faults are with the driver's defaults: `acks=all`, an idempotent producer, `linger.ms=1`, four partitions;
frames of up to 96 KiB or 2 ms.  confluent-kafka alone gets the same settings, and frames of 100 messages.  The broker
that leads the stream's partition is killed, frozen, or killed together with the producer right after its `flush`.
"""

import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from confluent_kafka import Consumer, TopicPartition
from confluent_kafka.admin import AdminClient

from benchmarks.cluster_kafka_rates import SIZE, due_rate, raw_rate
from benchmarks.cluster_stage import (
    OUTLIVING_SIZE,
    SLOW_US,
    PartMissing,
    Round,
    StreamStage,
    lost_in,
    median_pause,
    pauses_of,
    rounds_of,
)
from benchmarks.faults_programs import KEY
from benchmarks.measure import interleaved
from due.drivers.kafka_names import parse_kafka_url
from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers, kafka_jars

_BROKERS = 3
_SETTINGS = (
    "acks=all, enable.idempotence=true, linger.ms=1, 4 partitions, 3 copies, min.insync.replicas=2; "
    "frames of up to 96 KiB or 2 ms (raw: of 100 messages)"
)
_RATED = 300_000
_MOST_RATED = 3
_MESSAGES = 50_000
_READING_US = 20
"""How long the reader works on each: the window keeps the producer at its pace, so that the load lasts for seconds."""
_OUTLIVING = 2_000
_BEFORE = 100
_ASK_S = 10.0


def figures(rounds: int, scale: float, end: float) -> dict[str, Any]:
    """Rates (medians of at most three rounds), losses and pauses; no round of faults begins after `end` (s, monotonic)."""
    try:
        kafka_jars()
    except KafkaMissing as error:
        raise PartMissing(str(error)) from None
    with (
        tempfile.TemporaryDirectory(prefix="cluster-") as folder,
        KafkaServers(Path(folder) / "kafka", _BROKERS) as servers,
    ):
        rates = _rates(servers, min(rounds, _MOST_RATED), max(100, round(scale * _RATED) // 100 * 100))

        def run(name: str, number: int) -> Round:
            here = Path(folder) / f"{name}{number}"
            here.mkdir()
            return FAULTS[name](here, servers, f"{servers.url}/{name}{number}", scale)

        found = rounds_of(FAULTS, run, rounds, end)
    return {
        "kafka_msgs_per_s": rates["due"],
        "kafka_raw_msgs_per_s": rates["raw"],
        "kafka_vs_raw": rates["due"] / rates["raw"],
        "kafka_message_bytes": SIZE,
        "kafka_settings": _SETTINGS,
        "kafka_acknowledged_lost": lost_in(found),
        "failover_ms_p50": {"kafka": median_pause(found, "killed")},
        "kafka_pauses_ms": pauses_of(found),
    }


def killed(folder: Path, servers: KafkaServers, url: str, scale: float) -> Round:
    """kill -9 of the broker under load; it comes back afterwards."""
    with _stage(folder, url, round(scale * _MESSAGES), _READING_US) as stage:
        broker = leader(url)
        stage.begin().wait_for_quarter()
        with _dead(servers, broker):
            stage.wait_for_flush()
            return stage.result()


def frozen(folder: Path, servers: KafkaServers, url: str, scale: float) -> Round:
    """SIGSTOP of the broker under load; its connections stay open."""
    with _stage(folder, url, round(scale * _MESSAGES), _READING_US) as stage:
        broker = leader(url)
        stage.begin().wait_for_quarter()
        servers.freeze(broker)
        try:
            stage.wait_for_flush()
            return stage.result()
        finally:
            servers.freeze(broker, frozen=False)


def killed_together(folder: Path, servers: KafkaServers, url: str, scale: float) -> Round:
    """kill -9 of producer and broker as soon as `flush` has returned, while the reader is far behind."""
    with _stage(folder, url, round(scale * _OUTLIVING), SLOW_US, size=OUTLIVING_SIZE) as stage:
        broker = leader(url)
        stage.begin().wait_for_flush()
        stage.producer.process.send_signal(signal.SIGKILL)
        with _dead(servers, broker):
            return stage.result()


FAULTS: dict[str, Callable[[Path, KafkaServers, str, float], Round]] = {
    "killed": killed,
    "frozen": frozen,
    "killed_together": killed_together,
}


def _stage(folder: Path, url: str, messages: int, delay_us: int, **rest: Any) -> StreamStage:
    # some come before, so that the stream has a leader, and a reader that reads
    return StreamStage(folder, url, messages, delay_us=delay_us, before=_BEFORE, **rest)


def leader(url: str) -> int:
    """The number of the broker that leads the partition in which the stream's items are."""
    address = parse_kafka_url(url)
    topic = address.topic(KEY, reliable=True)
    found = AdminClient(address.client()).list_topics(timeout=_ASK_S).topics[topic].partitions
    asking = Consumer(address.client(**{"group.id": "cluster", "enable.auto.commit": False}))
    try:
        ends = {at: asking.get_watermark_offsets(TopicPartition(topic, at), _ASK_S)[1] for at in found}
    finally:
        asking.close()
    return int(found[max(ends, key=ends.__getitem__)].leader)


@contextmanager
def _dead(servers: KafkaServers, broker: int) -> Iterator[None]:
    """Within it the broker is dead; afterwards it is in the cluster again."""
    servers.kill(broker)
    try:
        yield
    finally:
        servers.start_broker(broker)
        servers.wait(_BROKERS)


def _rates(servers: KafkaServers, rounds: int, count: int) -> dict[str, float]:
    """Medians, by who sends."""
    used = iter(range(2 * rounds))  # a namespace for each run
    return interleaved(
        {
            "due": lambda: due_rate(f"{servers.url}/rate{next(used)}", count),
            "raw": lambda: raw_rate(servers.servers, f"raw{next(used)}", count),
        },
        rounds,
    )
