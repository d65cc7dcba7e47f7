"""The progress of a stream's readers, requested on the producer's own pipelined connection.

    HGETALL leases of each group known │ XINFO GROUPS │ XPENDING of each that lives     one question, no waiting

The commands are not one transaction: what is delivered or acknowledged between them only makes the answer
more careful. So does a group that nobody had asked about: its leases come with the next answer.
"""

import time
from typing import Any

import hiredis

from due.drivers.redis_leases import lease_field, lease_name
from due.drivers.redis_streams import NOBODY, NOTHING, StreamLedger, parse_id, stream_name
from due.drivers.redis_wire import pack, understood

_MOST_GROUPS = 1024
"""Whoever may read a stream may make groups of it."""


class Question:
    """One question about one stream, and the replies so far."""

    def __init__(self, ledger: StreamLedger) -> None:
        self.ledger = ledger
        self._known, self._groups = ledger.known, ledger.groups
        self._replies: list[Any] = []
        self.size = len(self._known) + 1 + len(self._groups)
        """Replies to come."""

    def command(self) -> bytes:
        """What to send."""
        path = self.ledger.path
        name = stream_name(path)
        leases = [
            pack((b"HGETALL", lease_name(group.decode("ascii", "replace"), path))) for group in self._known
        ]
        pendings = [pack((b"XPENDING", name, group)) for group in self._groups]
        return b"".join((*leases, pack((b"XINFO", b"GROUPS", name)), *pendings))

    def take(self, reply: Any) -> bool:
        """Take the next reply; returns whether it was the last."""
        self._replies.append(reply)
        return len(self._replies) == self.size

    @property
    def surprised(self) -> bool:
        """Whether the answer named groups whose leases it did not bring."""
        return not set(self.ledger.known) <= set(self._known)

    def answer(self) -> tuple[int, int]:
        """The id up to which every live group has acknowledged; `NOBODY` where there is none.

        Tells the ledger which groups to ask about next time.  Raises `UpdatesUnavailable` for a nonsensical answer.
        """
        with understood("the question how far readers are"):
            return self._answer()

    def _answer(self) -> tuple[int, int]:
        count = len(self._known)
        replies, groups, pendings = self._replies[:count], self._replies[count], self._replies[count + 1 :]
        if any(isinstance(reply, hiredis.ReplyError) for reply in replies):
            return NOTHING
        leases = {
            lease_field(group, consumer): value
            for group, reply in zip(self._known, replies, strict=True)
            for consumer, value in _map(reply).items()
        }
        # asked_at: the answer may have lain in the socket while this process was stopped
        live = self.ledger.live_groups(leases, self.ledger.asked_at, time.monotonic())
        found = [] if isinstance(groups, hiredis.ReplyError) else [_map(group) for group in groups]
        names = [group[b"name"] for group in found]
        self.ledger.groups = tuple(name for name in names if name in live)
        self.ledger.known = tuple(dict.fromkeys((*sorted(live), *names)))[:_MOST_GROUPS]
        if len(self.ledger.groups) < len(live) or self.surprised:
            return NOTHING
        pending = dict(zip(self._groups, pendings, strict=True))
        return min((_position(g, pending) for g in found if g[b"name"] in self.ledger.groups), default=NOBODY)


def _map(flat: list[Any]) -> dict[bytes, Any]:
    return dict(zip(flat[::2], flat[1::2], strict=True))


def _position(group: dict[bytes, Any], pending: dict[bytes, Any]) -> tuple[int, int]:
    if not group[b"pending"]:
        return parse_id(group[b"last-delivered-id"])
    summary = pending.get(group[b"name"])
    if summary is None or isinstance(summary, hiredis.ReplyError):
        return NOTHING
    if summary[1] is None:  # acknowledged meanwhile
        return parse_id(group[b"last-delivered-id"])
    ms, number = parse_id(summary[1])
    return (ms, number - 1)
