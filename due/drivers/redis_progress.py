"""The progress of a stream's readers, requested on the producer's own pipelined connection.

    HGETALL leases │ XINFO GROUPS │ XPENDING of each group known     one question, no waiting for the answer

The commands are not one transaction: what is delivered or acknowledged between them only makes the answer
more careful.
"""

import time
from typing import Any

import hiredis

from due.drivers.redis_leases import readers_name
from due.drivers.redis_streams import StreamLedger, parse_id, stream_name
from due.drivers.redis_wire import pack, understood

NOBODY = (2**63, 0)
"""Position if no live group reads: everything may be forgotten."""


class Question:
    """One question about one stream, and the replies so far."""

    def __init__(self, ledger: StreamLedger) -> None:
        self.ledger = ledger
        self._groups = ledger.groups
        self._replies: list[Any] = []
        self.size = 2 + len(self._groups)
        """Replies to come."""

    def command(self) -> bytes:
        """What to send."""
        name = stream_name(self.ledger.path)
        parts = [pack((b"HGETALL", readers_name(self.ledger.path))), pack((b"XINFO", b"GROUPS", name))]
        return b"".join((*parts, *(pack((b"XPENDING", name, group)) for group in self._groups)))

    def take(self, reply: Any) -> bool:
        """Take the next reply; returns whether it was the last."""
        self._replies.append(reply)
        return len(self._replies) == self.size

    def answer(self) -> tuple[int, int]:
        """The id up to which every live group has acknowledged; `NOBODY` where there is none.

        Tells the ledger which groups to ask about next time.  Raises `UpdatesUnavailable` for a nonsensical answer.
        """
        with understood("the question how far readers are"):
            return self._answer()

    def _answer(self) -> tuple[int, int]:
        leases, groups, *pendings = self._replies
        if isinstance(leases, hiredis.ReplyError):
            return (0, 0)
        # asked_at: the answer may have lain in the socket while this process was stopped
        live = self.ledger.live_groups(_map(leases), self.ledger.asked_at, time.monotonic())
        found = [] if isinstance(groups, hiredis.ReplyError) else [_map(group) for group in groups]
        self.ledger.groups = tuple(g[b"name"] for g in found if g[b"name"] in live)
        if len(self.ledger.groups) < len(live):
            return (0, 0)
        pending = dict(zip(self._groups, pendings, strict=True))
        return min((_position(g, pending) for g in found if g[b"name"] in self.ledger.groups), default=NOBODY)


def _map(flat: list[Any]) -> dict[bytes, Any]:
    return dict(zip(flat[::2], flat[1::2], strict=True))


def _position(group: dict[bytes, Any], pending: dict[bytes, Any]) -> tuple[int, int]:
    if not group[b"pending"]:
        return parse_id(group[b"last-delivered-id"])
    summary = pending.get(group[b"name"])
    if summary is None or isinstance(summary, hiredis.ReplyError):
        return (0, 0)
    if summary[1] is None:  # acknowledged meanwhile
        return parse_id(group[b"last-delivered-id"])
    ms, number = parse_id(summary[1])
    return (ms, number - 1)
