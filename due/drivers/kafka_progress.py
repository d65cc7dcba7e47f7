"""Positions on Kafka, without I/O: what a reader may commit, and what a producer still has to keep.

A group's position in a partition is the offset that Kafka holds for it: everything before it is acknowledged.
Entries may be acknowledged in any order; the position moves over a run without holes.  The commit's metadata says
how far entries were delivered and how often, so that the next reader knows which of them it sees again.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

_OVERHEAD = 200
"""Estimated bytes of a record besides its payload."""
Partition = tuple[str, int]
"""Topic and number."""


class PartitionProgress:
    """One reader's work on one partition.

    Args:
        position: the group's committed offset.
        note: the metadata of that commit.
    """

    def __init__(self, position: int, note: str = "") -> None:
        self.position = position
        self._seen_up_to, self._seen_tries = _parse_note(note)
        self._open: dict[int, bool] = {}
        """Offsets from `position` on, in order; True: acknowledged."""
        self.delivered_to = position
        """Every offset before this one was delivered or passed over."""
        self._committed = (position, note)

    def deliver(self, offset: int) -> int:
        """An entry is handed out; returns how often it was, this time included."""
        self._open[offset] = False
        self.delivered_to = offset + 1
        return self._seen_tries + 1 if offset < self._seen_up_to else 1

    def pass_over(self, offset: int) -> None:
        """An entry that this reader does not want."""
        self._open[offset] = True
        self.delivered_to = offset + 1
        self._advance()

    def acknowledge(self, offset: int) -> None:
        """The work on an entry is done; a second time changes nothing."""
        if offset in self._open:
            self._open[offset] = True
            self._advance()

    @property
    def unfinished(self) -> int:
        """Entries that were handed out and are not acknowledged."""
        return sum(not done for done in self._open.values())

    def commit(self, *, again: bool = False) -> tuple[int, str] | None:
        """Offset and metadata to commit now; None if nothing has changed since the last call, unless `again`."""
        repeated = self.position < self._seen_up_to
        tries = self._seen_tries + 1 if repeated else 1
        up_to = max(self.delivered_to, self._seen_up_to) if repeated else self.delivered_to
        wanted = (self.position, f"{up_to}:{tries}" if up_to > self.position else "")
        if wanted == self._committed and not again:
            return None
        self._committed = wanted
        return wanted

    def _advance(self) -> None:
        while self._open:
            offset, done = next(iter(self._open.items()))
            if not done:
                self.position = offset
                return
            del self._open[offset]
        self.position = self.delivered_to


def _parse_note(text: str) -> tuple[int, int]:
    up_to, _, tries = text.partition(":")
    if up_to.isdecimal() and tries.isdecimal() and len(text) < 40:
        return int(up_to), int(tries)
    return 0, 0


@dataclass(slots=True)
class SentRecord:
    """A payload that was given to Kafka's client."""

    size: int
    place: tuple[int, int] | None = None
    """Partition and offset, once the brokers have it."""


@dataclass(slots=True)
class PathWindow:
    """What one producer has written to one reliable path and its readers have not acknowledged."""

    path: str
    topic: str
    limit: int
    """Bytes."""
    kept: deque[SentRecord] = field(default_factory=deque)
    kept_bytes: int = 0
    waiting: bool = False
    """Whether a writer waits for room."""
    begun: bool = False
    """Whether the brokers have its first record."""

    def has_room(self, size: int) -> bool:
        """Whether a payload fits; into an empty window any payload does."""
        return not self.kept or self.kept_bytes + size + _OVERHEAD <= self.limit

    def add(self, size: int) -> SentRecord:
        """Note a payload of so many bytes."""
        record = SentRecord(size + _OVERHEAD)
        self.kept.append(record)
        self.kept_bytes += record.size
        return record

    def release(self, positions: Iterable[Mapping[Partition, int]]) -> None:
        """Forget what the brokers have and every one of these groups has acknowledged."""
        groups = list(positions)
        while self.kept:
            place = self.kept[0].place
            if place is None:
                return
            if any(group.get((self.topic, place[0]), -1) <= place[1] for group in groups):
                return
            self.kept_bytes -= self.kept.popleft().size


class AwaitedGroups:
    """For which of a topic's groups a producer waits.

    A group that has no position yet is waited for while it may be about to begin, and no longer: one without the right to
    read the topic never gets a position.  It misses nothing either way, because only age deletes records.

    Args:
        patience: s, how long a group without a position is waited for.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._since: dict[str, dict[str, float]] = {}
        """By topic: when a group was first seen without a position."""

    def of(
        self, topic: str, groups: Mapping[str, Mapping[Partition, int]], now: float
    ) -> list[Mapping[Partition, int]]:
        """The positions of those that are waited for.

        Args:
            topic: its name.
            groups: that want to read it, with their positions in this and other topics.
            now: s, monotonic.
        """
        before = self._since.get(topic, {})
        without = {
            group: before.get(group, now)
            for group, positions in groups.items()
            if not any(place[0] == topic for place in positions)
        }
        self._since[topic] = without
        return [
            positions
            for group, positions in groups.items()
            if now - without.get(group, now) <= self._patience
        ]
