"""Keeps the users on a Data Updates server as the identities say, and tells of every refusal.

A thread with one connection: an administrator's. A server without an ACL file forgets its users when it is
restarted; then they are made again.
"""

import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import redis

from due.drivers.redis_streams import PRODUCERS
from due.drivers.redis_wire import client
from sdnator.errors import PipelineError
from sdnator.rights.identities import Identities
from sdnator.rights.watching_keeper import RightsRefused, WatchingKeeper

_ENTRIES = 1024
"""Kinds of refusals that the server keeps for us; 128 where it is not told."""
_CROWD = 1024
"""More producers than an installation has."""
_LIBRARY = "client|setinfo"
"""A client library says its name with it and goes on where it may not; nothing is lost."""
_LOG_LENGTH = "acllog-max-len"
_NEWNESS = (b"entry-id", b"count", b"timestamp-last-updated")
_GROUPED_SECONDS = 60.0
"""A kind of refusal is told again after this long without one."""
_TOLD = 200
"""Most kinds of refusals that wait to be told; of the others their number is."""


class RightsKeeper(WatchingKeeper):
    """Watches one server.

    Args:
        url: of the server, with the credential of an administrator.
        identities: who may do what.
    """

    _away = (redis.RedisError, OSError)

    def __init__(self, url: str, identities: Identities) -> None:
        super().__init__(url, identities)
        self._commands: Any = None  # Any: redis-py types an answer by options it cannot see
        self._newest: dict[bytes, Any] = {}
        self._seen: dict[tuple[str, ...], _Refusal] = {}
        self._told: deque[str] = deque()
        self._untold = 0

    def apply(self) -> None:
        """See `WatchingKeeper.apply`."""
        try:
            self._connect()
            self._take_up()
        except redis.ResponseError as error:  # NOPERM, or a server without ACLs
            self.close()
            raise RightsRefused(str(error)) from None
        except (redis.RedisError, OSError) as error:
            self.close()
            raise PipelineError(f"Data Updates: {error}") from None

    def told(self) -> list[str]:
        """See `WatchingKeeper.told`."""
        found = []
        while self._told:
            found.append(self._told.popleft())
        if self._untold:
            found.append(f"{self._untold} further kinds of refusals on Data Updates")
            self._untold = 0
        return found

    def close(self) -> None:
        """Close the connection."""
        if self._commands is not None:
            self._commands.close()
            self._commands = None

    def look(self) -> bool:
        """One look: users and refusals.  Raises redis.RedisError, OSError."""
        if self._commands is None:
            self._connect()
        changed = super().look()
        if not changed and (missing := self._missing()):
            self._say(
                f"users of Data Updates were gone and have been created again: {', '.join(sorted(missing))}"
            )
            self._make()
        self._turn_away()
        if self._is_news(self._commands.execute_command("ACL", "LOG", 1)):
            self._note(self._commands.execute_command("ACL", "LOG", _ENTRIES))
        return changed

    def _turn_away(self) -> None:
        """Remove made-up producers: whoever may say something at all can add names, and readers ask each of them."""
        if self._commands.scard(PRODUCERS) <= _CROWD:
            return
        known = {name.encode() for name in self._identities.all}
        strangers = sorted(self._commands.smembers(PRODUCERS) - known)
        for first in range(0, len(strangers), _CROWD):
            self._commands.srem(PRODUCERS, *strangers[first : first + _CROWD])
        self._say(f"removed {len(strangers)} unknown producer names from Data Updates")

    def _connect(self) -> None:
        self._commands = client(self._url)
        self._seen.clear()
        self._newest = {}
        with suppress(redis.ResponseError):  # a service that lets nobody change its settings
            if int(self._commands.config_get(_LOG_LENGTH).get(_LOG_LENGTH, _ENTRIES)) < _ENTRIES:
                self._commands.config_set(_LOG_LENGTH, _ENTRIES)

    def _missing(self) -> set[str]:
        there = {_text(name) for name in self._commands.execute_command("ACL", "USERS")}
        return {self._identities.prefix + name for name in self._identities.all} - there

    def _make(self) -> None:
        prefix, names = self._identities.prefix, set(self._identities.all)
        for name in names:
            self._commands.execute_command("ACL", "SETUSER", *self._identities.rules(name))
        there = {_text(name) for name in self._commands.execute_command("ACL", "USERS")}
        ours = {name for name in there if name.startswith(prefix)}
        gone = ours - {prefix + name for name in names} - {prefix + "admin"}
        if gone:
            self._commands.execute_command("ACL", "DELUSER", *sorted(gone))

    def _is_news(self, newest: list[list[Any]]) -> bool:
        """Whether the log has changed: what is counted again comes first again.  Before Redis 7.2 nothing says so."""
        entry = dict(zip(newest[0][::2], newest[0][1::2], strict=False)) if newest else {}
        known, self._newest = self._newest, {name: entry.get(name) for name in _NEWNESS}
        return bool(newest) and (None in self._newest.values() or known != self._newest)

    def _say(self, text: str) -> None:
        if len(self._told) < _TOLD:
            self._told.append(text)
        else:
            self._untold += 1

    def _note(self, entries: list[list[Any]]) -> None:
        """Count what is new in the server's log, which has the newest entry first."""
        current: dict[tuple[str, ...], _Refusal] = {}
        for entry in entries:
            refusal = _Refusal.of({_text(k): v for k, v in zip(entry[::2], entry[1::2], strict=False)})
            newer = current.get(refusal.key)
            current[refusal.key] = (
                refusal if newer is None else newer._replace(times=newer.times + refusal.times)
            )
        for key, refusal in reversed(current.items()):
            self._tell(refusal, self._seen.get(key))
        self._seen = current

    def _tell(self, refusal: "_Refusal", before: "_Refusal | None") -> None:
        user = refusal.user.removeprefix(self._identities.prefix)
        known = user != refusal.user
        if (not known and user != "default") or refusal.what == _LIBRARY:
            return
        fresh = refusal.times - (before.times if before is not None else 0)
        if fresh <= 0:
            return
        if before is None or refusal.at - before.at >= _GROUPED_SECONDS:
            who = user if known else "somebody without a credential"
            self._say(f"{who} was refused the {refusal.why} {refusal.what} on Data Updates")
        self.refusals[user] += fresh


class _Refusal(NamedTuple):
    """One entry of the server's log: refusals of one kind, each within a minute of the one before."""

    number: str
    """Empty before Redis 7.2: there the entries of a kind are one."""
    user: str
    why: str
    what: str
    times: int
    at: float
    """Monotonic time of the last of them, seconds."""

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> "_Refusal":
        return cls(
            number=_text(entry.get("entry-id", "")),
            user=_text(entry.get("username", "")),
            why=_text(entry.get("reason", "")),
            what=_text(entry.get("object", "")),
            times=int(entry.get("count", 1)),
            at=time.monotonic() - float(entry.get("age-seconds", 0)),
        )

    @property
    def key(self) -> tuple[str, ...]:
        return (self.number,) if self.number else (self.user, self.why, self.what)


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
