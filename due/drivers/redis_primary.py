"""Notices that another server has become the primary while the old one still holds our connections.

A killed primary closes them, and a demoted one refuses writes.  One that is frozen, or cut off from the sentinels, does
neither.
"""

import time
from collections.abc import Iterable

import redis

from due.backoff import Backoff
from due.drivers.redis_sentinel import Sentinels, is_sentinel, parse_sentinel_url
from due.drivers.redis_wire import Wire
from due.errors import UpdatesUnavailable

LOOK_SECONDS = 1.0
_SOON_SECONDS = 0.5


class PrimaryWatch:
    """Asks the sentinels once a second."""

    def __init__(self, url: str) -> None:
        self._url = url
        address = parse_sentinel_url(url)
        self._service = address.service
        self._sentinels = Sentinels(address)
        self._look_at = 0.0

    def successor(self, present: Iterable[str]) -> str:
        """HOST:PORT of a primary that is none of these; empty: they are right, or it is not time to look.

        Only of one that says itself that it is the primary: a sentinel may be behind the others.
        """
        now = time.monotonic()
        if now < self._look_at:
            return ""
        self._look_at = now + LOOK_SECONDS
        try:
            host, port = self._sentinels.discover_master(self._service)
            if all(f"{host}:{port}" == each for each in present):
                return ""
            wire = Wire(self._url)
        except (UpdatesUnavailable, redis.RedisError, OSError):
            return ""
        wire.close()
        return wire.primary

    def close(self) -> None:
        """Close the connections to the sentinels."""
        self._sentinels.close()


def watch_for(url: str) -> PrimaryWatch | None:
    """A watch for a URL; None where it names one server."""
    return PrimaryWatch(url) if is_sentinel(url) else None


def backoff_for(url: str) -> Backoff:
    """How often to try again; sooner behind sentinels, where another server may be there already."""
    return Backoff(longest=_SOON_SECONDS) if is_sentinel(url) else Backoff()
