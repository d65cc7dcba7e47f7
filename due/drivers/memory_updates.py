"""Data Updates in the memory of one process: for tests, notebooks and single programs.

    publisher ──publish──► MemorySpace ──► backlog of each receiver that subscribed     best effort
              ──append───► MemoryStream ──► a member of each group that follows         reliable

URL: `memory://` or `memory://NAME`; engines of this process with the same name share data.  Nothing outlives the
process, and other processes do not see it.
"""

import threading
import time
from collections import deque
from collections.abc import Iterable

from due.drivers.base import Delivery, app_of
from due.drivers.memory_archive import memory_name
from due.drivers.memory_streams import MemoryStream
from due.errors import Timeout, UpdatesUnavailable
from due.keys import Key

_ENTRIES = 16
"""Most entries of one stream per `receive`."""
_ASIDE_LENGTH = 1000
_POLL_SECONDS = 0.5
_LOOK_SECONDS = 0.05
"""Seconds between two checks of a waiting writer whether a group has lost its last member."""


class MemorySpace:
    """The data shared by all engines of one name."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.room = threading.Condition(self.lock)
        """Notified when a group acknowledges an entry."""
        self.streams: dict[str, MemoryStream] = {}
        self.receivers: list[MemoryReceiver] = []
        self.aside: dict[str, deque[tuple[bytes, str]]] = {}


_spaces: dict[str, MemorySpace] = {}
_spaces_lock = threading.Lock()


class MemoryUpdates:
    """The driver behind memory:// URLs; see `due.drivers.base.UpdatesDriver`."""

    def __init__(
        self,
        url: str,
        *,
        window: int = 16 << 20,
        retain: int = 16 << 20,
        retain_s: float = 3600.0,
        group_timeout: float = 30.0,
        backlog: int = 32 << 20,
    ) -> None:
        self.url = url
        self._limits = (window, retain, group_timeout, retain_s)
        self._backlog = backlog
        with _spaces_lock:
            self._space = _spaces.setdefault(memory_name(url), MemorySpace())

    def publisher(self, app: str) -> "MemoryPublisher":  # noqa: ARG002 - nobody else is in this process
        """A new sending half."""
        return MemoryPublisher(self._space, self._limits)

    def receiver(self, group: str, consumer: str, *, shared: bool = False) -> "MemoryReceiver":
        """A new receiving half."""
        return MemoryReceiver(self._space, group, consumer, shared=shared, backlog=self._backlog)

    def close(self) -> None:
        """The space stays for others of the same name."""


