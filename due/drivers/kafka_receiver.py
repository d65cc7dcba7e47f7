"""The receiving half on Kafka: one consumer with partitions of its own choice, no group protocol.

receive() ──poll──┬─ due.b.…  from the end, or from the beginning of topics that came later   (best effort)
                  └─ due.r.…  from the group's committed offset                               (reliable)

Which member of a group reads: of those that live and are active, the one that came first; members of a shared group
divide the partitions.  A member that was told that the others have ended waits for nobody.
"""

import logging
import threading
import time
from collections.abc import Iterable

import msgspec
from confluent_kafka import (
    Consumer,
    KafkaError,
    KafkaException,
    Message,
    Producer,
    TopicPartition,
)

from due.drivers.base import NO_RIGHT, Delivery, app_of
from due.drivers.kafka_aside import KafkaAside
from due.drivers.kafka_control import ControlLog, ReaderRecord, reader_key, reader_record
from due.drivers.kafka_names import MOST_BYTES, TOO_EARLY, KafkaAddress, is_denied
from due.drivers.kafka_progress import Partition, PartitionProgress
from due.errors import BackendError, InvalidOption, Timeout, UpdatesUnavailable
from due.keys import Key

log = logging.getLogger("due.updates")

_SLICE_SECONDS = 0.02
"""Longest wait of the client; it cannot be woken."""
_BATCH = 256
_CALL_SECONDS = 5.0
_LOOK_SECONDS = 0.2
_COMMIT_SECONDS = 0.05
_ASIDE_LENGTH = 1000
_TRIES = 20
"""A topic that was just made has no leader for a moment."""


class _Start(msgspec.Struct, frozen=True):
    """Where a partition is read from, when this reader gets it."""

    position: int
    note: str = ""


