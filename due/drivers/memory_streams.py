"""Reliable streams in the memory of one process, with the rules of `due.drivers.base.Receiver`.

    append ──► MemoryStream.entries ──► ReaderGroup: position, pending ──► a member's deliveries ──► acknowledged

A payload is kept until every living group has acknowledged it, then up to `retain` bytes for replay, and for as
long as it is at most `retain_s` seconds older than the newest.  A group lives while it has a member, and `group_timeout`
seconds longer.  No I/O; callers hold the space's lock; time is
an argument (seconds, monotonic).
"""

from bisect import bisect_right
from collections import OrderedDict
from dataclasses import dataclass, field

WITHDRAWN_SECONDS = 10.0
"""Seconds until a group without members is dropped if it withdrew its interest; an app that just ends keeps it."""
_COMPACT_AT = 1024
"""Forgotten entries after which their memory is released."""

EntryId = tuple[int, int]
"""Milliseconds since 1970 and a count, as the ids of Redis streams."""


def parse_start(text: str) -> EntryId:
    """The id that a start such as "0" or "1700000000000-0" names."""
    milliseconds, _, count = text.partition("-")
    return int(milliseconds), int(count or 0)


@dataclass(slots=True)
class HeldEntry:
    """One entry of a stream."""

    id: EntryId
    payload: bytes
    before: int
    """Bytes appended to the stream before it."""


@dataclass(slots=True)
class PendingEntry:
    """An entry that was delivered to a member and is not acknowledged."""

    entry: HeldEntry
    member: str
    tries: int = 1


@dataclass(slots=True)
class ReaderGroup:
    """One app's position in one stream."""

    position: EntryId
    """Entries after this one are new to the group."""
    members: set[str] = field(default_factory=set)
    pending: "OrderedDict[EntryId, PendingEntry]" = field(default_factory=OrderedDict)
    left_at: float = 0.0
    """When the last member left."""
    withdrawn: bool = False

    def lives(self, now: float, timeout: float) -> bool:
        """Whether producers wait for it."""
        return bool(self.members) or (not self.withdrawn and now - self.left_at <= timeout)

    def needs_from(self) -> EntryId:
        """The id up to which the group needs no entry any more."""
        first = next(iter(self.pending), None)
        return self.position if first is None else min(self.position, (first[0], first[1] - 1))

    def leave(self, member: str, now: float, *, withdrawn: bool) -> None:
        """A member closes or withdraws its interest."""
        self.members.discard(member)
        if not self.members:
            self.left_at, self.withdrawn = now, withdrawn

    def next_entries(
        self, stream: "MemoryStream", member: str, count: int, *, shared: bool, take_over: bool
    ) -> list[PendingEntry]:
        """The next entries for this member: first those that others left, then new ones."""
        others = [p for p in self.pending.values() if p.member != member]
        left = [p for p in others if take_over or p.member not in self.members]
        if others and not left and not shared:
            return []  # wait for a living member that still works on entries, to keep the order
        for pending in left[:count]:
            pending.member, pending.tries = member, pending.tries + 1
        if left:
            return left[:count]
        given = [PendingEntry(entry, member) for entry in stream.after(self.position, count)]
        for pending in given:
            self.pending[pending.entry.id] = pending
            self.position = pending.entry.id
        return given


class MemoryStream:
    """The entries of one path and the groups that read them."""

    def __init__(self, window: int, retain: int, group_timeout: float, retain_s: float) -> None:
        self.groups: dict[str, ReaderGroup] = {}
        self._window, self._retain, self._timeout = window, retain, group_timeout
        self._retain_ms = retain_s * 1000
        self._entries: list[HeldEntry] = []
        self._head = 0
        """Index into `_entries`; entries before it are forgotten."""
        self._given = 0
        """Bytes appended so far."""
        self._last: EntryId = (0, 0)

    def kept_bytes(self, now: float) -> int:
        """Bytes that some living group still needs."""
        place = self._place(self._floor(now))
        return self._given - self._entries[place].before if place < len(self._entries) else 0

    def has_room(self, size: int, now: float) -> bool:
        """Whether a payload fits into the window; into an empty one any payload does."""
        kept = self.kept_bytes(now)
        return not kept or kept + size <= self._window

    def append(self, payload: bytes, milliseconds: int, now: float) -> None:
        """Add an entry and forget those that no group needs."""
        same = milliseconds <= self._last[0]
        self._last = (self._last[0], self._last[1] + 1) if same else (milliseconds, 0)
        self._entries.append(HeldEntry(self._last, payload, self._given))
        self._given += len(payload)
        self.trim(now)

    def trim(self, now: float) -> None:
        """Forget groups that withdrew, and entries that nobody needs beyond what is retained."""
        for name, group in list(self.groups.items()):
            if group.withdrawn and not group.members and now - group.left_at > WITHDRAWN_SECONDS:
                del self.groups[name]
        floor, entries = self._floor(now), self._entries
        while self._head < len(entries) and entries[self._head].id <= floor:
            oldest = entries[self._head]
            young = self._last[0] - oldest.id[0] <= self._retain_ms
            if young and self._given - oldest.before <= self._retain:
                break
            self._head += 1
        if self._head > max(_COMPACT_AT, len(entries) // 2):
            del entries[: self._head]
            self._head = 0

    def after(self, position: EntryId, count: int) -> list[HeldEntry]:
        """The first entries behind `position`."""
        place = self._place(position)
        return self._entries[place : place + count]

    def join(self, name: str, member: str, start: str, *, reset: bool) -> ReaderGroup:
        """Become a member of a group; `start` counts where the group is new, or `reset`."""
        begins = self._last if start == "$" else parse_start(start)
        if start not in ("$", "0"):
            begins = (begins[0], begins[1] - 1)  # the entry of that id is wanted, too
        group = self.groups.get(name)
        if group is None:
            group = self.groups[name] = ReaderGroup(begins)
        elif reset:
            group.position = begins
            group.pending.clear()
        group.members.add(member)
        group.withdrawn = False
        return group

    def _place(self, position: EntryId) -> int:
        """Index of the first entry after `position`."""
        return bisect_right(self._entries, position, lo=self._head, key=lambda entry: entry.id)

    def _floor(self, now: float) -> EntryId:
        needed = [g.needs_from() for g in self.groups.values() if g.lives(now, self._timeout)]
        return min(needed, default=self._last)
