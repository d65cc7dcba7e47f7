"""A clock ahead of packets that are still to be read would cost them: it waits."""

import importlib.util

import pytest

from tests.requirements import missing

if importlib.util.find_spec("confluent_kafka") is None:
    missing("confluent_kafka is not installed: pip install 'sdnator[kafka]'")


@pytest.fixture
def clock(monkeypatch):
    """The topic ends at 10 and 20, then 11 and 20."""
    from apps.sonata_adapter.host.spark_clock import ReadClock
    from due.drivers.kafka_names import parse_kafka_url

    made = ReadClock(parse_kafka_url("kafka://127.0.0.1:1"), "sonata_spark", "due.r.packets")
    ends = iter([{0: 10, 1: 20}, {0: 11, 1: 20}])
    monkeypatch.setattr(made, "_ends", lambda: next(ends))
    yield made
    made.close()


def test_a_time_is_told_when_every_stream_has_read_the_packets_before_it(clock):
    clock.note({"s1": 5_000})
    assert clock.due([]) == {}
    assert clock.due([{}]) == {}
    assert clock.due([{0: 10, 1: 20}, {0: 10, 1: 19}]) == {}
    clock.note({"s1": 6_000})  # the first one waits still
    assert clock.due([{0: 10, 1: 20}, {0: 12, 1: 20}]) == {"s1": 5_000}
    assert clock.due([{0: 10, 1: 20}]) == {}


def test_a_time_is_told_once(clock):
    clock.note({"s1": 5_000})
    clock.due([{0: 10, 1: 20}])
    clock.note({"s1": 5_000})
    assert clock.due([{0: 99, 1: 99}]) == {}
    clock.note({"s1": 5_000, "s2": 7_000})
    assert clock.due([{0: 10, 1: 20}]) == {}
    assert clock.due([{0: 11, 1: 20}]) == {"s2": 7_000}
