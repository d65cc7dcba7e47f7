"""`benchmarks.cluster`: three Kafka brokers on this machine, three copies of each topic, two of which must be in sync.

The rates are with the driver's defaults: `acks=all`, an idempotent producer, `linger.ms=1`, four partitions; frames of
up to 96 KiB or 2 ms.  confluent-kafka alone gets the same settings, and frames of 100 messages.
"""

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.cluster_kafka_rates import SIZE, due_rate, raw_rate
from benchmarks.cluster_stage import PartMissing
from benchmarks.measure import interleaved
from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers, kafka_jars

_BROKERS = 3
_SETTINGS = (
    "acks=all, enable.idempotence=true, linger.ms=1, 4 partitions, 3 copies, min.insync.replicas=2; "
    "frames of up to 96 KiB or 2 ms (raw: of 100 messages)"
)
_MESSAGES = 300_000
_MOST_ROUNDS = 3


def figures(rounds: int, scale: float, _end: float) -> dict[str, Any]:
    """Messages a second, medians of at most three rounds."""
    try:
        kafka_jars()
    except KafkaMissing as error:
        raise PartMissing(str(error)) from None
    with (
        tempfile.TemporaryDirectory(prefix="cluster-") as folder,
        KafkaServers(Path(folder) / "kafka", _BROKERS) as servers,
    ):
        count = max(100, round(scale * _MESSAGES) // 100 * 100)
        rates = _rates(servers, min(rounds, _MOST_ROUNDS), count)
    return {
        "kafka_msgs_per_s": rates["due"],
        "kafka_raw_msgs_per_s": rates["raw"],
        "kafka_vs_raw": rates["due"] / rates["raw"],
        "kafka_message_bytes": SIZE,
        "kafka_settings": _SETTINGS,
    }


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
