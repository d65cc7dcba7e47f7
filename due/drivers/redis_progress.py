"""The progress of a stream's readers, requested on the producer's own pipelined connection.

    SRANDMEMBER of its readers │ HGETALL leases of each known │ XINFO GROUPS, XPENDING of the work list of each that lives

One question, no waiting.  The commands are not one transaction: what is delivered or acknowledged between them only
makes the answer more careful. So does a group that nobody had asked about: its leases come with the next answer.
"""

import time
from typing import Any

import hiredis

from due.drivers.redis_leases import lease_field, lease_name
from due.drivers.redis_streams import NOBODY, NOTHING, SendWindow, parse_id, readers_name, work_name
from due.drivers.redis_wire import pack, understood

_MOST_GROUPS = 1024
"""A client that may read a stream may add names to its readers."""
_CROWD = 256
"""From so many names on, those without a lease are removed."""
_OF_A_GROUP = 2
"""Commands about the work list of a group."""


class Question:
    """One question about one stream, and the replies so far."""

    def __init__(self, window: SendWindow) -> None:
        self.window = window
        self._known, self._groups = window.known, window.groups
        self._replies: list[Any] = []
        self.size = 1 + len(self._known) + _OF_A_GROUP * len(self._groups)
        """Replies to come."""
        self.surprised = False
        """Whether groups were named or found alive about which the question had not asked everything."""
        self.placed: set[bytes] = set()
        """Groups that have work lists."""

    def command(self) -> bytes:
        """What to send."""
        path = self.window.path
        leases = [pack((b"HGETALL", lease_name(_text(group), path))) for group in self._known]
        works = [(work_name(_text(group), path), group) for group in self._groups]
        asked = [pack(one) for name, group in works for one in _about(name, group)]
        return b"".join((pack((b"SRANDMEMBER", readers_name(path), _MOST_GROUPS)), *leases, *asked))

    def take(self, reply: Any) -> bool:
        """Take the next reply; returns whether it was the last."""
        self._replies.append(reply)
        return len(self._replies) == self.size

    def answer(self) -> tuple[int, int]:
        """The id up to which every live group has acknowledged; `NOBODY` where there is none.

        Tells the window which groups to ask about next time.  Raises `UpdatesUnavailable` for a nonsensical answer.
        """
        with understood("the question how far readers are"):
            return self._answer()

    def _answer(self) -> tuple[int, int]:
        count = 1 + len(self._known)
        names, lease_replies, works = self._replies[0], self._replies[1:count], self._replies[count:]
        if any(isinstance(reply, hiredis.ReplyError) for reply in (names, *lease_replies)):
            return NOTHING
        found = {group: _map(reply) for group, reply in zip(self._known, lease_replies, strict=True)}
        leases = {
            lease_field(group, consumer): value
            for group, theirs in found.items()
            for consumer, value in theirs.items()
        }
        # asked_at: the answer may have lain in the socket while this process was stopped
        live = self.window.live_groups(leases, self.window.asked_at, time.monotonic())
        self._ask_next_time(live, _names(names), found)
        positions = dict(
            zip(self._groups, map(_position, self._groups, works[::2], works[1::2]), strict=True)
        )
        self.placed = {group for group, place in positions.items() if place is not None}
        if self.surprised or not live <= self.placed:
            return NOTHING
        return min((positions[group] or NOTHING for group in live), default=NOBODY)

    def _ask_next_time(self, live: set[bytes], names: list[bytes], leases: dict[bytes, Any]) -> None:
        window = self.window
        window.groups = tuple(sorted(live))
        window.known = tuple(dict.fromkeys((*window.groups, *names)))[:_MOST_GROUPS]
        # what is left of a crowd goes, too, however few they are
        window.crowded = len(names) >= _CROWD or (
            window.crowded and any(not leases.get(name) for name in names)
        )
        window.strangers = tuple(name for name in names if window.crowded and leases.get(name) == {})
        # of a crowd each answer names others
        fresh = set() if len(names) >= _MOST_GROUPS else set(window.known) - set(self._known)
        self.surprised = bool(fresh or live - set(self._groups))


def _about(name: str, group: bytes) -> tuple[tuple[bytes | str, ...], ...]:
    return (b"XINFO", b"GROUPS", name), (b"XPENDING", name, group)


def _text(group: bytes) -> str:
    return group.decode("ascii", "replace")


def _names(reply: Any) -> list[bytes]:
    return sorted(name for name in reply if isinstance(name, bytes))


def _map(flat: list[Any]) -> dict[bytes, Any]:
    return dict(zip(flat[::2], flat[1::2], strict=True))


def _position(group: bytes, groups: Any, summary: Any) -> tuple[int, int] | None:
    """Up to where a group has acknowledged; None: it has no work list yet."""
    if isinstance(groups, hiredis.ReplyError):
        return None
    mine = next((one for one in map(_map, groups) if one[b"name"] == group), None)
    if mine is None:
        return None
    if not mine[b"pending"]:
        return parse_id(mine[b"last-delivered-id"])
    if isinstance(summary, hiredis.ReplyError):
        return NOTHING
    if summary[1] is None:  # acknowledged meanwhile
        return parse_id(mine[b"last-delivered-id"])
    ms, number = parse_id(summary[1])
    return (ms, number - 1)
