"""The receiving half on Redis: one pub/sub connection and one stream connection, read by one thread.

receive() ──poll──┬─ bus:     SUBSCRIBE / PSUBSCRIBE due:<path>      (best effort; `drain` may help out)
                  └─ streams: StreamReader, XREADGROUP … BLOCK       (reliable)
"""

import logging
import os
import select
import threading
import time
from collections import deque
from typing import Any

from due.backoff import Backoff
from due.drivers.base import Delivery
from due.drivers.redis_reader import StreamReader
from due.drivers.redis_streams import STREAMS
from due.drivers.redis_wire import Wire, client, glob
from due.errors import InvalidKey, UpdatesUnavailable
from due.keys import Key

log = logging.getLogger("due.updates")

_PREFIX = b"due:"
_STREAMS = STREAMS.encode()


def channel_name(path: str) -> bytes:
    """The pub/sub channel of a path."""
    return _PREFIX + path.encode()


class RedisReceiver:
    """See `due.drivers.base.Receiver`."""

    def __init__(self, url: str, group: str, consumer: str, *, shared: bool, backlog: int) -> None:
        self._url = url
        self._backlog_limit = backlog
        self._lock = threading.RLock()
        self._patterns: dict[str, int] = {}
        self._bus: Wire | None = None
        self._backoff = Backoff()
        self._backlog: deque[Delivery] = deque()
        self._backlog_bytes = 0
        self._dropped = 0
        self._reconnects = 0
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._closed = False
        self._client = client(url)
        self._reader = StreamReader(url, self._client, group, consumer, shared=shared)
        self._followed: dict[str, str] = {}

    def subscribe(self, pattern: str) -> None:
        """See `Receiver.subscribe`; on return the server has confirmed it."""
        with self._lock:
            self._patterns[pattern] = self._patterns.get(pattern, 0) + 1
            if self._patterns[pattern] == 1:
                self._change(b"SUBSCRIBE", pattern)
        self.wake()

    def unsubscribe(self, pattern: str) -> None:
        """See `Receiver.unsubscribe`."""
        with self._lock:
            self._patterns[pattern] -= 1
            if not self._patterns[pattern]:
                del self._patterns[pattern]
                self._change(b"UNSUBSCRIBE", pattern)

    def follow(self, pattern: str, *, start: str = "") -> None:
        """See `Receiver.follow`."""
        with self._lock:
            if not self._followed:
                self._subscribe_announcements()
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

    @property
    def connected(self) -> bool:
        """See `Receiver.connected`."""
        return self._bus is not None or not self._patterns

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
        self._reader.set_aside(delivery.path, payload, reason)

    def aside(self) -> list[tuple[bytes, str]]:
        """See `Receiver.aside`."""
        return self._reader.aside()

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
        counts = {"dropped_slow": self._dropped, "reconnects": self._reconnects}
        return {**counts, **self._reader.statistics()}

    def close(self) -> None:
        """See `Receiver.close`."""
        self._closed = True
        self._reader.close()
        with self._lock:
            if self._bus is not None:
                self._bus.close()
                self._bus = None
            os.close(self._wake_read)
            os.close(self._wake_write)
        self._client.close()

    def _subscribe_announcements(self) -> None:
        self._patterns[STREAMS] = 1
        self._change(b"SUBSCRIBE", STREAMS)

    def _adopt(self, pattern: str, start: str, *, reset: bool = False) -> None:
        """Read the streams that exist now and match."""
        key = Key.parse(pattern)
        try:
            for path in self._reader.known():
                if key.matches_path(path) and _is_path(path):
                    self._reader.add(path, start, reset=reset)
        except UpdatesUnavailable as error:
            log.warning("streams of %s cannot be listed now: %s", pattern, error)

    def _announced(self, path: str) -> None:
        if any(Key.parse(p).matches_path(path) for p in self._followed) and _is_path(path):
            self._reader.add(path, "0")

    def _change(self, verb: bytes, pattern: str) -> None:
        """Send (UN)SUBSCRIBE and read on until it is confirmed."""
        if self._bus is None and not self._open():
            return
        assert self._bus is not None  # noqa: S101 - just opened
        try:
            self._send_change(self._bus, verb, pattern)
            deadline = time.monotonic() + 5
            confirmed = verb.lower() if pattern == STREAMS or glob(pattern) is None else b"p" + verb.lower()
            while time.monotonic() < deadline:
                if any([self._sort(reply) == confirmed for reply in self._bus.wait(1.0)]):  # noqa: C419 - all
                    return
        except UpdatesUnavailable as error:
            self._lose(error)

    def _send_change(self, bus: Wire, verb: bytes, pattern: str) -> None:
        wild = None if pattern == STREAMS else glob(pattern)
        if wild is not None:
            bus.send(b"P" + verb, channel_name(wild))
        else:
            bus.send(verb, STREAMS if pattern == STREAMS else channel_name(pattern))

    def _open(self) -> bool:
        if not self._backoff.due(time.monotonic()):
            return False
        try:
            bus = Wire(self._url)
            for pattern in self._patterns:
                self._send_change(bus, b"SUBSCRIBE", pattern)
        except UpdatesUnavailable as error:
            self._lose(error)
            return False
        self._backoff.succeeded()
        self._bus = bus
        return True

    def _lose(self, error: Exception) -> None:
        if self._bus is not None:
            self._bus.close()
            self._bus = None
            self._reconnects += 1
        delay = self._backoff.failed(time.monotonic())
        if not self._closed:
            log.warning("subscriptions at %s: %s; retrying in %.2f s", self._url, error, delay)

    def _care(self) -> None:
        """Reconnect lost connections, and look for streams announced meanwhile."""
        if self._bus is None and self._patterns and not self._closed:
            with self._lock:
                opened = self._bus is None and self._open()
            if opened:
                log.warning("resubscribed at %s", self._url) if self._reconnects else None
                for pattern in list(self._followed):
                    self._adopt(pattern, "0")
        self._reader.care()

    def _wait(self, timeout: float) -> set[int]:
        poll = select.poll()
        poll.register(self._wake_read, select.POLLIN)
        bus = self._bus
        if bus is not None:
            poll.register(bus.fileno(), select.POLLIN)
        elif self._patterns:
            timeout = min(timeout, 0.05)
        timeout = min(timeout, self._reader.patience())
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
                log.error("subscription refused: %s", reply)
            return kind
        if len(reply) < 3 or not (isinstance(reply[-2], bytes) and isinstance(reply[-1], bytes)):
            raise UpdatesUnavailable("the server sent a message without channel or content")
        channel, payload = reply[-2], reply[-1]
        if channel == _STREAMS:
            self._announced(payload.decode("ascii", "replace"))
        elif self._backlog_bytes > self._backlog_limit:
            self._dropped += 1
        else:
            self._backlog.append(Delivery(channel[len(_PREFIX) :].decode("ascii", "replace"), payload))
            self._backlog_bytes += len(payload)
        return kind


def _is_path(text: str) -> bool:
    """Whether this is the path of a concrete key; any program may announce anything."""
    try:
        key = Key(text)
    except InvalidKey:
        return False
    return key.concrete and key.path == text