class MemoryPublisher:
    """See `due.drivers.base.Publisher`."""

    def __init__(self, space: MemorySpace, limits: tuple[int, int, float, float]) -> None:
        self._space = space
        self._limits = limits
        self._written: set[str] = set()
        self._held_back = 0
        self._closed = False
        self.answered = 0
        """See `Publisher.answered`."""

    def publish(self, path: str, *payloads: bytes) -> None:
        """See `Publisher.publish`."""
        with self._space.lock:
            if self._closed:
                raise UpdatesUnavailable("the engine is closed")
            for receiver in self._space.receivers:
                receiver.offer(path, payloads)

    def append(self, path: str, payload: bytes) -> None:
        """See `Publisher.append`."""
        with self._space.lock:
            stream = self._stream(path)
            if not stream.has_room(len(payload), time.monotonic()):
                self._held_back += 1
                while not self._closed and not stream.has_room(len(payload), time.monotonic()):
                    self._space.room.wait(_LOOK_SECONDS)
            if self._closed:
                raise UpdatesUnavailable("the engine is closed")
            stream.append(payload, time.time_ns() // 1_000_000, time.monotonic())
            for receiver in self._space.receivers:
                receiver.appended(path)

    def has_room(self, path: str) -> bool:
        """See `Publisher.has_room`."""
        with self._space.lock:
            stream = self._space.streams.get(path)
            return stream is None or stream.has_room(1, time.monotonic())

    def settle(self, timeout: float | None = None) -> None:  # noqa: ARG002 - there is nothing to wait for
        """Return at once: sent payloads have arrived already."""
        if self._closed:
            raise Timeout("the engine is closed")

    def poll(self) -> float:
        """See `Publisher.poll`."""
        with self._space.lock:
            for path in self._written:
                self._space.streams[path].trim(time.monotonic())
        return _POLL_SECONDS

    def probe(self, now: int) -> None:
        """See `Publisher.probe`: this process answers at once."""
        self.answered = now

    def statistics(self) -> dict[str, int]:
        """See `Publisher.statistics`."""
        with self._space.lock:
            kept = sum(self._space.streams[path].kept_bytes(time.monotonic()) for path in self._written)
            return {
                "refused": 0,
                "lost_disconnected": 0,
                "reconnects": 0,
                "held_back": self._held_back,
                "resent": 0,
                "connected": 1,
                "kept_bytes": kept,
            }

    def close(self) -> None:
        """See `Publisher.close`."""
        with self._space.lock:
            self._closed = True
            self._space.room.notify_all()

    def _stream(self, path: str) -> MemoryStream:
        if path not in self._space.streams:
            self._space.streams[path] = MemoryStream(*self._limits)
            for (
                receiver
            ) in self._space.receivers:  # before the first entry: groups that join later begin after it
                receiver.announced(path)
        self._written.add(path)
        return self._space.streams[path]


class MemoryReceiver:
    """See `due.drivers.base.Receiver`."""

    def __init__(self, space: MemorySpace, group: str, consumer: str, *, shared: bool, backlog: int) -> None:
        self._space = space
        self._group = group
        self._consumer = consumer
        self._shared = shared
        self._limit = backlog
        self._some = threading.Condition(space.lock)
        self._patterns: dict[str, int] = {}
        self._followed: dict[str, str] = {}
        self._paths: set[str] = set()
        self._backlog: deque[Delivery] = deque()
        self._backlog_bytes = 0
        self._counts = {"dropped_slow": 0, "reconnects": 0, "claimed": 0, "set_aside": 0}
        self._counts |= {"set_aside_waiting": 0, "set_aside_lost": 0}
        self._active = True
        self._take_over = False
        self._share: frozenset[str] | None = None
        self._woken = False
        self._closed = False
        self.connected = True
        """See `Receiver.connected`."""
        with space.lock:
            space.receivers.append(self)

    def subscribe(self, pattern: str) -> None:
        """See `Receiver.subscribe`."""
        with self._space.lock:
            self._patterns[pattern] = self._patterns.get(pattern, 0) + 1

    def unsubscribe(self, pattern: str) -> None:
        """See `Receiver.unsubscribe`."""
        with self._space.lock:
            self._patterns[pattern] -= 1
            if not self._patterns[pattern]:
                del self._patterns[pattern]

    def follow(self, pattern: str, *, start: str = "") -> None:
        """See `Receiver.follow`."""
        with self._space.lock:
            self._followed[pattern] = start
            for path in self._space.streams:
                if Key.parse(pattern).matches_path(path):
                    self._join(path, start or "$", reset=bool(start))
        self.wake()

    def unfollow(self, pattern: str) -> None:
        """See `Receiver.unfollow`."""
        with self._space.lock:
            self._followed.pop(pattern, None)
            self._leave([path for path in self._paths if not self._follows(path)], withdrawn=True)

    def activate(self, active: bool, *, take_over: bool = False) -> None:
        """See `Receiver.activate`."""
        with self._space.lock:
            self._active, self._take_over = active, take_over
        self.wake()

    def share(self, shards: frozenset[str] | None) -> None:
        """See `Receiver.share`."""
        with self._space.lock:
            self._share = shards
        self.wake()

    def offered(self) -> tuple[str, ...]:
        """See `Receiver.offered`."""
        with self._space.lock:
            return tuple(sorted(self._paths))

    def held(self) -> tuple[str, ...]:
        """See `Receiver.held`."""
        with self._space.lock:
            return tuple(path for path in sorted(self._paths) if self._reads(path) or self._works_on(path))

    def shard_of(self, delivery: Delivery) -> str:
        """See `Receiver.shard_of`."""
        return delivery.path

    def abandon(self, shard: str) -> None:
        """See `Receiver.abandon`."""
        with self._space.lock:
            stream = self._space.streams.get(shard)
            group = stream.groups.get(self._group) if stream is not None else None
            for pending in group.pending.values() if group is not None else ():
                if pending.member == self._consumer:
                    pending.member = ""
            self._wake_members(shard)

    def offer(self, path: str, payloads: Iterable[bytes]) -> None:
        """Best-effort payloads of a path, from a publisher that holds the space's lock."""
        if not any(Key.parse(pattern).matches_path(path) for pattern in self._patterns):
            return
        for payload in payloads:
            if self._backlog_bytes > self._limit:
                self._counts["dropped_slow"] += 1
                continue
            self._backlog.append(Delivery(path, payload))
            self._backlog_bytes += len(payload)
        self._some.notify_all()

    def announced(self, path: str) -> None:
        """There is a new stream; the publisher holds the space's lock."""
        if self._follows(path):
            self._join(path, "0", reset=False)

    def appended(self, path: str) -> None:
        """A stream has entries for this member; the caller holds the space's lock."""
        if path in self._paths:
            self._some.notify_all()

    def receive(self, timeout: float) -> list[Delivery]:
        """See `Receiver.receive`."""
        deadline = time.monotonic() + timeout
        with self._space.lock:
            while True:
                found = self._take()
                left = deadline - time.monotonic()
                if found or self._woken or self._closed or left <= 0:
                    self._woken = False
                    return found
                self._some.wait(min(left, 1.0))

    def acknowledge(self, delivery: Delivery) -> None:
        """See `Receiver.acknowledge`."""
        with self._space.lock:
            stream = self._space.streams[delivery.path]
            group = stream.groups.get(self._group)
            if group is None:
                return
            milliseconds, _, count = delivery.token.partition("-")
            group.pending.pop((int(milliseconds), int(count)), None)
            stream.trim(time.monotonic())
            self._space.room.notify_all()
            if not group.pending:
                self._wake_members(delivery.path)

    def wake(self) -> None:
        """See `Receiver.wake`."""
        with self._space.lock:
            self._woken = True
            self._some.notify_all()

    def set_aside(self, delivery: Delivery, payload: bytes, reason: str) -> None:  # noqa: ARG002 - by group
        """See `Receiver.set_aside`."""
        with self._space.lock:
            self._counts["set_aside"] += 1
            kept = self._space.aside.setdefault(app_of(self._group), deque(maxlen=_ASIDE_LENGTH))
            kept.append((payload, reason))

    def aside(self) -> list[tuple[bytes, str]]:
        """See `Receiver.aside`."""
        with self._space.lock:
            return list(self._space.aside.get(app_of(self._group), ()))

    def drain(self) -> bool:
        """Nothing to drain: payloads are in memory already."""
        return False

    def renew(self) -> None:
        """Members of this process are seen as long as they are open."""

    def statistics(self) -> dict[str, int]:
        """See `Receiver.statistics`."""
        return {**self._counts, "held_paths": 0}

    def close(self) -> None:
        """See `Receiver.close`."""
        with self._space.lock:
            self._closed = True
            if self in self._space.receivers:
                self._space.receivers.remove(self)
            self._leave(list(self._paths), withdrawn=False)
            self._some.notify_all()

    def _follows(self, path: str) -> bool:
        return any(Key.parse(pattern).matches_path(path) for pattern in self._followed)

    def _reads(self, path: str) -> bool:
        return self._active and (self._share is None or path in self._share)

    def _works_on(self, path: str) -> bool:
        group = self._space.streams[path].groups[self._group]
        return any(pending.member == self._consumer for pending in group.pending.values())

    def _join(self, path: str, start: str, *, reset: bool) -> None:
        self._space.streams[path].join(self._group, self._consumer, start, reset=reset)
        self._paths.add(path)

    def _leave(self, paths: Iterable[str], *, withdrawn: bool) -> None:
        for path in paths:
            self._paths.discard(path)
            group = self._space.streams[path].groups.get(self._group)
            if group is not None:
                group.leave(self._consumer, time.monotonic(), withdrawn=withdrawn)
            self._wake_members(path)
        self._space.room.notify_all()

    def _wake_members(self, path: str) -> None:
        """Wake members that may take entries which another one left or acknowledged."""
        for receiver in self._space.receivers:
            receiver.appended(path)

    def _take(self) -> list[Delivery]:
        found = list(self._backlog)
        self._backlog.clear()
        self._backlog_bytes = 0
        if not self._active:
            return found
        for path in filter(self._reads, self._paths):
            stream = self._space.streams[path]
            group = stream.groups[self._group]
            given = group.next_entries(
                stream, self._consumer, _ENTRIES, shared=self._shared, take_over=self._take_over
            )
            for pending in given:
                self._counts["claimed"] += pending.tries > 1
                token = f"{pending.entry.id[0]}-{pending.entry.id[1]}"
                found.append(Delivery(path, pending.entry.payload, token, pending.tries))
        return found
