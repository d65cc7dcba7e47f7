"""The receiving half on Redis: one pub/sub connection and one stream connection, read by one thread.

receive() ──poll──┬─ bus:     SUBSCRIBE / PSUBSCRIBE due:<path>      (best effort; `drain` may help out)
                  └─ streams: StreamReader, XREAD … BLOCK            (reliable)
"""

import logging
import os
import select
import threading
import time
from collections import deque
from typing import Any

import redis

from due.drivers.base import Delivery
from due.drivers.redis_primary import LOOK_SECONDS, backoff_for, watch_for
from due.drivers.redis_reader import StreamReader
from due.drivers.redis_rights import channel_globs, granted_for
from due.drivers.redis_streams import announced_name
from due.drivers.redis_wire import Wire, client
from due.drivers.redis_work import announced_paths
from due.errors import InvalidKey, UpdatesUnavailable
from due.keys import Key
from due.logs import without_passwords

log = logging.getLogger("due.updates")

_PREFIX = b"due:"
_ANNOUNCED = announced_name("").encode()
_ANNOUNCEMENTS = announced_name("*").encode()
_CONFIRM_SECONDS = 5.0
_LIST_SECONDS = 1.0
"""Between two attempts to list the streams that are there."""
_REFUSED = b"refused"
"""The kind of an answer that is an error."""


def channel_name(path: str) -> bytes:
    """The pub/sub channel of a path."""
    return _PREFIX + path.encode()


