"""A clock ahead of packets that are still to be read would cost them: it waits."""

import importlib.util

import pytest

from tests.requirements import missing

if importlib.util.find_spec("confluent_kafka") is None:
    missing("confluent_kafka is not installed: pip install 'sdnator[kafka]'")


@pytest.fixture
def clock(monkeypatch):
    """The end of the topic is unknown at first, then 10 and 20, then 11 and 20."""
    from apps.sonata_adapter.host.spark_clock import ReadClock
    from due.drivers.kafka_names import parse_kafka_url

    made = ReadClock(parse_kafka_url("kafka://127.0.0.1:1"), "sonata_spark", "due.r.packets")
    ends = iter([None, {0: 10, 1: 20}, {0: 11, 1: 20}])
    monkeypatch.setattr(made, "_ends", lambda: next(ends))
    made.note({"s1": 4_000}, 1.0)
    yield made
    made.close()


def test_times_come_when_every_stream_has_read_the_packets_before_them(clock):
    clock.note({"s1": 5_000}, 2.0)
    assert clock.due([]) is None
    assert clock.due([{}]) is None
    assert clock.due([{0: 10, 1: 20}, {0: 10, 1: 19}]) is None
    clock.note({"s1": 6_000}, 3.0)  # the first ones wait still
    assert clock.due([{0: 10, 1: 20}, {0: 12, 1: 20}]) == (2.0, {"s1": 5_000})
    assert clock.due([{0: 10, 1: 20}]) is None


def test_later_times_wait_for_later_packets(clock):
    clock.note({"s1": 5_000}, 2.0)
    clock.due([{0: 10, 1: 20}])
    clock.note({"s1": 6_000}, 3.0)
    assert clock.due([{0: 10, 1: 20}]) is None
    assert clock.due([{0: 11, 1: 20}]) == (3.0, {"s1": 6_000})
