"""kill -9 of the primary under load: the next one, however far behind it was, carries on without a loss."""

import signal
from collections.abc import Iterator

import pytest

from sdnator.testing.sentinel_servers import SentinelServers
from tests.due.faults.test_kill import _until

COUNT = 30_000


@pytest.fixture
def servers(tmp_path) -> Iterator[SentinelServers]:
    """A primary, two replicas and three sentinels of the test's own."""
    with SentinelServers(tmp_path / "servers") as started:
        yield started


def _pair(programs, servers, count, size, *, delay_ms=0):
    """A reader that is ready, and a producer of so many items of so many bytes."""
    consumer = programs("consume", servers.url, "reader", count, delay_ms)
    consumer.wait_for("ready")
    return consumer, programs("produce", servers.url, "reliable", count, size)


@pytest.mark.parametrize("to_write", [0, 1])
def test_a_killed_primary_loses_nothing(programs, tmp_path, to_write):
    """Also where the next one takes no writes before it has a replica."""
    count = 200_000
    with SentinelServers(tmp_path / "servers", to_write=to_write) as servers:
        consumer, producer = _pair(programs, servers, count, 50)
        producer.wait_for("50000")
        servers.kill(servers.primary)
        producer.wait_for("flushed")
        assert consumer.wait_for("gaps").startswith("gaps 0")
        assert consumer.numbers() == list(range(count))


def test_a_primary_that_is_made_a_replica_loses_nothing(programs, servers):
    """By hand; what is still written to the old one is discarded there."""
    count = 200_000
    consumer, producer = _pair(programs, servers, count, 50)
    producer.wait_for("50000")
    old = servers.primary
    servers.hand_over()
    servers.wait_for_other(old)
    producer.wait_for("flushed")
    assert consumer.wait_for("gaps").startswith("gaps 0")
    assert consumer.numbers() == list(range(count))


@pytest.mark.parametrize("behind", ["cut_off", "frozen"])
def test_what_the_new_primary_lacks_is_written_again(programs, servers, behind):
    """Readers and producer know more than either replica: of its entries, its lists and who reads."""
    if behind == "cut_off":
        servers.cut_off(servers.replicas)
    else:
        servers.freeze(servers.replicas)
    consumer, producer = _pair(programs, servers, COUNT, 200)
    _until(lambda: len(consumer.numbers()) >= 5000)
    old, others = servers.primary, servers.replicas
    servers.kill(old)
    if behind == "frozen":
        servers.freeze(others, frozen=False)
    assert "flushed" in producer.wait_for("flushed")
    assert int(producer.wait_for("flushed").split()[1]) > 0, "it sent something again"
    assert consumer.wait_for("gaps").startswith("gaps 0")
    assert consumer.numbers() == list(range(COUNT))


def test_what_was_flushed_outlives_its_producer_and_the_primary(programs, servers):
    """Each item has a frame of its own, so that the reader has not fetched the last ones."""
    count = 2000
    consumer, producer = _pair(programs, servers, count, 5000, delay_ms=1)
    producer.wait_for("flushed")
    producer.process.send_signal(signal.SIGKILL)
    servers.kill(servers.primary)
    assert len(consumer.numbers()) < count
    assert consumer.wait_for("gaps").startswith("gaps 0")
    assert consumer.numbers() == list(range(count))


def test_reader_and_primary_killed_together(programs, servers):
    """What the dead reader had not done comes to the next one, in order."""
    first = programs("consume", servers.url, "reader", COUNT, 0.1)
    first.wait_for("ready")
    producer = programs("produce", servers.url, "reliable", COUNT, 20)
    first.wait_for("3000 ")
    first.kill()
    servers.kill(servers.primary)
    producer.wait_for("flushed")
    second = programs("consume", servers.url, "reader", 10**9, 0)
    _until(lambda: set(first.numbers()) | set(second.numbers()) == set(range(COUNT)))
    again = second.numbers()
    assert again == sorted(again), "order is kept after the take-over"


def test_two_primaries_in_a_row(programs, servers):
    """The one that was killed first comes back as a replica, and is killed again as the primary or not."""
    consumer = programs("consume", servers.url, "reader", 10**9, 0)
    consumer.wait_for("ready")
    producer = programs("produce", servers.url, "reliable", 10**9, 50)
    for _ in range(2):
        seen = len(consumer.numbers())
        _until(lambda seen=seen: len(consumer.numbers()) > seen + 20_000)
        old = servers.primary
        servers.kill(old)
        servers.wait_for_other(old)
        servers.start_server(old)
    seen = len(consumer.numbers())
    _until(lambda: len(consumer.numbers()) > seen + 20_000)
    producer.kill()
    got = consumer.numbers()
    assert got == list(range(len(got)))
