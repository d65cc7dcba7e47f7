"""Payloads set aside: one stream per app, bounded by entries, bytes and age."""

import logging
import time
from typing import Any

import redis

from due.drivers.aside_queue import AsidePayload, AsideQueue
from due.errors import UpdatesUnavailable

log = logging.getLogger("due.updates")

_MOST_ENTRIES = 1000
_MOST_BYTES = 16 << 20
_MOST_OF_ONE = 4 << 20
_DAYS_S = 7 * 86_400


def aside_name(app: str) -> str:
    """The stream of payloads set aside for an app."""
    return f"due:poison:{app}"


class Aside:
    """Payloads set aside for one app: the latest thousand or 16 MiB; deleted after an idle week."""

    def __init__(self, commands: Any, app: str) -> None:
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._name = aside_name(app)
        self._queue = AsideQueue(self._store)
        self._stored = self._cut = 0

    @property
    def counts(self) -> dict[str, int]:
        """Counters for `health`."""
        return {
            "set_aside": self._stored,
            "set_aside_cut": self._cut,
            "set_aside_waiting": len(self._queue),
            "set_aside_lost": self._queue.lost,
        }

    def put(self, path: str, payload: bytes, reason: str) -> None:
        """Keep a payload (only the beginning of a very large one), here until the server answers; the oldest are deleted."""
        self._cut += len(payload) > _MOST_OF_ONE
        one = AsidePayload(path, payload[:_MOST_OF_ONE], reason, len(payload))
        self._queue.put(one, time.monotonic())

    def care(self) -> None:
        """Give to the server what it could not take before."""
        self._queue.care(time.monotonic())

    def patience(self) -> float:
        """Seconds until `care` has something to do."""
        return self._queue.patience(time.monotonic())

    def close(self) -> None:
        """Try a last time."""
        self._queue.close(time.monotonic())

    def _store(self, one: AsidePayload) -> None:
        reason = one.reason.encode(errors="replace")  # an error may quote a name that is no text
        fields: dict[Any, Any] = {"path": one.path, "f": one.payload, "reason": reason}
        if one.size > len(one.payload):
            fields["bytes"] = one.size
        try:
            self._commands.xadd(self._name, fields, maxlen=_MOST_ENTRIES, approximate=True)
        except (redis.RedisError, OSError) as error:
            raise UpdatesUnavailable(str(error)) from None
        self._stored += 1
        try:
            self._commands.expire(self._name, _DAYS_S)
            while (self._commands.memory_usage(self._name, samples=0) or 0) > _MOST_BYTES:
                self._commands.xtrim(
                    self._name, maxlen=self._commands.xlen(self._name) // 2, approximate=False
                )
        except (redis.RedisError, OSError) as error:
            log.debug("%s is shortened with the next payload: %s", self._name, error)

    def all(self) -> list[tuple[bytes, str]]:
        """Whole payloads and reasons, oldest first; raises `UpdatesUnavailable`."""
        try:
            entries = self._commands.xrange(self._name)
        except (redis.RedisError, OSError) as error:
            raise UpdatesUnavailable(f"the payloads set aside cannot be listed: {error}") from None
        whole = [fields for _, fields in entries if b"f" in fields and b"bytes" not in fields]
        return [(fields[b"f"], fields.get(b"reason", b"").decode("utf-8", "replace")) for fields in whole]
