"""How far the switches say that time has come, told when Spark has read all packets before that.  Does I/O.

    states of the switches ─► times, and where the packets' topic ends ─► when Spark has read so far ─► the times

Spark reads packets and clocks from two topics: a clock that is ahead of packets which are still to be read would cost
those packets.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Final

from confluent_kafka import Consumer, KafkaException, TopicPartition

from due.drivers.kafka_names import KafkaAddress

_LOG = logging.getLogger(__name__)
_ASK_S: Final = 2.0

Offsets = Mapping[int, int]
"""Partition to the offset of the next record."""


class ReadClock:
    """Holds times back until their packets were read.

    Args:
        address: of Kafka.
        group: app in whose name Kafka is asked.
        topic: of the packets; it must exist.
    """

    def __init__(self, address: KafkaAddress, group: str, topic: str) -> None:
        self._topic = topic
        self._consumer = Consumer(
            address.client(**{"group.id": address.group(group), "enable.auto.commit": False})
        )
        self._waiting: tuple[float, dict[str, int], Offsets] | None = None

    def note(self, times: Mapping[str, int], now: float) -> None:
        """The switches have come so far; packets of that time were written before.

        Args:
            times: switch to capture time, us.
            now: monotonic time, s.
        """
        if self._waiting is not None:
            return
        try:
            ends = self._ends()
        except KafkaException as error:
            _LOG.debug("the end of %s: %s", self._topic, error)
        else:
            if ends is not None:
                self._waiting = now, dict(times), ends

    def due(self, read: Sequence[Offsets]) -> tuple[float, dict[str, int]] | None:
        """When times were noted, and the times, once everything was read that had been written then.

        Args:
            read: how far each stream has read the topic.
        """
        if self._waiting is None or not read:
            return None
        noted, times, ends = self._waiting
        if any(each.get(place, 0) < end for each in read for place, end in ends.items()):
            return None
        self._waiting = None
        return noted, times

    def close(self) -> None:
        """Disconnect."""
        self._consumer.close()

    def _ends(self) -> Offsets | None:
        """None where the end of a partition is not known."""
        places = self._consumer.list_topics(self._topic, _ASK_S).topics[self._topic].partitions
        found = {
            place: self._consumer.get_watermark_offsets(TopicPartition(self._topic, place), _ASK_S)
            for place in places
        }
        if None in found.values():
            return None
        return {place: end for place, (_, end) in found.items()}
