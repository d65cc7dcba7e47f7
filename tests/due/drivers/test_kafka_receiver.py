"""What a reader on Kafka tells producers about itself; without a broker."""

import importlib.util
import time

import msgspec
import pytest

from due.drivers.kafka_names import parse_kafka_url, topic_prefix
from due.errors import BackendError
from tests.requirements import missing

if importlib.util.find_spec("confluent_kafka") is None:
    missing("confluent_kafka is not installed: pip install 'sdnator[kafka]'")

from due.drivers.kafka_control import ControlLog, topic_record
from due.drivers.kafka_receiver import KafkaReceiver

PATH = "network.block.firewall.ipv4"
ADDRESS = parse_kafka_url("kafka://127.0.0.1:1")
TOPIC = ADDRESS.topic(PATH, reliable=True)


class Record(msgspec.Struct):
    """A message of a control topic."""

    name: str
    data: bytes | None
    called: bytes
    at: int

    def error(self):
        return None

    def topic(self):
        return self.name

    def key(self):
        return self.called

    def value(self):
        return self.data

    def offset(self):
        return self.at


class LocalControl(ControlLog):
    """Knows what was written to it; its brokers let nobody read a topic."""

    def _run(self):
        pass

    def catch_up(self, timeout):
        pass

    def make_topic(self, topic):
        pass

    def partitions(self, topic):
        raise BackendError(f"topic {topic}: Broker: Topic authorization failed")


class LocalProducer:
    """Writes to a `LocalControl`."""

    def __init__(self, control):
        self._control = control
        self._written = 0

    def produce(self, topic, value, key):
        self._control._take([Record(topic, value, key, self._written)])
        self._written += 1

    def poll(self, _timeout):
        return 0

    flush = poll


@pytest.fixture
def control():
    made = LocalControl(ADDRESS)
    yield made
    made.close()


def test_producers_do_not_wait_for_a_reader_without_the_right_to_read(control):
    """Nor do they forget others, also of an earlier version, whose records say nothing about rights."""
    producer = LocalProducer(control)
    key, value = topic_record(TOPIC, topic_prefix(PATH))
    producer.produce(ADDRESS.control("firewall"), value, key)
    earlier = msgspec.msgpack.encode(["nftables", "n1", ["network.block.**"], True, -1, 0, []])
    producer.produce(ADDRESS.control("nftables"), earlier, b"reader:nftables/n1")
    receiver = KafkaReceiver(ADDRESS, control, producer, "mine", "m1", shared=False, backlog=1 << 20)
    try:
        receiver.follow("network.**")
        receiver.renew()
        assert receiver.statistics()["paths_denied"] == 1
        assert control.groups(TOPIC, time.monotonic(), 30.0) == ["nftables"]
    finally:
        receiver.close()