class RedisReceiver:
    """See `due.drivers.base.Receiver`."""

    def __init__(
        self,
        url: str,
        group: str,
        consumer: str,
        *,
        shared: bool,
        backlog: int,
        observable: tuple[str, ...] = (),
    ) -> None:
        self._url, self._place = url, without_passwords(url)
        self._group = group
        self._observable = observable
        self._backlog_limit = backlog
        self._lock = threading.RLock()
        self._channels: dict[bytes, int] = {}
        """Channels and patterns of channels, with the number of their users here."""
        self._bus: Wire | None = None
        self._backoff = backoff_for(url)
        self._watch = watch_for(url)
        self._backlog: deque[Delivery] = deque()
        self._backlog_bytes = 0
        self._dropped = 0
        self._reconnects = 0
        self._denied = 0
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._closed = False
        self._client = client(url)
        self._reader = StreamReader(url, self._client, group, consumer, shared=shared)
        self._followed: dict[str, str] = {}
        self._unlisted: set[str] = set()
        """Patterns of which streams may have been announced while there was no connection."""
        self._list_at = 0.0

    def subscribe(self, pattern: str) -> None:
        """See `Receiver.subscribe`; on return the server has confirmed it."""
        with self._lock:
            self._take(self._channels_of(pattern))
        self.wake()

    def unsubscribe(self, pattern: str) -> None:
        """See `Receiver.unsubscribe`."""
        with self._lock:
            gone = self._channels_of(pattern)
            for channel in gone:
                self._channels[channel] -= 1
            gone = [channel for channel in gone if not self._channels[channel]]
            for channel in gone:
                del self._channels[channel]
            self._change(b"UNSUBSCRIBE", gone)

    def follow(self, pattern: str, *, start: str = "") -> None:
        """See `Receiver.follow`."""
        with self._lock:
            if _ANNOUNCEMENTS not in self._channels:
                self._take([_ANNOUNCEMENTS])
            self._followed[pattern] = start
        self._adopt(pattern, start or "$", reset=bool(start))
        self.wake()

    def unfollow(self, pattern: str) -> None:
        """See `Receiver.unfollow`."""
        with self._lock:
            self._followed.pop(pattern, None)
            patterns = [Key.parse(p) for p in self._followed]
        self._reader.leave(lambda path: any(p.matches_path(path) for p in patterns))

    def activate(self, active: bool, *, take_over: bool = False) -> None:
        """See `Receiver.activate`."""
        self._reader.activate(active, take_over=take_over)
        self.wake()

    def share(self, shards: frozenset[str] | None) -> None:
        """See `Receiver.share`."""
        self._reader.share(shards)
        self.wake()

    def offered(self) -> tuple[str, ...]:
        """See `Receiver.offered`."""
        return self._reader.offered()

    def held(self) -> tuple[str, ...]:
        """See `Receiver.held`."""
        return self._reader.held()

    def shard_of(self, delivery: Delivery) -> str:
        """See `Receiver.shard_of`."""
        return delivery.path

    def abandon(self, shard: str) -> None:
        """See `Receiver.abandon`."""
        self._reader.abandon(shard)
        self.wake()

    @property
    def connected(self) -> bool:
        """See `Receiver.connected`."""
        return self._bus is not None or not self._channels

    def receive(self, timeout: float) -> list[Delivery]:
        """See `Receiver.receive`."""
        self._care()
        ready = self._wait(0.0 if self._backlog else timeout)
        deliveries: list[Delivery] = []
        if self._backlog or (self._bus is not None and self._bus.fileno() in ready):
            deliveries += self._read_bus()
        deliveries += self._reader.read(ready)
        return deliveries

    def acknowledge(self, delivery: Delivery) -> None:
        """See `Receiver.acknowledge`."""
        self._reader.acknowledge(delivery)

    def set_aside(self, delivery: Delivery, payload: bytes, reason: str) -> None:
        """See `Receiver.set_aside`."""
        self._reader.aside.put(delivery.path, payload, reason)

    def aside(self) -> list[tuple[bytes, str]]:
        """See `Receiver.aside`."""
        return self._reader.aside.all()

    def drain(self) -> bool:
        """See `Receiver.drain`."""
        some = False
        with self._lock:
            try:
                while self._pull():
                    some = True
            except UpdatesUnavailable as error:
                self._lose(error)
        return some

    def renew(self) -> None:
        """See `Receiver.renew`."""
        self._reader.renew()

    def wake(self) -> None:
        """See `Receiver.wake`."""
        try:
            os.write(self._wake_write, b"x")
        except (BlockingIOError, OSError):
            return  # it is already awake, or closed

    def statistics(self) -> dict[str, int]:
        """Counters for `health`."""
        counts = {"dropped_slow": self._dropped, "reconnects": self._reconnects, "denied": self._denied}
        return {**counts, **self._reader.statistics()}

    def close(self) -> None:
        """See `Receiver.close`."""
        self._closed = True
        self._reader.aside.close()  # before what it was set aside from is acknowledged
        self._reader.close()
        with self._lock:
            if self._bus is not None:
                self._bus.close()
                self._bus = None
            os.close(self._wake_read)
            os.close(self._wake_write)
        self._client.close()
        if self._watch is not None:
            self._watch.close()

    def _channels_of(self, pattern: str) -> list[bytes]:
        globs = (glob for one in granted_for(pattern, self._observable) for glob in channel_globs(one))
        return [channel_name(glob) for glob in dict.fromkeys(globs)]

    def _take(self, channels: list[bytes]) -> None:
        for channel in channels:
            self._channels[channel] = self._channels.get(channel, 0) + 1
        self._change(b"SUBSCRIBE", [channel for channel in channels if self._channels[channel] == 1])

    def _adopt(self, pattern: str, start: str, *, reset: bool = False) -> bool:
        """Read the streams that exist now and match; False if trying again may help."""
        key = Key.parse(pattern)
        try:
            for path in announced_paths(self._client):
                if key.matches_path(path) and _is_path(path):
                    self._reader.add(path, start, reset=reset)
        except redis.exceptions.NoPermissionError as error:
            log.warning("no right to list the streams of %s: %s", pattern, error)
        except (UpdatesUnavailable, redis.RedisError, OSError) as error:
            log.warning("streams of %s cannot be listed now: %s", pattern, error)
            return False
        return True

    def _announced(self, path: str) -> None:
        if any(Key.parse(p).matches_path(path) for p in self._followed) and _is_path(path):
            self._reader.add(path, "0")

    def _change(self, verb: bytes, channels: list[bytes]) -> None:
        """Send (UN)SUBSCRIBE and read on until each is confirmed or refused."""
        if not channels or (self._bus is None and not self._open()):
            return
        assert self._bus is not None  # noqa: S101 - just opened
        try:
            for channel in channels:
                _send_change(self._bus, verb, channel)
            waiting, refused, deadline = set(channels), 0, time.monotonic() + _CONFIRM_SECONDS
            answers = (verb.lower(), b"p" + verb.lower())
            while len(waiting) > refused and time.monotonic() < deadline:
                for reply in self._bus.wait(1.0):
                    kind = self._sort(reply)
                    refused += kind == _REFUSED
                    if kind in answers:
                        waiting.discard(reply[1])
        except UpdatesUnavailable as error:
            self._lose(error)

    def _open(self) -> bool:
        if not self._backoff.due(time.monotonic()):
            return False
        try:
            bus = Wire(self._url)
            for channel in self._channels:
                _send_change(bus, b"SUBSCRIBE", channel)
        except UpdatesUnavailable as error:
            self._lose(error)
            return False
        self._backoff.succeeded()
        self._unlisted.update(self._followed)
        self._list_at = 0.0
        self._bus = bus
        return True

    def _lose(self, error: Exception) -> None:
        if self._bus is not None:
            self._bus.close()
            self._bus = None
            self._reconnects += 1
        delay = self._backoff.failed(time.monotonic())
        if not self._closed:
            log.warning("subscriptions at %s: %s; retrying in %.2f s", self._place, error, delay)

    def _care(self) -> None:
        """Reconnect lost connections, and look for streams announced meanwhile."""
        self._leave_old_primary()
        if self._bus is None and self._channels and not self._closed:
            with self._lock:
                opened = self._bus is None and self._open()
            if opened and self._reconnects:
                log.warning("resubscribed at %s", self._place)
        if self._unlisted and time.monotonic() >= self._list_at:
            self._list_streams()
        self._reader.aside.care()
        self._reader.care()

    def _list_streams(self) -> None:
        """After a reconnect; again where the server did not answer that."""
        self._list_at = time.monotonic() + _LIST_SECONDS
        with self._lock:
            patterns, self._unlisted = self._unlisted & self._followed.keys(), set()
        self._client.connection_pool.disconnect(inuse_connections=False)  # they may lead to an old primary
        failed = {pattern for pattern in patterns if not self._adopt(pattern, "0")}
        with self._lock:
            self._unlisted |= failed

    def _leave_old_primary(self) -> None:
        bus = self._bus
        present = [one for one in (bus.primary if bus is not None else "", self._reader.primary) if one]
        if self._watch is None or not present:
            return
        successor = self._watch.successor(present)
        if not successor:
            return
        if bus is not None and bus.primary != successor:
            with self._lock:
                if self._bus is bus:
                    self._lose(UpdatesUnavailable(f"{successor} is the primary now"))
        self._reader.move(successor)

    def _wait(self, timeout: float) -> set[int]:
        poll = select.poll()
        poll.register(self._wake_read, select.POLLIN)
        bus = self._bus
        if bus is not None:
            poll.register(bus.fileno(), select.POLLIN)
        elif self._channels:
            timeout = min(timeout, 0.05)
        if self._watch is not None:
            timeout = min(timeout, LOOK_SECONDS)
        if self._unlisted:
            timeout = min(timeout, _LIST_SECONDS)
        timeout = min(timeout, self._reader.patience(), self._reader.aside.patience())
        stream = self._reader.fileno()
        if stream >= 0:
            poll.register(stream, select.POLLIN)
        ready = {fd for fd, _ in poll.poll(timeout * 1000)}
        if self._wake_read in ready:
            os.read(self._wake_read, 4096)
        return ready

    def _read_bus(self) -> list[Delivery]:
        with self._lock:
            try:
                self._pull()
            except UpdatesUnavailable as error:
                self._lose(error)
            deliveries = list(self._backlog)
            self._backlog.clear()
            self._backlog_bytes = 0
        return deliveries

    def _pull(self) -> bool:
        if self._bus is None:
            return False
        some = False
        for reply in self._bus.replies():
            self._sort(reply)
            some = True
        return some

    def _sort(self, reply: Any) -> bytes:
        """Dispatch a message; returns the kind of reply."""
        kind: bytes = reply[0] if isinstance(reply, list) else b""
        if kind not in (b"message", b"pmessage"):
            if isinstance(reply, Exception):
                self._denied += 1
                log.error("a subscription of %s was refused: %s", self._group, reply)
                return _REFUSED
            return kind
        if len(reply) < 3 or not (isinstance(reply[-2], bytes) and isinstance(reply[-1], bytes)):
            raise UpdatesUnavailable("the server sent a message without channel or content")
        channel, payload = reply[-2], reply[-1]
        if channel.startswith(_ANNOUNCED):
            self._announced(payload.decode("ascii", "replace"))
        elif self._backlog_bytes > self._backlog_limit:
            self._dropped += 1
        else:
            self._backlog.append(Delivery(channel[len(_PREFIX) :].decode("ascii", "replace"), payload))
            self._backlog_bytes += len(payload)
        return kind


def _send_change(bus: Wire, verb: bytes, channel: bytes) -> None:
    bus.send(b"P" + verb if b"*" in channel else verb, channel)


def _is_path(text: str) -> bool:
    """Whether this is the path of a concrete key; any program may announce anything."""
    try:
        key = Key(text)
    except InvalidKey:
        return False
    return key.concrete and key.path == text
