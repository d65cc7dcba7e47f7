"""Keeps the users on a Data Updates server as the identities say, and tells of every refusal.

A thread with one connection: an administrator's. A server without an ACL file forgets its users when it is
restarted; then they are made again.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import redis

from due.drivers.redis_wire import client
from sdnator.errors import PipelineError, SdnatorError
from sdnator.rights.identities import Identities

_LOOK_SECONDS = 1.0
_ENTRIES = 128
_LIBRARY = "client|setinfo"
"""A client library says its name with it and goes on where it may not; nothing is lost."""
_GROUPED_SECONDS = 60.0
"""The server counts a refusal in the entry of the one before for so long."""
_TOLD = 200
"""Most refusals that wait to be told."""

log = logging.getLogger(__name__)


class RightsRefused(SdnatorError):
    """The server lets this credential make no users."""


class RightsKeeper:
    """Watches one server.

    Args:
        url: of the server, with the credential of an administrator.
        identities: who may do what.
    """

    def __init__(self, url: str, identities: Identities) -> None:
        self._url = url
        self._identities = identities
        self._commands: Any = None  # Any: redis-py types an answer by options it cannot see
        self._changed = 0
        self._seen: dict[tuple[str, ...], _Refusal] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="rights", daemon=True)
        self._told: deque[str] = deque(maxlen=_TOLD)
        self.refusals: Counter[str] = Counter()
        """Refused commands by user."""

    def apply(self) -> None:
        """Make every user now.

        Raises:
            RightsRefused: the credential may not.
            PipelineError: the server does not answer.
        """
        try:
            self._connect()
            self._make()
        except redis.ResponseError as error:  # NOPERM, or a server without ACLs
            self.close()
            raise RightsRefused(str(error)) from None
        except (redis.RedisError, OSError) as error:
            self.close()
            raise PipelineError(f"Data Updates: {error}") from None

    def start(self) -> None:
        """Watch from now on."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the users stay."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(20)

    def told(self) -> list[str]:
        """What was refused since the last call, in words."""
        found = []
        while self._told:
            found.append(self._told.popleft())
        return found

    def close(self) -> None:
        """Close the connection."""
        if self._commands is not None:
            self._commands.close()
            self._commands = None

    def look(self) -> None:
        """One look: users and refusals.  Raises redis.RedisError, OSError."""
        if self._commands is None:
            self._connect()
        stamp = self._stamp()
        if stamp != self._changed:
            self._identities.reread()
            self._make()
            self._changed = stamp
        elif missing := self._missing():
            self._told.append(
                f"users of Data Updates were gone and are made again: {', '.join(sorted(missing))}"
            )
            self._make()
        self._note(self._commands.execute_command("ACL", "LOG", _ENTRIES))

    def _run(self) -> None:
        while not self._ended.wait(_LOOK_SECONDS):
            try:
                self.look()
            except (redis.RedisError, OSError) as error:
                log.debug("rights cannot be looked after now: %s", error)
                self.close()
        self.close()

    def _connect(self) -> None:
        self._commands = client(self._url)
        self._seen.clear()

    def _stamp(self) -> int:
        try:
            return self._identities.path.stat().st_mtime_ns
        except OSError:
            return self._changed

    def _missing(self) -> set[str]:
        there = {_text(name) for name in self._commands.execute_command("ACL", "USERS")}
        return {self._identities.prefix + name for name in self._identities.all} - there

    def _make(self) -> None:
        """Every identity is a user, and no other of this installation is."""
        prefix, names = self._identities.prefix, set(self._identities.all)
        for name in names:
            self._commands.execute_command("ACL", "SETUSER", *self._identities.rules(name))
        there = {_text(name) for name in self._commands.execute_command("ACL", "USERS")}
        ours = {name for name in there if name.startswith(prefix)}
        gone = ours - {prefix + name for name in names} - {prefix + "admin"}
        if gone:
            self._commands.execute_command("ACL", "DELUSER", *sorted(gone))

    def _note(self, entries: list[list[Any]]) -> None:
        """Count what is new in the server's log, which has the newest entry first."""
        current: dict[tuple[str, ...], _Refusal] = {}
        for entry in entries:
            refusal = _Refusal.of({_text(k): v for k, v in zip(entry[::2], entry[1::2], strict=False)})
            current.setdefault(refusal.key, refusal)
        for key, refusal in reversed(current.items()):
            self._tell(refusal, self._seen.get(key))
        self._seen = current

    def _tell(self, refusal: "_Refusal", before: "_Refusal | None") -> None:
        user = refusal.user.removeprefix(self._identities.prefix)
        known = user != refusal.user
        if (not known and user != "default") or refusal.what == _LIBRARY:
            return
        again = before is not None and refusal.at - before.at < _GROUPED_SECONDS
        fresh = refusal.times - (before.times if before is not None and again else 0)
        if fresh <= 0:
            return
        if not again:
            who = user if known else "somebody without a credential"
            self._told.append(f"{who} was refused the {refusal.why} {refusal.what} on Data Updates")
        self.refusals[user] += fresh


class _Refusal(NamedTuple):
    """One entry of the server's log: refusals of one kind, each within a minute of the one before."""

    number: str
    """Empty before Redis 7.2: there the newest entry of a kind counts."""
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
