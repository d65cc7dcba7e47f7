"""What members of a group had when they died: found by their leases, and claimed on the work lists.

XINFO CONSUMERS ──► who has pending entries ──HGETALL leases──► silent for 3 s? ──XPENDING, XCLAIM──► ours
"""

import time
from collections.abc import Callable
from typing import Any

from due.drivers.redis_leases import LeaseWatch, lease_name
from due.drivers.redis_streams import work_name
from due.drivers.redis_work import WorkLists

SILENT_SECONDS = 3.0
"""A member whose lease has not changed for this long counts as dead."""
_MOST_CLAIMED = 1000
_NOBODY = "nobody"
"""A consumer that never has a lease: what is given to it is claimed like what a dead member had."""

Claimed = Callable[[str, bytes | None, int], None]
"""Id, payload (None: its producer has it no more), and how often it was delivered, this time included."""


class DeadMembers:
    """Those of one group, as one member sees them.  `claim` raises redis.RedisError and OSError."""

    def __init__(self, commands: Any, group: str, consumer: str) -> None:
        self._commands = commands  # Any: redis-py types an answer by options it cannot see
        self._group = group
        self._consumer = consumer
        self._lists = WorkLists(commands, group)
        self._watches: dict[str, LeaseWatch] = {}

    def forget(self, path: str) -> None:
        """This stream is read no more."""
        self._watches.pop(path, None)

    def claim(self, path: str, found: Claimed, *, even_the_living: bool) -> tuple[bool, bool]:
        """Take the pending entries of members that are silent.

        Args:
            path: of the stream.
            found: is called for each entry as it is claimed.
            even_the_living: the others are known to have ended.

        Returns:
            Whether there is no other member, and whether a living one has pending entries.
        """
        work = work_name(self._group, path)
        consumers: list[dict[str, Any]] = self._commands.xinfo_consumers(work, self._group)
        others = [one for one in consumers if one["name"] != self._consumer.encode()]
        names = [one["name"] for one in others if one["pending"]]
        if not names:
            return not others, False
        watch = self._watches.setdefault(path, LeaseWatch(SILENT_SECONDS))
        asked = time.monotonic()
        leases = self._commands.hgetall(lease_name(self._group, path))
        # a missing lease is treated like an unchanged one
        watch.look({name: leases.get(name, b"") for name in names}, asked, time.monotonic())
        waits = False
        for name in names:
            if not even_the_living and watch.silent(name) < SILENT_SECONDS:
                waits = True
            else:
                self._claim_from(path, name, found)
        return False, waits

    def release(self, path: str) -> None:
        """Give up this member's pending entries, so that another one need not wait for its end."""
        work = work_name(self._group, path)
        while True:
            pending: list[dict[str, Any]] = self._commands.xpending_range(
                work, self._group, "-", "+", _MOST_CLAIMED, consumername=self._consumer
            )
            if not pending:
                return
            tokens = [one["message_id"] for one in pending]
            self._commands.xclaim(work, self._group, _NOBODY, 0, tokens, justid=True)

    def _claim_from(self, path: str, consumer: bytes, found: Claimed) -> None:
        low = "-"
        while True:
            pending: list[dict[str, Any]] = self._commands.xpending_range(
                work_name(self._group, path), self._group, low, "+", _MOST_CLAIMED, consumername=consumer
            )
            if not pending:
                return
            tries = {one["message_id"]: one["times_delivered"] + 1 for one in pending}
            for token, payload in self._lists.take(path, self._consumer, tries):
                found(token, payload, tries.get(token.encode(), 2))
            low = "(" + pending[-1]["message_id"].decode()
