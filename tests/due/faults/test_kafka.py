"""kill -9 of the broker, the producer or the consumer loses nothing of a reliable path on Kafka."""

import time
from collections.abc import Callable

import pytest

from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers
from tests.due.conftest import wait_for
from tests.requirements import missing

COUNT = 5_000


def test_a_killed_broker_loses_nothing(programs, tmp_path) -> None:
    """The only broker is killed while both sides work; it comes back with its disk."""
    try:
        servers = KafkaServers(tmp_path / "kafka").start()
    except KafkaMissing as reason:
        missing(str(reason))
    try:
        consumer = programs("consume", servers.url, "reader", COUNT, 1)
        consumer.wait_for("ready")
        producer = programs("produce", servers.url, "reliable", COUNT, 50)
        producer.wait_for("1000")
        servers.kill(0)
        time.sleep(0.3)
        servers.start_broker(0)
        producer.wait_for("flushed")
        assert consumer.wait_for("gaps").startswith("gaps 0")
        assert consumer.numbers() == list(range(COUNT))
    finally:
        servers.stop()


@pytest.fixture
def url(kafka_server: KafkaServers, request: pytest.FixtureRequest) -> str:
    """A namespace of this test's own."""
    return f"{kafka_server.url}/{request.node.name}"


def test_a_killed_consumer_is_followed_by_the_next(programs: Callable, url: str) -> None:
    """What it had not acknowledged comes again, in order."""
    first = programs("consume", url, "reader", COUNT, 0.2)
    first.wait_for("ready")
    producer = programs("produce", url, "reliable", COUNT, 20)
    first.wait_for("1000 ")
    first.kill()
    seen = first.numbers()
    second = programs("consume", url, "reader", 10**9, 0)
    wait_for(lambda: set(seen) | set(second.numbers()) == set(range(COUNT)), 120)
    producer.wait_for("flushed")
    again = second.numbers()
    assert again == sorted(again), "order is kept after the take-over"


def test_a_killed_producer_is_followed_by_the_next(programs: Callable, url: str) -> None:
    """What `flush` covered is there, and what the next one writes comes after it."""
    consumer = programs("consume", url, "reader", 10**9, 0)
    consumer.wait_for("ready")
    producer = programs("produce", url, "reliable", 2000, 20)
    producer.wait_for("flushed")
    producer.kill()
    wait_for(lambda: len(consumer.numbers()) >= 2000, 120)
    programs("produce", url, "reliable", 1000, 20).wait_for("flushed")
    wait_for(lambda: len(consumer.numbers()) >= 3000, 120)
    assert consumer.numbers() == [*range(2000), *range(1000)]
