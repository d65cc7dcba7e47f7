"""The control topics: which topics there are, and who reads what.

    publishers ──topic:NAME──►  due.control.<app> (one partition, compacted)  ──► ControlLog of every process
    receivers  ──reader:…───►                                                      topics, readers, listeners

Each app has one of its own, so that rights can be given by name: what stands there about another app's readers
is not believed.

Kafka's own group protocol is not used: a killed reader would keep its partitions for at least six seconds, and a
group could not tell a standby from a reader that works.  Readers renew their record each second; one whose record
was watched unchanged for a while is dead.  Nobody compares two machines' clocks.
"""

import functools
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable

import msgspec
from confluent_kafka import (
    OFFSET_BEGINNING,
    Consumer,
    KafkaError,
    Message,
    TopicCollection,
    TopicPartition,
)
from confluent_kafka.admin import AdminClient, NewTopic, OffsetSpec

from due.drivers.base import app_of
from due.drivers.kafka_names import (
    MOST_BYTES,
    TOO_EARLY,
    KafkaAddress,
    may_hold,
    translated,
)
from due.drivers.kafka_progress import Partition
from due.errors import BackendError, EngineFailed, Timeout, UpdatesUnavailable

log = logging.getLogger("due.updates")

SILENT_SECONDS = 3.0
"""A reader whose record has not changed for this long counts as dead."""
_MOST_TOPICS = 8192
_MOST_READERS = 8192
_MOST_OF_ONE = 1024
"""Topics, and readers, of one app."""
_MOST_APPS = 4096
_DISCOVER_SECONDS = 0.5
_POLL_SECONDS = 0.2
_BATCH = 1000
_CALL_SECONDS = 5.0
_HOUR_MS = 3_600_000
_SHORT_MS = 60_000


class ReaderRecord(msgspec.Struct, frozen=True, array_like=True):
    """One member of a group of readers, as it stands in the control topic of its app."""

    group: str
    member: str
    patterns: tuple[str, ...]
    active: bool
    since: int
    """Offset of its first record; -1 in that record itself."""
    beat: int
    """Changes with each renewal."""
    holds: tuple[tuple[str, int], ...] = ()
    """Partitions that it reads, or has read and still works on."""
    denied: tuple[str, ...] = ()
    """Topics that its patterns hold, and that it may not read."""


class TopicRecord(msgspec.Struct, frozen=True, array_like=True):
    """A topic that a producer has made."""

    topic: str
    prefix: str


class ReaderSeen:
    """A reader's last record, and when it was seen to change (s, monotonic)."""

    __slots__ = ("changed_at", "claims", "left", "record", "since")

    def __init__(self, record: ReaderRecord, since: int, now: float) -> None:
        self.record = record
        self.since = since
        self.changed_at = now
        self.left = False
        self.claims: dict[Partition, int] = {}
        """Offset of the record in which it first held a partition."""

    def note_claims(self, offset: int) -> None:
        """Its record at this offset holds what it holds."""
        self.claims = {place: self.claims.get(place, offset) for place in self.record.holds}

    def lives(self, now: float, seconds: float = SILENT_SECONDS) -> bool:
        """Whether it renewed its record within so many seconds."""
        return not self.left and now - self.changed_at <= seconds


