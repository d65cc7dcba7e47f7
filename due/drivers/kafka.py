"""Data Updates on Kafka: topics of three segments, record keys are paths, acknowledgement is a committed offset.

publish ──► producer that gives up after seconds ──► due.b.…   one partition, kept for a minute
append  ──► idempotent producer, acks=all, for ever ──► due.r.…   until every living group has committed
                  ▲ window: bytes that some group has not committed
due.control.<app> tells who reads; a consumer of each group, which never joins it, asks how far it has come
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping

from confluent_kafka import Consumer, KafkaError, KafkaException, Message, Producer, TopicPartition

from due.drivers.base import NO_RIGHT
from due.drivers.kafka_control import ControlLog, topic_record
from due.drivers.kafka_names import MOST_BYTES, KafkaAddress, is_denied, parse_kafka_url, topic_prefix
from due.drivers.kafka_progress import AwaitedGroups, Partition, PathWindow, SentRecord
from due.drivers.kafka_receiver import KafkaReceiver
from due.errors import BackendError, DueError, Timeout, UpdatesUnavailable

log = logging.getLogger("due.updates")

_BEST_EFFORT_MS = 5_000
_ANNOUNCE_SECONDS = 5.0
_ASK_SECONDS = 0.02
_LOOK_SECONDS = 0.5
_CALL_SECONDS = 2.0
_TIDY_SECONDS = 60.0
_SILENT_HOUR = 3600.0
_POLL_SECONDS = 0.1
_MOST_DENIED = 1024


class KafkaUpdates:
    """The driver behind kafka:// URLs; see `due.drivers.base.UpdatesDriver`."""

    def __init__(
        self,
        url: str,
        *,
        window: int = 16 << 20,
        group_timeout: float = 30.0,
        backlog: int = 32 << 20,
    ) -> None:
        self.url = url
        self._address = parse_kafka_url(url)
        self._limits = (window, group_timeout)
        self._backlog = backlog
        self._control = ControlLog(self._address)
        self._producer = Producer(
            self._address.client(
                **{
                    "enable.idempotence": True,
                    "acks": "all",
                    "message.timeout.ms": 0,
                    "linger.ms": 1,
                    "partitioner": "murmur2",
                    "message.max.bytes": MOST_BYTES,
                    "queue.buffering.max.kbytes": 1 << 20,
                }
            )
        )

    def publisher(self, app: str) -> "KafkaPublisher":
        """A new sending half."""
        return KafkaPublisher(app, self._address, self._control, self._producer, self._limits)

    def receiver(self, group: str, consumer: str, *, shared: bool = False) -> KafkaReceiver:
        """A new receiving half."""
        return KafkaReceiver(
            self._address,
            self._control,
            self._producer,
            group,
            consumer,
            shared=shared,
            backlog=self._backlog,
        )

    def close(self) -> None:
        """End the thread that reads the control topic."""
        self._control.close()
        self._producer.flush(0)


class GroupPositions:
    """Asks Kafka how far groups have come, with a consumer for each that never joins it.

    The client's administration call for this follows a null pointer while a group's broker moves.
    """

    def __init__(self, address: KafkaAddress) -> None:
        self._address = address
        self._consumers: dict[str, Consumer] = {}

    def of(self, group: str, partitions: list[Partition]) -> Mapping[Partition, int]:
        """Committed offsets; a partition without one is missing, one that cannot be told now is at -1.

        Raises:
            UpdatesUnavailable: the group's broker does not answer now.
        """
        if group not in self._consumers:
            self._consumers[group] = Consumer(
                self._address.client(**{"group.id": self._address.group(group), "enable.auto.commit": False})
            )
        wanted = [TopicPartition(topic, number) for topic, number in partitions]
        try:
            found = self._consumers[group].committed(wanted, timeout=_CALL_SECONDS)
        except KafkaException as error:
            raise UpdatesUnavailable(f"positions of {group}: {error.args[0]}") from None
        return {
            (one.topic, one.partition): one.offset if one.error is None else -1
            for one in found
            if one.error is not None or one.offset >= 0
        }

    def keep_only(self, groups: set[str]) -> None:
        """Close the consumers of other groups."""
        for group in set(self._consumers) - groups:
            self._consumers.pop(group).close()

    def close(self) -> None:
        """Close all."""
        self.keep_only(set())