class KafkaReceiver:
    """See `due.drivers.base.Receiver`."""

    def __init__(
        self,
        address: KafkaAddress,
        control: ControlLog,
        producer: Producer,
        group: str,
        consumer: str,
        *,
        shared: bool,
        backlog: int,
    ) -> None:
        self._address, self._control, self._producer = address, control, producer
        self._group, self._member, self._shared = group, consumer, shared
        self._app = app_of(group)
        self._aside = KafkaAside(address, control, producer, group)
        self._lock = threading.RLock()
        self._patterns: dict[str, int] = {}
        self._followed: dict[str, str] = {}
        self._listened: set[str] = set()
        """Topics of best effort that are assigned."""
        self._progress: dict[Partition, PartitionProgress] = {}
        """Partitions of reliable topics that are assigned."""
        self._leaving: dict[Partition, PartitionProgress] = {}
        """Partitions that are given up, but for entries that are still worked on."""
        self._claiming: set[Partition] = set()
        self._denied: set[str] = set()
        """Topics without a right to read them."""
        self._joined: set[str] = set()
        """Reliable topics of which the group has a position in each partition."""
        self._active, self._take_over, self._closed = True, False, False
        self._share: frozenset[str] | None = None
        self._woken = threading.Event()
        self._changed = threading.Event()
        self._since = -1
        self._beat = 0
        self._said: ReaderRecord | None = None
        self._look_at = self._commit_at = 0.0
        self._counts = {"dropped_slow": 0, "reconnects": 0, "claimed": 0, "misplaced": 0, "paths_denied": 0}
        self._consumer = Consumer(
            address.client(
                **{
                    "group.id": address.group(group),
                    "enable.auto.commit": False,
                    "enable.auto.offset.store": False,
                    "auto.offset.reset": "earliest",
                    "fetch.wait.max.ms": 50,
                    "fetch.message.max.bytes": 1 << 20,
                    "queued.max.messages.kbytes": max(1024, backlog >> 10),
                    "receive.message.max.bytes": MOST_BYTES + (1 << 20),
                }
            )
        )
        control.listen(self._changed.set)

    def subscribe(self, pattern: str) -> None:
        """See `Receiver.subscribe`."""
        with self._lock:
            self._patterns[pattern] = self._patterns.get(pattern, 0) + 1
            try:
                self._control.catch_up(_CALL_SECONDS)
                self._listen(self._topics(pattern, reliable=False), late=False)
            except (Timeout, UpdatesUnavailable) as error:
                log.warning("not yet subscribed to %s, trying again: %s", pattern, error)
                self._changed.set()

    def unsubscribe(self, pattern: str) -> None:
        """See `Receiver.unsubscribe`."""
        with self._lock:
            self._patterns[pattern] -= 1
            if not self._patterns[pattern]:
                del self._patterns[pattern]
            wanted = {t for p in self._patterns for t in self._control.topics(p, reliable=False)}
            self._drop([(topic, 0) for topic in self._listened - wanted])
            self._listened &= wanted

    def follow(self, pattern: str, *, start: str = "") -> None:
        """See `Receiver.follow`."""
        with self._lock:
            self._followed[pattern] = start
            self._tell()
            try:
                self._control.catch_up(_CALL_SECONDS)
                for topic in self._topics(pattern, reliable=True):
                    self._join_if_allowed(topic, start, late=False)
            except (Timeout, UpdatesUnavailable) as error:
                log.warning("not yet reading %s, trying again: %s", pattern, error)
            self._changed.set()

    def unfollow(self, pattern: str) -> None:
        """See `Receiver.unfollow`."""
        with self._lock:
            self._followed.pop(pattern, None)
            wanted = {t for p in self._followed for t in self._control.topics(p, reliable=True)}
            self._commit(wait=True)
            self._give_up([place for place in self._progress if place[0] not in wanted])
            self._leaving.clear()
            self._joined &= wanted
            self._tell()

    def activate(self, active: bool, *, take_over: bool = False) -> None:
        """See `Receiver.activate`."""
        with self._lock:
            self._active, self._take_over = active, take_over
        self._changed.set()
        self.wake()

    def share(self, shards: frozenset[str] | None) -> None:
        """See `Receiver.share`."""
        with self._lock:
            self._share = shards
        self._changed.set()
        self.wake()

    def offered(self) -> tuple[str, ...]:
        """See `Receiver.offered`."""
        with self._lock:
            return tuple(sorted(map(_shard, self._places())))

    def held(self) -> tuple[str, ...]:
        """See `Receiver.held`."""
        with self._lock:
            mine = {place for place in self._places() if self._share is None or _shard(place) in self._share}
            return tuple(sorted(map(_shard, {*mine, *self._progress, *self._leaving, *self._claiming})))

    def shard_of(self, delivery: Delivery) -> str:
        """See `Receiver.shard_of`."""
        return delivery.token.rpartition("/")[0]

    def abandon(self, shard: str) -> None:
        """See `Receiver.abandon`."""
        with self._lock:
            for held in (self._progress, self._leaving):
                for place in [place for place in held if _shard(place) == shard]:
                    del held[place]
                    if held is self._progress:
                        self._drop([place])
        self._changed.set()

    @property
    def connected(self) -> bool:
        """See `Receiver.connected`."""
        return not self._patterns or bool(self._control.connected)

    def receive(self, timeout: float) -> list[Delivery]:
        """See `Receiver.receive`."""
        self._control.check()
        deadline = time.monotonic() + timeout
        while True:
            self._care()
            found = self._poll(deadline)
            if found or self._woken.is_set() or self._closed or time.monotonic() >= deadline:
                self._woken.clear()
                return found

    def acknowledge(self, delivery: Delivery) -> None:
        """See `Receiver.acknowledge`."""
        topic, number, offset = _place_of(delivery)
        with self._lock:
            for held in (self._progress, self._leaving):
                if (topic, number) in held:
                    held[topic, number].acknowledge(offset)

    def wake(self) -> None:
        """See `Receiver.wake`."""
        self._woken.set()

    def set_aside(self, delivery: Delivery, payload: bytes, reason: str) -> None:
        """See `Receiver.set_aside`."""
        self._aside.put(delivery, payload, reason)

    def aside(self) -> list[tuple[bytes, str]]:
        """See `Receiver.aside`."""
        topic = self._address.aside(self._app)
        reader = Consumer(
            self._address.client(
                **{"group.id": self._address.group(self._group), "enable.auto.commit": False}
            )
        )
        try:
            self._control.make_topic(topic)
            high = self._end(topic, 0)
            reader.assign([TopicPartition(topic, 0, max(0, high - _ASIDE_LENGTH))])
            found: list[tuple[bytes, str]] = []
            deadline = time.monotonic() + _CALL_SECONDS
            while len(found) < min(high, _ASIDE_LENGTH) and time.monotonic() < deadline:
                message = reader.poll(_SLICE_SECONDS)
                if message is not None and message.error() is None:
                    headers = dict(message.headers() or [])
                    found.append((bytes(message.value() or b""), _text(headers.get("reason"))))
        except KafkaException as error:
            raise UpdatesUnavailable(f"{topic}: {error.args[0]}") from None
        else:
            return found
        finally:
            reader.close()

    def drain(self) -> bool:
        """Kafka's client fetches in threads of its own: there is nothing to help with."""
        return False

    def renew(self) -> None:
        """See `Receiver.renew`."""
        with self._lock:
            if self._followed and not self._closed:
                self._beat += 1
                self._tell()

    def statistics(self) -> dict[str, int]:
        """See `Receiver.statistics`."""
        with self._lock:
            counts = {**self._counts, **self._aside.counts()}
            return {**counts, "held_paths": 0, "refused_control": self._control.refused}

    def close(self) -> None:
        """See `Receiver.close`."""
        self._aside.close()  # before what it was set aside from is acknowledged
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._woken.set()
            self._control.unlisten(self._changed.set)
            self._commit(wait=True)
            if self._said is not None:
                self._producer.produce(
                    self._address.control(self._app), None, reader_key(self._group, self._member)
                )
                self._producer.flush(_CALL_SECONDS)
        self._consumer.close()

    def _tell(self) -> None:
        """Write this reader's record."""
        holds = tuple(sorted({*self._progress, *self._leaving, *self._claiming}))
        denied = tuple(sorted(filter(self._address.is_reliable, self._denied)))
        record = ReaderRecord(
            self._group,
            self._member,
            tuple(self._followed),
            self._active,
            self._since,
            self._beat,
            holds,
            denied,
        )
        if record == self._said or not (self._followed or self._said):
            return
        first = self._said is None
        self._said = record
        key, value = reader_record(record)
        if first:
            self._control.make_topic(self._address.control(self._app))
        self._producer.produce(self._address.control(self._app), value, key)
        if first:
            self._producer.flush(_CALL_SECONDS)
        else:
            self._producer.poll(0)

    def _care(self) -> None:
        now = time.monotonic()
        self._aside.care(now)
        if now >= self._commit_at:
            with self._lock:
                self._commit()
            self._commit_at = now + _COMMIT_SECONDS
        if not self._changed.is_set() and now < self._look_at:
            return
        self._changed.clear()
        self._look_at = now + _LOOK_SECONDS
        with self._lock:
            if self._closed:
                return
            try:
                self._assign(now)
            except (Timeout, UpdatesUnavailable) as error:
                log.debug("partitions of %s: %s", self._group, error)
            except KafkaException as error:
                log.warning("partitions of %s: %s", self._group, error.args[0])

    def _assign(self, now: float) -> None:
        """Take up new topics, and the partitions that are this member's; give up the others."""
        for pattern in self._patterns:
            self._listen(self._topics(pattern, reliable=False), late=True)
        for pattern, start in self._followed.items():
            for topic in self._topics(pattern, reliable=True):
                self._join_if_allowed(topic, start, late=True)
        for place in [place for place, progress in self._leaving.items() if not progress.unfinished]:
            self._commit(wait=True)
            del self._leaving[place]
        mine = self._mine(now)
        released = [place for place in self._progress if place not in mine]
        if released:
            self._commit(wait=True)
            self._give_up(released)
        self._claim(mine - set(self._progress) - set(self._leaving), now)
        self._tell()

    def _claim(self, wanted: set[Partition], now: float) -> None:
        """Take up partitions that no other member holds; the order of the control topic decides between two."""
        others = set() if self._take_over else self._control.claimed(self._group, self._member, now)
        self._claiming = wanted - others
        if not self._claiming:
            return
        self._tell()
        self._producer.flush(_CALL_SECONDS)
        self._control.catch_up(_CALL_SECONDS)
        lost = (
            set() if self._take_over else self._control.claimed(self._group, self._member, time.monotonic())
        )
        for place in sorted(self._claiming - lost):
            self._take_up(place)
        self._claiming = set()

    def _mine(self, now: float) -> set[Partition]:
        if not self._active:
            return set()
        places = self._places()
        if self._share is not None:
            return {place for place in places if _shard(place) in self._share}
        members = self._control.members(self._group)
        self._since = next(
            (seen.since for seen in members if seen.record.member == self._member), self._since
        )
        working = [seen.record.member for seen in members if seen.lives(now) and seen.record.active]
        if self._member not in working:
            working.append(self._member)
        if self._take_over and not self._shared:
            return set(places)
        if not self._shared:
            return set(places) if working[0] == self._member else set()
        rank = working.index(self._member)
        return {place for at, place in enumerate(sorted(places)) if at % len(working) == rank}

    def _places(self) -> list[Partition]:
        return [(topic, number) for topic in self._joined for number in self._control.partitions(topic)]

    def _listen(self, topics: Iterable[str], *, late: bool) -> None:
        """Read best-effort topics, from their beginning if they came after the subscription."""
        for topic in topics:
            if topic in self._listened:
                continue
            try:
                end = self._end(topic, 0)
            except BackendError as error:
                self._deny(topic, error)
                continue
            offset = 0 if late else end
            self._consumer.incremental_assign([TopicPartition(topic, 0, offset)])
            self._listened.add(topic)

    def _topics(self, pattern: str, *, reliable: bool) -> list[str]:
        return [t for t in self._control.topics(pattern, reliable=reliable) if t not in self._denied]

    def _deny(self, topic: str, error: BackendError) -> None:
        """A right is missing: this topic is left out, and the others are read on."""
        if isinstance(error, UpdatesUnavailable) or not is_denied(error):
            raise error
        self._counts["paths_denied"] += 1
        self._denied.add(topic)
        log.error(NO_RIGHT, self._group, f"read {topic}", error)

    def _join_if_allowed(self, topic: str, start: str, *, late: bool) -> None:
        try:
            self._join(topic, start, late=late)
        except BackendError as error:
            self._deny(topic, error)

    def _join(self, topic: str, start: str, *, late: bool) -> None:
        """Give the group a position in each partition of a topic, if it has none, or if it starts over."""
        again = bool(start) and not late
        if topic in self._joined and not again:
            return
        numbers = self._control.partitions(topic)
        positions = [TopicPartition(topic, number) for number in numbers]
        held = self._committed(positions)
        wanted = []
        for number in numbers:
            if again or held.get((topic, number)) is None:
                text = start or ("0" if late else "")
                wanted.append(TopicPartition(topic, number, self._offset(topic, number, text)))
        if again:
            self._give_up([place for place in self._progress if place[0] == topic])
        if wanted:
            self._set_positions(wanted)
        self._joined.add(topic)

    def _set_positions(self, positions: list[TopicPartition]) -> None:
        try:
            self._consumer.commit(offsets=positions, asynchronous=False)
        except KafkaException as error:
            if is_denied(error):  # a topic that this app may write, and not read
                raise BackendError(str(error.args[0])) from None
            raise

    def _offset(self, topic: str, number: int, start: str) -> int:
        if not start:
            return self._end(topic, number)
        milliseconds, _, count = start.partition("-")
        if not milliseconds.isdecimal() or (count and not count.isdecimal()):
            raise InvalidOption(f"start {start!r}: write 0, or milliseconds since 1970")
        if int(milliseconds) == 0:
            return 0
        (found,) = self._consumer.offsets_for_times(
            [TopicPartition(topic, number, int(milliseconds))], timeout=_CALL_SECONDS
        )
        return found.offset if found.offset >= 0 else self._end(topic, number)

    def _end(self, topic: str, number: int) -> int:
        """The offset of the next record."""
        for _ in range(_TRIES):
            try:
                return self._control.ends([(topic, number)])[topic, number]
            except UpdatesUnavailable as error:
                last = error
                time.sleep(0.05)
        raise last

    def _committed(self, positions: list[TopicPartition]) -> dict[Partition, _Start]:
        try:
            found = self._consumer.committed(positions, timeout=_CALL_SECONDS)
        except KafkaException as error:
            raise UpdatesUnavailable(f"positions of {self._group}: {error.args[0]}") from None
        failed = next((one.error for one in found if one.error is not None), None)
        if failed is not None:
            raise UpdatesUnavailable(f"positions of {self._group}: {failed}")
        return {(p.topic, p.partition): _Start(p.offset, p.metadata or "") for p in found if p.offset >= 0}

    def _take_up(self, place: Partition) -> None:
        start = self._committed([TopicPartition(*place)]).get(place)
        if start is None:
            self._joined.discard(place[0])  # its position has expired: join again
            return
        self._progress[place] = PartitionProgress(start.position, start.note)
        self._consumer.incremental_assign([TopicPartition(*place, start.position)])

    def _give_up(self, places: list[Partition]) -> None:
        for place in places:
            progress = self._progress.pop(place)
            if progress.unfinished:
                self._leaving[place] = progress
        self._drop(places)

    def _drop(self, places: list[Partition]) -> None:
        if places:
            self._consumer.incremental_unassign([TopicPartition(*place) for place in places])

    def _commit(self, *, wait: bool = False) -> None:
        """Tell Kafka the group's positions; the lock is held."""
        changed = []
        for (topic, number), progress in (*self._leaving.items(), *self._progress.items()):
            commit = progress.commit(again=wait)
            if commit is not None:
                changed.append(TopicPartition(topic, number, commit[0], commit[1]))
        if not changed:
            return
        try:
            if wait:
                self._consumer.commit(offsets=changed, asynchronous=False)
            else:
                self._consumer.commit(offsets=changed, asynchronous=True)
        except KafkaException as error:
            log.warning(
                "positions of %s could not be stored: %s; entries may come again", self._group, error.args[0]
            )

    def _poll(self, deadline: float) -> list[Delivery]:
        if self._closed or self._woken.is_set():
            return []
        left = max(0.0, min(_SLICE_SECONDS, deadline - time.monotonic()))
        first = self._consumer.poll(left)
        if first is None:
            return []
        with self._lock:
            if self._ended():
                return []
            found = [d for m in [first, *self._consumer.consume(_BATCH, 0)] for d in self._delivery(m)]
            if any(delivery.tries > 1 for delivery in found):
                self._commit(wait=True)  # whatever kills this process now is counted
            return found

    def _ended(self) -> bool:
        return self._closed

    def _delivery(self, message: Message) -> list[Delivery]:
        error = message.error()
        if error is not None:
            if error.code() not in (*TOO_EARLY, KafkaError._PARTITION_EOF) and not error.retriable():  # noqa: SLF001
                log.warning("%s: %s", message.topic(), error)
            return []
        topic, number, offset = (
            str(message.topic()),
            int(message.partition() or 0),
            int(message.offset() or 0),
        )
        path = bytes(message.key() or b"").decode("ascii", "replace")
        reliable = self._address.is_reliable(topic)
        placed = self._address.topic(path, reliable=reliable) == topic
        self._counts["misplaced"] += not placed
        patterns = self._followed if reliable else self._patterns
        wanted = placed and any(Key.parse(pattern).matches_path(path) for pattern in patterns)
        payload = bytes(message.value() or b"")
        if not reliable:
            return [Delivery(path, payload)] if wanted and topic in self._listened else []
        progress = self._progress.get((topic, number))
        if progress is None or offset < progress.delivered_to:
            return []
        if not wanted:
            progress.pass_over(offset)
            return []
        tries = progress.deliver(offset)
        self._counts["claimed"] += tries > 1
        return [Delivery(path, payload, f"{topic}/{number}/{offset}", tries)]


def _shard(place: Partition) -> str:
    return f"{place[0]}/{place[1]}"


def _text(header: str | bytes | None) -> str:
    return header.decode(errors="replace") if isinstance(header, bytes) else header or ""


def _place_of(delivery: Delivery) -> tuple[str, int, int]:
    topic, number, offset = delivery.token.split("/")
    return topic, int(number), int(offset)
