"""Payloads set aside: one stream per app, bounded by entries, bytes and age."""

import logging
from typing import Any

import redis

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
        self.counts = {"set_aside": 0, "set_aside_cut": 0, "set_aside_failed": 0}

    def put(self, path: str, payload: bytes, reason: str) -> None:
        """Keep a payload (only the beginning of a very large one); the oldest are deleted."""
        self.counts["set_aside"] += 1
        fields: dict[Any, Any] = {"path": path, "f": payload, "reason": reason}
        if len(payload) > _MOST_OF_ONE:
            self.counts["set_aside_cut"] += 1
            fields |= {"f": payload[:_MOST_OF_ONE], "bytes": len(payload)}
        try:
            self._commands.xadd(self._name, fields, maxlen=_MOST_ENTRIES, approximate=True)
            self._commands.expire(self._name, _DAYS_S)
            while (self._commands.memory_usage(self._name, samples=0) or 0) > _MOST_BYTES:
                self._commands.xtrim(
                    self._name, maxlen=self._commands.xlen(self._name) // 2, approximate=False
                )
        except (redis.RedisError, OSError) as error:
            self.counts["set_aside_failed"] += 1
            log.error("an item of %s could not be set aside: %s", path, error)  # noqa: TRY400 - no trace

    def all(self) -> list[tuple[bytes, str]]:
        """Whole payloads and reasons, oldest first; raises `UpdatesUnavailable`."""
        try:
            entries = self._commands.xrange(self._name)
        except (redis.RedisError, OSError) as error:
            raise UpdatesUnavailable(f"the payloads set aside cannot be listed: {error}") from None
        whole = [fields for _, fields in entries if b"f" in fields and b"bytes" not in fields]
        return [(fields[b"f"], fields.get(b"reason", b"").decode("utf-8", "replace")) for fields in whole]
