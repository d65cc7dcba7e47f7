"""Payloads set aside on Kafka: a topic of each app, of one partition.

The client, once it has a payload, sends it until the brokers take or refuse it; what it cannot be given yet waits here.
"""

import logging
import threading
import time

from confluent_kafka import KafkaError, KafkaException, Message, Producer

from due.drivers.aside_queue import AsidePayload, AsideQueue
from due.drivers.base import Delivery, app_of
from due.drivers.kafka_control import ControlLog
from due.drivers.kafka_names import KafkaAddress
from due.errors import BackendError, UpdatesUnavailable
from due.logs import LogLimit

log = logging.getLogger("due.updates")

_REASON = 4096
"""Most bytes of a reason."""
_CALL_SECONDS = 5.0


class KafkaAside:
    """Payloads set aside for the app of a group; thread-safe."""

    def __init__(self, address: KafkaAddress, control: ControlLog, producer: Producer, group: str) -> None:
        self._control, self._producer = control, producer
        self._topic = address.aside(app_of(group))
        self._made = False
        self._queue = AsideQueue(self._store)
        # the client calls `_answered` in threads that hold locks of others: nobody waits for anything under this one
        self._counting = threading.Lock()
        self._given = self._taken = self._refused = 0
        self._errors = LogLimit(log)

    def put(self, delivery: Delivery, payload: bytes, reason: str) -> None:
        """See `Receiver.set_aside`."""
        one = AsidePayload(delivery.path, payload, reason, len(payload))
        self._queue.put(one, time.monotonic())

    def care(self, now: float) -> None:
        """Give to the client what it could not take before."""
        self._queue.care(now)

    def counts(self) -> dict[str, int]:
        """Counters for `health`."""
        with self._counting:
            return {
                "set_aside": self._taken,
                "set_aside_waiting": len(self._queue) + self._unanswered(),
                "set_aside_lost": self._queue.lost + self._refused,
            }

    def close(self) -> None:
        """Try a last time."""
        self._queue.close(time.monotonic())
        if self._unanswered():
            self._producer.flush(_CALL_SECONDS)
        if left := self._unanswered():
            log.error("%d payloads may not have been set aside: Kafka has not answered", left)

    def _unanswered(self) -> int:
        return self._given - self._taken - self._refused

    def _store(self, one: AsidePayload) -> None:
        self._make_topic()
        waits = bool(self._unanswered())
        with self._counting:
            self._given += 1
        reason = one.reason.encode(errors="replace")[:_REASON]
        try:
            self._producer.produce(
                self._topic,
                one.payload,
                one.path.encode(),
                headers={"reason": reason},
                on_delivery=self._answered,
            )
        except (BufferError, KafkaException) as error:
            with self._counting:
                self._given -= 1
            if isinstance(error, BufferError):
                raise UpdatesUnavailable("the client's own queue is full") from None
            raise BackendError(f"{self._topic}: {error.args[0]}") from None
        if not waits:  # otherwise the brokers are away, and each payload would hold up the callbacks
            self._producer.flush(_CALL_SECONDS)

    def _make_topic(self) -> None:
        if self._made:
            return
        try:
            self._control.make_topic(self._topic)
        except BackendError as error:  # it has nothing to do with the payload
            raise UpdatesUnavailable(str(error)) from None
        self._made = True

    def _answered(self, error: KafkaError | None, _message: Message) -> None:
        with self._counting:
            self._taken += error is None
            self._refused += error is not None
        if error is not None:
            self._made = False
            self._errors.error("a payload could not be set aside and is lost: %s: %s", self._topic, error)