class KafkaPublisher:
    """See `due.drivers.base.Publisher`."""

    def __init__(
        self,
        app: str,
        address: KafkaAddress,
        control: ControlLog,
        reliable: Producer,
        limits: tuple[int, float],
    ) -> None:
        self._app = app
        self._address, self._control, self._reliable = address, control, reliable
        self._window, self._group_timeout = limits
        self._lock = threading.RLock()
        self._room = threading.Condition(self._lock)
        self._windows: dict[str, PathWindow] = {}
        self._topics: dict[str, list[int]] = {}
        """Topics that are announced, and the partitions of reliable ones."""
        self._positions = GroupPositions(address)
        self._awaited = AwaitedGroups(self._group_timeout)
        self._closed = False
        self.answered = 0
        """See `Publisher.answered`."""
        self._probe_wanted = threading.Event()
        self._probe_now = 0
        self._denied: set[str] = set()
        """Topics without a right to write them."""
        self._begun: dict[str, set[int]] = {}
        """Reliable topics, and those of their partitions that have a record of this producer."""
        self._beginning = threading.Lock()
        self._counts = {
            "refused": 0,
            "denied": 0,
            "lost_disconnected": 0,
            "reconnects": 0,
            "held_back": 0,
            "resent": 0,
        }
        self._connected = True
        self._failure: BaseException | None = None
        self._tidy_at = 0.0
        self._best_effort = Producer(
            address.client(
                **{
                    "acks": 1,
                    "message.timeout.ms": _BEST_EFFORT_MS,
                    "linger.ms": 0,
                    "message.max.bytes": MOST_BYTES,
                    "queue.buffering.max.kbytes": 64 << 10,
                    "error_cb": self._client_error,
                }
            )
        )
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), name=f"due-kafka-{name}", daemon=True)
            for name, work in (("progress", self._follow_readers), ("probe", self._probe_brokers))
        ]
        for thread in self._threads:
            thread.start()

    def publish(self, path: str, *payloads: bytes) -> None:
        """See `Publisher.publish`."""
        if self._is_denied(path, reliable=False):
            self._counts["denied"] += len(payloads)
            return
        try:
            topic = self._announced(path, reliable=False)
            self._check_connection()
            for payload in payloads:
                self._best_effort.produce(topic, payload, path.encode(), on_delivery=self._best_effort_done)
        except (UpdatesUnavailable, Timeout, BufferError) as error:
            self._counts["lost_disconnected"] += len(payloads)
            raise UpdatesUnavailable(str(error)) from None
        except KafkaException as error:
            self._counts["refused"] += len(payloads)
            raise BackendError(f"{path}: {error.args[0]}") from None
        finally:
            self._best_effort.poll(0)

    def append(self, path: str, payload: bytes) -> None:
        """See `Publisher.append`."""
        if path not in self._windows and self._is_denied(path, reliable=True):
            self._counts["denied"] += 1
            return
        window = self._windows.get(path) or self._open_window(path)
        with self._lock:
            if not window.has_room(len(payload)):
                self._counts["held_back"] += 1
                self._wait_for_readers(window, len(payload))
            self._check()
            record = window.add(len(payload))
        self._produce(window, record, payload)

    def has_room(self, path: str) -> bool:
        """See `Publisher.has_room`."""
        window = self._windows.get(path)
        return window is None or (not window.waiting and window.has_room(0))

    def settle(self, timeout: float | None = None) -> None:
        """See `Publisher.settle`."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            self._check()
            left = _LOOK_SECONDS if deadline is None else min(_LOOK_SECONDS, deadline - time.monotonic())
            try:
                self._control.ask(max(0.05, left))
                if not self._reliable.flush(max(0.0, left)):
                    return
            except UpdatesUnavailable:
                log.debug("waiting for Kafka at %s", self._address.servers)
            if deadline is not None and time.monotonic() > deadline:
                raise Timeout(f"Kafka at {self._address.servers} did not acknowledge within {timeout} s")

    def poll(self) -> float:
        """See `Publisher.poll`."""
        self._control.check()
        if self._failure is not None:
            raise self._failure
        self._reliable.poll(0)
        self._best_effort.poll(0)
        return _POLL_SECONDS

    def probe(self, now: int) -> None:
        """See `Publisher.probe`; a thread asks."""
        self._probe_now = now
        self._probe_wanted.set()

    def statistics(self) -> dict[str, int]:
        """See `Publisher.statistics`."""
        with self._lock:
            kept = sum(window.kept_bytes for window in self._windows.values())
            return {
                **self._counts,
                "connected": int(self._connected),
                "kept_bytes": kept,
                "streams": len(self._windows),
            }

    def close(self) -> None:
        """See `Publisher.close`."""
        with self._lock:
            self._closed = True
            self._room.notify_all()
        self._probe_wanted.set()
        for thread in self._threads:
            thread.join(10)
        self._best_effort.flush(1)
        self._positions.close()

    def _check(self) -> None:
        if self._closed:
            raise UpdatesUnavailable("the engine is closed")
        self._control.check()

    def _check_connection(self) -> None:
        if not self._connected:
            raise UpdatesUnavailable(f"no connection to {self._address.servers}")

    def _is_denied(self, path: str, *, reliable: bool) -> bool:
        """Whether the right to write a path is missing: what was to be said is lost, and everything else goes on."""
        topic = self._address.topic(path, reliable=reliable)
        if topic in self._topics:
            return False
        if topic in self._denied:
            return True
        try:
            self._announced(path, reliable=reliable)
        except (UpdatesUnavailable, Timeout):
            return False
        except BackendError as error:
            if not is_denied(error):
                raise
            reason = str(error)
        else:
            return False
        if len(self._denied) >= _MOST_DENIED:
            self._denied.clear()
        self._denied.add(topic)
        log.error(NO_RIGHT, self._app, path, reason)
        return True

    def _announced(self, path: str, *, reliable: bool) -> str:
        """The topic of a path; made and announced when it is used for the first time."""
        topic = self._address.topic(path, reliable=reliable)
        if topic in self._topics:
            return topic
        self._check()
        if not self._control.knows(topic):
            self._control.make_topic(topic)
            self._control.make_topic(self._address.control(self._app))
            self._say(*topic_record(topic, topic_prefix(path)))
        self._control.catch_up(_ANNOUNCE_SECONDS)
        partitions = self._control.partitions(topic)
        with self._lock:
            self._topics[topic] = partitions
        return topic

    def _say(self, key: bytes, value: bytes) -> None:
        self._reliable.produce(self._address.control(self._app), value, key)
        if self._reliable.flush(_ANNOUNCE_SECONDS):
            raise UpdatesUnavailable(f"Kafka at {self._address.servers} does not take records now")

    def _open_window(self, path: str) -> PathWindow:
        """Make the window of a path; waits while the brokers are away, as a full window does."""
        while True:
            try:
                topic = self._announced(path, reliable=True)
                break
            except (UpdatesUnavailable, Timeout) as error:
                self._check()
                log.warning("%s: %s; trying again", path, error)
                time.sleep(_LOOK_SECONDS)
        with self._lock:
            return self._windows.setdefault(path, PathWindow(path, topic, self._window))

    def _produce(self, window: PathWindow, record: SentRecord, payload: bytes) -> None:
        """Hand a payload to Kafka's client; a producer's first one in a partition is alone on its way.

        A broker that does not know of a new partition yet refuses a batch, may accept the next one a moment later, and
        takes the repeated first one for a duplicate: a producer of which it has nothing may begin with any number.
        """
        if window.begun or self._begun.get(window.topic, set()).issuperset(self._topics[window.topic]):
            self._hand_over(window, record, payload)
            return
        with self._beginning:
            self._hand_over(window, record, payload)
            while record.place is None:
                self._check()
                self._reliable.poll(_ASK_SECONDS)
            self._begun.setdefault(window.topic, set()).add(record.place[0])
            window.begun = True

    def _hand_over(self, window: PathWindow, record: SentRecord, payload: bytes) -> None:
        def done(error: KafkaError | None, message: Message) -> None:
            self._delivered(window, record, error, message)

        while True:
            try:
                self._reliable.produce(window.topic, payload, window.path.encode(), on_delivery=done)
            except BufferError:  # the client's own queue is full, of all paths together
                self._check()
                self._reliable.poll(_ASK_SECONDS)
            except KafkaException as error:
                with self._lock:
                    self._counts["refused"] += 1
                    record.place = (0, -1)  # nobody will ever read it
                raise BackendError(f"{window.path}: {error.args[0]}") from None
            else:
                self._reliable.poll(0)
                return

    def _delivered(
        self, window: PathWindow, record: SentRecord, error: KafkaError | None, message: Message
    ) -> None:
        with self._lock:
            if error is not None:
                self._counts["refused"] += 1
                record.place = (0, -1)
                log.error("%s: Kafka refused a payload: %s", window.path, error)
                return
            # without an offset the brokers had it already: it lies before what comes next
            offset = message.offset()
            record.place = (
                int(message.partition() or 0),
                offset if offset is not None and offset >= 0 else -1,
            )

    def _best_effort_done(self, error: KafkaError | None, _message: Message) -> None:
        if error is not None:
            self._counts["lost_disconnected"] += 1
        elif not self._connected:
            self._connected = True
            self._counts["reconnects"] += 1

    def _client_error(self, error: KafkaError) -> None:
        if error.code() == KafkaError._ALL_BROKERS_DOWN:  # noqa: SLF001
            self._connected = False

    def _wait_for_readers(self, window: PathWindow, size: int) -> None:
        """Back-pressure: wait until the window has room; the lock is held, and given up meanwhile."""
        window.waiting = True
        try:
            while not window.has_room(size):
                self._check()
                self._room.wait(_ASK_SECONDS)
                self._reliable.poll(0)
        finally:
            window.waiting = False

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:
            self._failure = error
            log.exception("a thread of the Kafka publisher has died")

    def _follow_readers(self) -> None:
        """Free what every living group has committed; more often while somebody waits."""
        while not self._closed:
            with self._lock:
                busy = [window for window in self._windows.values() if window.kept]
                urgent = any(window.kept_bytes * 2 > window.limit for window in busy)
            self._reliable.poll(0)
            try:
                self._free(busy)
                self._tidy()
            except DueError as error:
                log.debug("%s", error)
            time.sleep(_ASK_SECONDS if urgent else _LOOK_SECONDS / 2)

    def _free(self, windows: list[PathWindow]) -> None:
        now = time.monotonic()
        topics = sorted({window.topic for window in windows})
        readers = {topic: self._control.groups(topic, now, self._group_timeout) for topic in topics}
        positions: dict[str, Mapping[Partition, int]] = {}
        for group in sorted({group for groups in readers.values() for group in groups}):
            wanted = [
                (topic, number)
                for topic in topics
                if group in readers[topic]
                for number in self._topics[topic]
            ]
            positions[group] = self._positions.of(group, wanted)
        awaited = {
            topic: self._awaited.of(topic, {group: positions[group] for group in readers[topic]}, now)
            for topic in topics
        }
        with self._lock:
            for window in windows:
                window.release(awaited[window.topic])
            self._room.notify_all()

    def _tidy(self) -> None:
        """Remove the records of readers that were killed long ago."""
        now = time.monotonic()
        if now < self._tidy_at:
            return
        self._tidy_at = now + _TIDY_SECONDS
        for key in self._control.long_gone(self._app, now, _SILENT_HOUR):
            self._reliable.produce(self._address.control(self._app), None, key)

    def _probe_brokers(self) -> None:
        while not self._closed:
            self._probe_wanted.wait(_LOOK_SECONDS)
            if not self._probe_wanted.is_set() or self._closed:
                continue
            self._probe_wanted.clear()
            asked = self._probe_now
            try:
                self._control.ask(_CALL_SECONDS)
            except DueError:
                self._connected = False
                continue
            self.answered = max(self.answered, asked)
            if not self._connected:
                self._connected = True
                self._counts["reconnects"] += 1
