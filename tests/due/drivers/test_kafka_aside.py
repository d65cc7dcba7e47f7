"""Payloads set aside on Kafka: counted when the brokers have answered, kept while they are away; without a broker."""

import importlib.util

import pytest

from due.drivers.base import Delivery
from due.drivers.kafka_names import parse_kafka_url
from due.errors import UpdatesUnavailable
from tests.requirements import missing

if importlib.util.find_spec("confluent_kafka") is None:
    missing("confluent_kafka is not installed: pip install 'sdnator[kafka]'")

from confluent_kafka import KafkaError

from due.drivers.kafka_aside import KafkaAside

LONG_AFTER = 1e9
DELIVERY = Delivery("a.b.c", b"x", "t/0/0")


class Brokers:
    """Control log and producer of brokers that are there, or not, or do not answer."""

    def __init__(self):
        self.away = self.silent = False
        self.error = None
        self.taken = []
        self._waiting = []

    def make_topic(self, topic):
        if self.away:
            raise UpdatesUnavailable(f"{topic}: no answer in time")

    def produce(self, _topic, value, _key, *, on_delivery, **_headers):
        self._waiting.append((value, on_delivery))

    def flush(self, _timeout):
        while self._waiting and not self.silent:
            value, answered = self._waiting.pop(0)
            if self.error is None:
                self.taken.append(value)
            answered(self.error, None)


@pytest.fixture
def brokers():
    return Brokers()


@pytest.fixture
def aside(brokers):
    return KafkaAside(parse_kafka_url("kafka://127.0.0.1:1"), brokers, brokers, "group:one")


def counts(aside):
    found = aside.counts()
    return tuple(found[f"set_aside{kind}"] for kind in ("", "_waiting", "_lost"))


def test_what_comes_while_the_brokers_are_away_is_set_aside_later(brokers, aside):
    brokers.away = True
    for payload in (b"1", b"2"):
        aside.put(DELIVERY, payload, "a name that is no text: \udcff")
    assert counts(aside) == (0, 2, 0)
    brokers.away = False
    aside.care(LONG_AFTER)
    aside.close()
    assert brokers.taken == [b"1", b"2"]
    assert counts(aside) == (2, 0, 0)


def test_what_the_client_still_has_counts_as_waiting(brokers, aside):
    aside.put(DELIVERY, b"1", "why")
    brokers.silent = True
    aside.put(DELIVERY, b"2", "why")
    assert counts(aside) == (1, 1, 0)
    brokers.silent = False
    aside.close()
    assert counts(aside) == (2, 0, 0)


def test_what_the_brokers_refuse_is_counted_as_lost(brokers, aside, caplog):
    brokers.error = KafkaError(KafkaError.MSG_SIZE_TOO_LARGE)
    aside.put(DELIVERY, b"1", "why")
    assert counts(aside) == (0, 0, 1)
    assert "is lost" in caplog.text