class ControlLog:
    """What the control topic says, kept up to date by a thread of its own; thread-safe."""

    def __init__(self, address: KafkaAddress) -> None:
        self._address = address
        self._lock = threading.RLock()
        self._read_on = threading.Condition(self._lock)
        self._admin = AdminClient(address.client())
        self._topics: dict[str, str] = {}
        self._announced: Counter[str] = Counter()
        """Topics by the app that announced them."""
        self._readers: dict[tuple[str, str], ReaderSeen] = {}
        self._listeners: list[Callable[[], None]] = []
        self._partitions: dict[str, list[int]] = {}
        self._positions: dict[str, int] = {}
        """How far each control topic is read."""
        self._discovering = threading.Lock()
        self.connected = False
        """Whether a broker has answered since all of them were away."""
        self._ready = False
        self._closed = False
        self.failure: BaseException | None = None
        """What ended the thread, if it was not `close`."""
        self.refused = 0
        """Records that could not be read, or were too many."""
        self._consumer: Consumer | None = None
        self._thread = threading.Thread(target=self._run, name="due-kafka-control", daemon=True)
        self._thread.start()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call this, from the thread of the log, whenever something has changed."""
        with self._lock:
            self._listeners.append(listener)

    def unlisten(self, listener: Callable[[], None]) -> None:
        """The inverse of `listen`."""
        with self._lock:
            self._listeners = [other for other in self._listeners if other is not listener]

    def topics(self, pattern: str, *, reliable: bool) -> list[str]:
        """The known topics that can hold paths of this pattern."""
        with self._lock:
            return [
                topic
                for topic, prefix in self._topics.items()
                if self._address.is_reliable(topic) == reliable and may_hold(prefix, pattern)
            ]

    def knows(self, topic: str) -> bool:
        """Whether a topic was announced."""
        with self._lock:
            return topic in self._topics

    def members(self, group: str) -> list[ReaderSeen]:
        """The members of a group, those that came first first."""
        with self._lock:
            found = [seen for (name, _), seen in self._readers.items() if name == group]
        return sorted(found, key=lambda seen: seen.since)

    def claimed(self, group: str, member: str, now: float) -> set[Partition]:
        """Partitions that another living member of the group holds, and held before this one."""
        with self._lock:
            mine = self._readers.get((group, member))
            claims = mine.claims if mine is not None else {}
            return {
                place
                for seen in self.members(group)
                if seen.record.member != member and seen.lives(now)
                for place, offset in seen.claims.items()
                if offset < claims.get(place, offset + 1)
            }

    def groups(self, topic: str, now: float, timeout: float) -> list[str]:
        """Groups that read this topic, and those that did until `timeout` seconds ago and have not withdrawn."""
        with self._lock:
            prefix = self._topics.get(topic, "")
            found = set()
            for (group, _), seen in self._readers.items():
                wants = any(may_hold(prefix, pattern) for pattern in seen.record.patterns)
                wants = wants and topic not in seen.record.denied
                if wants and now - seen.changed_at <= timeout:
                    found.add(group)
            return sorted(found)

    def long_gone(self, app: str, now: float, seconds: float) -> list[bytes]:
        """Keys of the records of an app's readers that have been silent for this long."""
        with self._lock:
            return [
                reader_key(group, member)
                for (group, member), seen in self._readers.items()
                if app_of(group) == app and not seen.left and now - seen.changed_at > seconds
            ]

    def make_topic(self, topic: str) -> None:
        """Make a topic with the settings of its kind, unless it is there.

        Raises:
            UpdatesUnavailable: no broker answers.
            BackendError: the brokers refuse.
        """
        copies = self._address.replication or min(3, max(1, self._brokers(_CALL_SECONDS)))
        settings = {"min.insync.replicas": str(2 if copies > 2 else 1), "max.message.bytes": str(MOST_BYTES)}
        partitions = 1
        if topic.startswith(self._address.controls):
            settings |= {
                "cleanup.policy": "compact",
                "segment.bytes": str(4 << 20),
                "min.cleanable.dirty.ratio": "0.1",
            }
        elif self._address.is_reliable(topic):
            partitions = self._address.partitions
            settings |= {
                "retention.ms": str(self._address.retention_hours * _HOUR_MS),
                "retention.bytes": "-1",
            }
        else:
            settings |= {
                "retention.ms": str(_SHORT_MS),
                "segment.ms": str(_SHORT_MS),
                "min.insync.replicas": "1",
            }
        future = self._admin.create_topics([NewTopic(topic, partitions, copies, config=settings)])[topic]
        try:
            translated(lambda: future.result(_CALL_SECONDS), f"topic {topic}")
        except BackendError as error:
            if "already exists" not in str(error):
                raise

    def partitions(self, topic: str) -> list[int]:
        """The numbers of a topic's partitions, remembered: they never change while we use a topic.

        Raises:
            UpdatesUnavailable: not every partition has a leader; a new topic gets them within seconds.
        """
        found = self._partitions.get(topic)
        deadline = time.monotonic() + _CALL_SECONDS
        while found is None:
            try:
                found = self._partitions[topic] = self._described(topic)
            except UpdatesUnavailable:
                if time.monotonic() > deadline or self._closed:
                    raise
                time.sleep(0.05)
        return found

    def _described(self, topic: str) -> list[int]:
        # asking for a topic by `list_topics` would make it, with the brokers' settings instead of ours
        future = self._admin.describe_topics(TopicCollection([topic]), request_timeout=_CALL_SECONDS)[topic]
        found = translated(lambda: future.result(_CALL_SECONDS + 1), f"topic {topic}").partitions
        if not found or any(partition.leader is None for partition in found):
            raise UpdatesUnavailable(f"topic {topic} has no leader yet")
        return sorted(int(partition.id) for partition in found)

    def ask(self, timeout: float) -> None:
        """One question to a broker; raises UpdatesUnavailable when there is no answer."""
        self._brokers(timeout)
        self.connected = True

    def _brokers(self, timeout: float) -> int:
        """How many brokers there are."""
        future = self._admin.describe_cluster(request_timeout=timeout)
        return len(translated(lambda: future.result(timeout + 1), "Kafka").nodes)

    def catch_up(self, timeout: float) -> None:
        """Return when everything is known that stood in the topic at the time of the call.

        Raises:
            Timeout: not within so many seconds.
        """
        deadline = time.monotonic() + timeout
        with self._lock:
            while not self._ready:
                self._wait(deadline)
        while True:
            try:
                self._discover()
                with self._lock:
                    places = [(topic, 0) for topic in self._positions]
                ends = self.ends(places) if places else {}
                break
            except UpdatesUnavailable as error:
                if time.monotonic() > deadline:
                    raise Timeout(f"Kafka did not say where its control topics end: {error}") from None
                time.sleep(0.05)
        with self._lock:
            while any(self._positions[topic] < end for (topic, _), end in ends.items()):
                self._wait(deadline)

    def ends(self, places: list[Partition]) -> dict[Partition, int]:
        """The offset of the next record of each partition.

        Raises:
            UpdatesUnavailable: a broker does not answer, or a topic has no leader yet.
        """
        asked = {TopicPartition(*place): OffsetSpec.latest() for place in places}  # type: ignore[no-untyped-call]
        futures = self._admin.list_offsets(asked, request_timeout=_CALL_SECONDS)
        return {
            (place.topic, place.partition): translated(
                functools.partial(future.result, _CALL_SECONDS + 1), place.topic
            ).offset
            for place, future in futures.items()
        }

    def check(self) -> None:
        """Raise EngineFailed if the thread has died."""
        if self.failure is not None:
            raise EngineFailed(f"the thread that reads Kafka's control topics has died: {self.failure!r}")

    def close(self) -> None:
        """End the thread."""
        with self._lock:
            self._closed = True
            self._read_on.notify_all()
        self._thread.join(10)

    def _wait(self, deadline: float) -> None:
        self.check()
        left = deadline - time.monotonic()
        if left <= 0 or self._closed:
            raise Timeout(f"Kafka at {self._address.servers} did not answer in time")
        self._read_on.wait(min(left, 0.5))

    def _run(self) -> None:
        try:
            self._open()
            look_at = time.monotonic() + _DISCOVER_SECONDS
            while not self._closed:
                assert self._consumer is not None  # noqa: S101 - opened above
                first = self._consumer.poll(_POLL_SECONDS)
                if first is not None:
                    self._take([first, *self._consumer.consume(_BATCH, 0)])
                if time.monotonic() >= look_at:
                    self._discover_if_possible()
                    look_at = time.monotonic() + _DISCOVER_SECONDS
        except BaseException as error:
            self.failure = error
            log.exception("the thread that reads Kafka's control topics has died")
        finally:
            if self._consumer is not None:
                self._consumer.close()

    def _open(self) -> None:
        self._consumer = Consumer(
            self._address.client(
                **{
                    "group.id": self._address.group("control."),
                    "enable.auto.commit": False,
                    "fetch.wait.max.ms": 100,
                    "error_cb": self._client_error,
                }
            )
        )
        while not self._closed and not self._discover_if_possible():
            # nothing is assigned yet that a poll could wait for
            time.sleep(0.1)
        with self._lock:
            self._ready = self.connected = True
            self._read_on.notify_all()

    def _discover_if_possible(self) -> bool:
        try:
            self._discover()
        except (UpdatesUnavailable, BackendError) as error:
            log.debug("Kafka at %s: %s", self._address.servers, error)
            return False
        return True

    def _discover(self) -> None:
        """Read the control topics of apps that came meanwhile, too.

        Raises:
            UpdatesUnavailable: a broker does not answer, or a topic has no leader yet.
        """
        with self._discovering:
            # without a name it makes none
            named = translated(lambda: self._admin.list_topics(timeout=_CALL_SECONDS).topics, "topics")
            fresh = sorted(
                name
                for name in named
                if name.startswith(self._address.controls) and name not in self._positions
            )
            for name in fresh[: _MOST_APPS - len(self._positions)]:
                self.partitions(name)
                with self._lock:
                    assert self._consumer is not None  # noqa: S101 - opened before
                    self._positions[name] = 0
                    self._consumer.incremental_assign([TopicPartition(name, 0, OFFSET_BEGINNING)])

    def _client_error(self, error: KafkaError) -> None:
        if error.code() == KafkaError._ALL_BROKERS_DOWN:  # noqa: SLF001
            self.connected = False

    def _take(self, messages: list[Message]) -> None:
        now = time.monotonic()
        with self._lock:
            for message in messages:
                error = message.error()
                if error is not None:
                    if error.code() not in (*TOO_EARLY, KafkaError._PARTITION_EOF) and not error.retriable():  # noqa: SLF001
                        log.warning("%s: %s", message.topic(), error)
                    continue
                try:
                    self._note(message, now)
                except (msgspec.DecodeError, UnicodeDecodeError, ValueError):
                    self.refused += 1
                self._positions[str(message.topic())] = int(message.offset() or 0) + 1
            listeners = list(self._listeners)
            self._read_on.notify_all()
        for listener in listeners:
            listener()

    def _note(self, message: Message, now: float) -> None:
        key, value, offset = bytes(message.key() or b""), message.value(), int(message.offset() or 0)
        app = str(message.topic()).removeprefix(self._address.controls)
        kind, _, name = key.decode().partition(":")
        if kind == "topic" and value:
            self._note_topic(app, name, msgspec.msgpack.decode(value, type=TopicRecord))
        elif kind == "reader":
            group, _, member = name.partition("/")
            if app_of(group) != app:
                raise ValueError(name)
            if not value:
                seen = self._readers.get((group, member))
                if seen is not None and not seen.left:
                    seen.left, seen.changed_at = True, now
                return
            record = msgspec.msgpack.decode(value, type=ReaderRecord)
            if (record.group, record.member) != (group, member):
                raise ValueError(name)
            self._note_reader(record, offset, now)
        else:
            raise ValueError(name)

    def _note_topic(self, app: str, name: str, topic: TopicRecord) -> None:
        if name in self._topics:
            return
        carries = (self._address.topic(topic.prefix, reliable=kind) for kind in (True, False))
        full = len(self._topics) >= _MOST_TOPICS or self._announced[app] >= _MOST_OF_ONE
        if topic.topic != name or name not in carries or full:
            raise ValueError(name)
        self._announced[app] += 1
        self._topics[name] = topic.prefix

    def _note_reader(self, record: ReaderRecord, offset: int, now: float) -> None:
        name = (record.group, record.member)
        seen = self._readers.get(name)
        if seen is None:
            if len(self._readers) >= _MOST_READERS:
                self._forget(now)
            of_one = sum(app_of(group) == app_of(record.group) for group, _ in self._readers)
            if len(self._readers) >= _MOST_READERS or of_one >= _MOST_OF_ONE:
                raise ValueError(record.member)
            seen = ReaderSeen(record, record.since if record.since >= 0 else offset, now)
            self._readers[name] = seen
            seen.note_claims(offset)
            return
        if record != seen.record or seen.left:
            seen.changed_at = now
        if seen.left:
            seen.since = offset
            seen.claims = {}
        seen.record, seen.left = record, False
        seen.note_claims(offset)

    def _forget(self, now: float) -> None:
        """Drop readers that have been silent for an hour."""
        self._readers = {name: seen for name, seen in self._readers.items() if now - seen.changed_at < 3600}


def topic_record(topic: str, prefix: str) -> tuple[bytes, bytes]:
    """Key and value of the record that announces a topic."""
    return f"topic:{topic}".encode(), msgspec.msgpack.encode(TopicRecord(topic, prefix))


def reader_record(record: ReaderRecord) -> tuple[bytes, bytes]:
    """Key and value of a reader's record."""
    return reader_key(record.group, record.member), msgspec.msgpack.encode(record)


def reader_key(group: str, member: str) -> bytes:
    """The key of a reader's record; without a value it says that the reader has left."""
    return f"reader:{group}/{member}".encode()
