"""What a publisher hands to Kafka's client, and when."""

import importlib.util
from itertools import pairwise

from due.codec import MAX_PAYLOAD
from due.drivers.kafka_names import MOST_BYTES, parse_kafka_url
from due.keys import MAX_BYTES
from tests.requirements import missing

if importlib.util.find_spec("confluent_kafka") is None:
    missing("confluent_kafka is not installed: pip install 'sdnator[kafka]'")

PATHS = [f"network.flow.writer.p{number}" for number in range(16)]


class Watched:
    """A producer that notes, in order, what it gets and what the brokers have acknowledged."""

    def __init__(self, producer):
        self._producer = producer
        self.got = []
        """(topic, partition); the partition is None when the record is handed over, and known when it is stored."""

    def produce(self, topic, value, key, on_delivery=None):
        def done(error, message):
            self.got.append((topic, message.partition()))
            if on_delivery is not None:
                on_delivery(error, message)

        self.got.append((topic, None))
        self._producer.produce(topic, value, key, on_delivery=done)

    def poll(self, timeout):
        return self._producer.poll(timeout)

    def flush(self, timeout):
        return self._producer.flush(timeout)


def test_the_first_record_of_a_partition_is_alone_on_its_way(kafka_server):
    """A broker may refuse it and accept the next, and would take its repetition for a duplicate."""
    from confluent_kafka import Producer

    from due.drivers.kafka import KafkaPublisher
    from due.drivers.kafka_control import ControlLog

    address = parse_kafka_url(f"{kafka_server.url}/alone")
    control = ControlLog(address)
    producer = Watched(Producer(address.client(**{"enable.idempotence": True, "acks": "all"})))
    publisher = KafkaPublisher("writer", address, control, producer, (1 << 20, 30.0))
    try:
        for _ in range(3):
            for path in PATHS:
                publisher.append(path, b"x")
        publisher.settle(30)
    finally:
        publisher.close()
        control.close()
    topic = address.topic(PATHS[0], reliable=True)
    events = [partition for name, partition in producer.got if name == topic]
    stored = [at for at, partition in enumerate(events) if partition is not None]
    assert len(stored) == 3 * len(PATHS)
    partitions = {events[at] for at in stored}
    assert len(partitions) > 1
    for partition in partitions:
        first = events.index(partition)
        assert events[first - 1] is None
        assert sum(event is None for event in events[:first]) == len([at for at in stored if at <= first])
    assert (None, None) in pairwise(events), "the others do not wait for each other"


def test_the_largest_frame_fits_into_a_record():
    """With the longest key, and with the reason for which it may be set aside; no broker is needed for that."""
    from confluent_kafka import Producer

    producer = Producer({"bootstrap.servers": "127.0.0.1:1", "message.max.bytes": MOST_BYTES, "log_level": 0})
    producer.produce("t", bytes(MAX_PAYLOAD), bytes(MAX_BYTES), headers={"reason": bytes(4096)})
    producer.purge()
    producer.flush(0)
