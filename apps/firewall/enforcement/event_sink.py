"""Sinks for events: a file, a Redis list, syslog, a webhook.  I/O, each in its own thread.

A slow or broken sink blocks nobody: its queue is bounded.  Lines that do not fit, or that could not be
delivered after all attempts, are counted in `lost`.
"""

import logging
import queue
import threading
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import redis

from apps.firewall.enforcement.syslog_sink import to_syslog
from apps.firewall.settings import Settings
from due.drivers.redis_wire import client
from due.errors import DueError

QUEUE: Final = 10_000
CLOSE_S: Final = 2.0
LIST_LENGTH: Final = 100_000
_FIRST_PAUSE_S: Final = 0.2
_LONGEST_PAUSE_S: Final = 30.0
_TIMEOUT_S: Final = 5.0

log = logging.getLogger(__name__)
Deliver = Callable[[str], None]
"""Delivers one line; raises `OSError`, `redis.RedisError` or `DueError`."""


class EventSink:
    """Delivers lines to one sink in order, each with at most `attempts` attempts and growing pauses."""

    def __init__(self, name: str, deliver: Deliver, *, attempts: int = 8, size: int = QUEUE) -> None:
        self.name = name
        self.lost = 0
        self.delivered = 0
        self._deliver = deliver
        self._attempts = attempts
        self._lines: queue.Queue[str | None] = queue.Queue(size)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"event sink {name}", daemon=True)
        self._thread.start()

    @property
    def works(self) -> bool:
        """Whether its thread runs, or was asked to end."""
        return self._closing.is_set() or self._thread.is_alive()

    def put(self, line: str) -> None:
        """Queue a line; never waits."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.lost += 1

    def close(self, seconds: float = CLOSE_S) -> None:
        """Deliver what is queued, within a time limit; the rest is lost."""
        deadline = time.monotonic() + seconds
        while not self._lines.empty() and time.monotonic() < deadline:
            time.sleep(0.01)
        self._closing.set()
        with suppress(queue.Full):  # a full queue wakes the thread already
            self._lines.put_nowait(None)
        self._thread.join(max(0.1, deadline - time.monotonic()))
        while not self._lines.empty():
            self.lost += self._lines.get_nowait() is not None

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            if self._try(line):
                self.delivered += 1
            else:
                self.lost += 1
            if self._closing.is_set():
                return

    def _try(self, line: str) -> bool:
        pause = _FIRST_PAUSE_S
        for attempt in range(1, self._attempts + 1):
            try:
                self._deliver(line)
            except (OSError, redis.RedisError, DueError) as error:
                log.warning("%s, attempt %d of %d: %s", self.name, attempt, self._attempts, error)
                if attempt == self._attempts or self._closing.wait(pause):
                    return False
                pause = min(2 * pause, _LONGEST_PAUSE_S)
            else:
                return True
        return False


def to_file(path: str) -> Deliver:
    """Lines appended to a file, which is opened each time so that it can be rotated."""

    def deliver(line: str) -> None:
        with Path(path).open("a", encoding="utf-8") as events:
            events.write(line + "\n")

    return deliver


def to_redis_list(url: str, name: str) -> Deliver:
    """Lines appended to a list; its oldest lines are removed beyond `LIST_LENGTH`.

    Raises `InvalidOption` for a wrong URL.
    """
    server = client(url)

    def deliver(line: str) -> None:
        server.rpush(name, line)
        server.ltrim(name, -LIST_LENGTH, -1)

    return deliver


def to_webhook(url: str, token: str = "") -> Deliver:
    """Each line as the JSON body of a POST; an answer other than 2xx is a failure.

    Raises ValueError for a URL that is not http or https.
    """
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"webhook {url!r}: give http://… or https://…")
    headers = {"Content-Type": "application/json", "User-Agent": "sdnator"}
    if token:
        headers["Authorization"] = f"Bearer {token}"

    def deliver(line: str) -> None:
        request = urllib.request.Request(url, line.encode(), headers, method="POST")  # noqa: S310 - checked above
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:  # noqa: S310
            answer.read(1024)

    return deliver


def event_sinks(settings: Settings) -> tuple[list[EventSink], list[EventSink]]:
    """Sinks for every event, and sinks for important events only.

    Raises ValueError and `InvalidOption` for malformed URLs.
    """
    every = [EventSink("eve_file", to_file(settings.eve_file))] if settings.eve_file else []
    if settings.eve_redis:
        every.append(EventSink("eve_redis", to_redis_list(settings.eve_redis, settings.eve_list)))
    if settings.syslog:
        deliver = to_syslog(settings.syslog, settings.syslog_facility, settings.syslog_ca)
        every.append(EventSink("syslog", deliver))
    hook = to_webhook(settings.webhook, settings.webhook_token) if settings.webhook else None
    return every, [EventSink("webhook", hook)] if hook else []
