"""How many messages a second reach another process over Kafka: DUE on a reliable path, and confluent-kafka alone."""

import itertools
import os
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any, Final

import msgspec
from confluent_kafka import Consumer, Producer, TopicPartition
from confluent_kafka.admin import AdminClient, NewTopic

from benchmarks import pairs
from due import PRODUCER, PUB_ONLY

SIZE: Final = 100
_FRAME: Final = 100
_DIFFERENT: Final = 1_000
_PARTITIONS: Final = 4
_COPIES: Final = 3
_MAKE_S: Final = 60.0
_BATCH: Final = 256
_FLUSH_S: Final = 120.0
_TAKEN_UP_S: Final = 2.0


def due_rate(url: str, count: int) -> float:
    """DUE with its defaults, one callback per message; from the first write to the last callback.

    One message goes ahead, for which the topic is made and the reader takes it up: confluent-kafka alone has both done
    before it begins.
    """
    with pairs.other_process(pairs._due_consumer, url, count + 1) as pipe:
        producer = pairs.engine(url, "producer", PRODUCER, reliable=True)
        messages, write, flags = _messages(), producer.write, [PUB_ONLY]
        write(pairs.KEY, next(messages), flags)
        producer.flush(_FLUSH_S)
        time.sleep(_TAKEN_UP_S)
        start = time.monotonic()
        for _ in range(count):
            write(pairs.KEY, next(messages), flags)
        producer.flush(_FLUSH_S)
        pipe.send("written")
        ended, left = pairs._arrived(pipe)
        producer.close()
    if left:
        raise RuntimeError(f"{left} of {count} reliable messages did not arrive")
    return count / (ended - start)


def raw_rate(servers: str, topic: str, count: int) -> float:
    """confluent-kafka with frames of 100 messages, decoded to lists without callbacks: the bound for any framing.

    Args:
        servers: HOST:PORT of all brokers, separated by commas.
        topic: is made.
        count: of messages, a multiple of 100.
    """
    new = NewTopic(topic, _PARTITIONS, _COPIES, config={"min.insync.replicas": "2"})
    admin = AdminClient({"bootstrap.servers": servers})
    admin.create_topics([new])[topic].result(_MAKE_S)
    with pairs.other_process(_raw_consumer, servers, topic, count // _FRAME) as pipe:
        producer = Producer(
            {
                "bootstrap.servers": servers,
                "enable.idempotence": True,
                "acks": "all",
                "linger.ms": 1,
                "queue.buffering.max.kbytes": 1 << 20,
            }
        )
        messages, encoder, key = _messages(), msgspec.msgpack.Encoder(), pairs.KEY.encode()
        start = time.monotonic()
        for _ in range(count // _FRAME):
            frame = encoder.encode(list(itertools.islice(messages, _FRAME)))
            while not _produced(producer, topic, frame, key):
                producer.poll(0.02)
            producer.poll(0)
        producer.flush(_FLUSH_S)
        return count / (pairs._finished(pipe) - start)


def _messages() -> Iterator[bytes]:
    """Random bytes, so that nothing can be compressed."""
    return itertools.cycle([os.urandom(SIZE) for _ in range(_DIFFERENT)])


def _produced(producer: Producer, topic: str, frame: bytes, key: bytes) -> bool:
    try:
        producer.produce(topic, frame, key)
    except BufferError:
        return False
    return True


def _raw_consumer(pipe: Connection, servers: str, topic: str, frames: int) -> None:
    consumer = Consumer(
        {
            "bootstrap.servers": servers,
            "group.id": topic,
            "enable.auto.commit": False,
            "fetch.wait.max.ms": 50,
            "fetch.message.max.bytes": 1 << 20,
        }
    )
    consumer.assign([TopicPartition(topic, number, 0) for number in range(_PARTITIONS)])
    pipe.send("ready")
    decoder = msgspec.msgpack.Decoder(list[Any])
    while frames > 0:
        for message in consumer.consume(_BATCH, 0.1):
            if message.error() is None:
                decoder.decode(message.value() or b"")
                frames -= 1
    pipe.send(time.monotonic())
    consumer.close()
