"""Leases of readers: which members of a group are alive, without comparing the clocks of two machines.

    member ──every second──► hash due:lease:<group>:<path>, field <instance>, another value each time, 0: left
    anyone ──looks now and then──► LeaseWatch: seconds, by the watcher's own monotonic clock, without a change

A lease is judged by how long its watcher has seen it unchanged, never by what its value says. So wall clocks
may be wrong or jump, on the server too. Of the time between two looks one second counts at most: after a watcher, the
server or the network was stopped, all members get their full time to renew. Seen for the first time, a lease
counts as renewed; a watcher that starts therefore waits once in full for a member that died before.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import redis

log = logging.getLogger("due.updates")

LEFT = b"0"
"""The value of a lease that its member gave up."""
MOST_PER_LOOK_S = 1.0
_GONE = float("inf")


def lease_name(group: str, path: str) -> str:
    """The Redis hash of a group's leases of one stream: a key for each group, so that no other app can write it."""
    return f"due:lease:{group}:{path}"


def lease_field(group: bytes, consumer: bytes) -> bytes:
    """Names a lease where those of several groups are watched."""
    return group + b"/" + consumer


def group_of(field: bytes) -> bytes:
    """The group of such a lease."""
    return field.partition(b"/")[0]


class LeaseValue:
    """Values for one member's leases: no value is used twice.

    Unix ms if the clock allows it, as readers and writers of earlier versions expect.
    """

    def __init__(self) -> None:
        self._last = 0

    def next(self) -> bytes:
        """The value of the next renewal."""
        self._last = max(self._last + 1, int(time.time() * 1000))
        return b"%d" % self._last


class MemberLeases:
    """One member's leases.  Thread-safe: none is renewed after it was given up."""

    def __init__(self, commands: Any, group: str, consumer: str) -> None:
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group, self._consumer = group, consumer
        self._value = LeaseValue()
        self._lock = threading.Lock()

    def renew(self, paths: Callable[[], list[str]]) -> None:
        """Renew those of all paths that are read now."""
        with self._lock:
            self._write(paths(), self._value.next())

    def give_up(self, paths: list[str]) -> None:
        """These streams are read no more."""
        with self._lock:
            self._write(paths, LEFT)

    def _write(self, paths: list[str], value: bytes) -> None:
        if not paths:
            return
        try:
            pipe = self._commands.pipeline(transaction=False)
            for path in paths:
                pipe.hset(lease_name(self._group, path), self._consumer, value)
            pipe.execute()
        except (redis.RedisError, OSError) as error:
            log.debug("leases could not be written: %s", error)


class LeaseWatch:
    """One watcher's record of the leases of one stream.  Not thread-safe; times in seconds, monotonic.

    Args:
        keep: seconds for which a lease that vanished from the server still counts (it may have lost it).
        most_per_look: seconds that count at most between two looks.
    """

    def __init__(self, keep: float, most_per_look: float = MOST_PER_LOOK_S) -> None:
        self._keep = keep
        self._most = most_per_look
        self._looked: float | None = None
        self._seen: dict[bytes, tuple[bytes, float]] = {}

    def look(self, leases: Mapping[bytes, bytes], asked: float, answered: float) -> None:
        """Note the hash's content, which was read between `asked` and `answered`."""
        passed = 0.0 if self._looked is None else min(max(0.0, asked - self._looked), self._most)
        self._looked = answered
        seen = {}
        for field, value in leases.items():
            before, silent = self._seen.get(field, (b"", 0.0))
            seen[field] = (value, _GONE if value == LEFT else silent + passed if value == before else 0.0)
        for field, (value, silent) in self._seen.items():
            if field not in seen and silent + passed < self._keep:
                seen[field] = (value, silent + passed)
        self._seen = seen

    def silent(self, field: bytes) -> float:
        """Seconds for which this lease was seen unchanged; infinite if it was given up."""
        return self._seen[field][1] if field in self._seen else 0.0

    def value(self, field: bytes) -> bytes:
        """The lease's value at the last look."""
        return self._seen[field][0] if field in self._seen else b""

    def fields(self) -> list[bytes]:
        """All leases known."""
        return list(self._seen)

    def living(self, timeout: float) -> set[bytes]:
        """Leases that changed within `timeout` seconds of watching."""
        return {field for field, (_, silent) in self._seen.items() if silent < timeout}
