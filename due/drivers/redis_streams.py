"""The producer's side of reliable delivery: one Redis stream per path, and what its readers still need.

    XADD ──reply──► kept (unacknowledged by readers) ──all live groups acknowledged──► retained (for replay)

A payload stays in `kept` until every live group of readers has acknowledged it; `kept` is bounded by
the window, and that bound is the back-pressure.  Behind sentinels it also stays until enough replicas have it
(`redis_replicas`).  What is retained is bounded by bytes, and by time: a path with few items would else take hours to
come to its bytes, here and on the server.  A group lives while one of its instances renews its
lease: until this producer has watched all of them unchanged for `group_timeout` (see `redis_leases`).
If the server comes back empty, retained and kept payloads are sent again; if another server takes its place, which
may lack the latest entries, what has not been read by all.  Readers recognise repeats.  The groups
that lived are made again between the two: a member that died, too, is followed by one that has never read.
A stream without writer and reader for `LIFETIME_S` expires, with its groups and leases.
"""

from collections import deque
from collections.abc import Mapping

from due.drivers.redis_leases import LeaseWatch, group_of
from due.errors import UpdatesUnavailable

PRODUCERS = "due:producers"
"""Set of the apps that have announced streams."""
NOBODY = (2**63, 0)
"""Position if no live group reads: everything may be forgotten."""
NOTHING = (0, 0)
"""Position of which only this is sure."""
_OVERHEAD = 200
LIFETIME_S = 86_400
"""Streams and leases expire after this long without a producer and a reader, seconds."""
CARE_SECONDS = 60.0
"""Seconds between two renewals of a stream's expiry."""
HEARING_SECONDS = 3.0
"""How long a producer waits for readers of a path that it has just announced to somebody."""
LEAST_PAUSE = 0.0025
"""Least seconds between two questions about the readers' progress."""


def stream_name(path: str) -> str:
    """The Redis key of a stream."""
    return f"due:stream:{path}"


def work_name(group: str, path: str) -> str:
    """The Redis stream of the ids of a stream that a group has to process: see `redis_work`."""
    return f"due:work:{group}:{path}"


def readers_name(path: str) -> str:
    """The Redis set of the groups that read a stream."""
    return f"due:readers:{path}"


def wake_name(group: str) -> str:
    """The Redis stream on which a group's members wake each other from waiting for entries."""
    return f"due:wake:{group}"


def announced_name(app: str) -> str:
    """Paths that are streams of an app, sorted by last use (unix s), and the channel where it announces them."""
    return f"due:streams:{app}"


class StreamEntry:
    """A sent payload; its id is known once the server has answered."""

    __slots__ = ("id", "number", "path", "payload")

    def __init__(self, path: str, payload: bytes) -> None:
        self.path = path
        self.payload = payload
        self.id: tuple[int, int] | None = None
        self.number = 0
        """See `redis_replicas.Confirmations`."""

    @property
    def size(self) -> int:
        """Bytes that count against the window."""
        return len(self.payload) + _OVERHEAD


class SendWindow:
    """What one producer has written to one stream and still keeps.  Not thread-safe.

    Args:
        path: of the stream.
        size: most bytes that may wait for acknowledgement.
        retain: bytes of acknowledged payloads kept for a server that comes back empty, shared by all streams.
        group_timeout: see above, s.
        retain_s: acknowledged payloads that are older than the newest by more than this are not kept.
    """

    def __init__(
        self, path: str, size: int, retain: int, group_timeout: float, retain_s: float = 3600.0
    ) -> None:
        self.path = path
        self.kept: deque[StreamEntry] = deque()
        self.kept_bytes = 0
        self.retained: deque[StreamEntry] = deque()
        self._retained_bytes = 0
        self._size = size
        self._retain = retain
        self._retain_ms = retain_s * 1000
        self._group_timeout = group_timeout
        self._leases = LeaseWatch(group_timeout)
        self.lasting = False
        """The stream is announced, and its expiry was renewed within the last `CARE_SECONDS`."""
        self.written = False
        """Written to since its expiry was renewed."""
        self.made = False
        """The stream is on the server, in its present life."""
        self._heard_at: float | None = None
        """When its first announcement reached somebody, s, monotonic; negative infinity: nobody."""
        self.groups: tuple[bytes, ...] = ()
        """Live groups of readers, as of the last answer."""
        self.known: tuple[bytes, ...] = ()
        """Groups whose leases are asked for: those that say they read the stream, and those that lived."""
        self.crowded = False
        """There are more names of readers than apps, or there were and some of them are left."""
        self.strangers: tuple[bytes, ...] = ()
        """Names among them that have no lease, where there are more names than apps."""
        self.places: set[bytes] = set()
        """Groups whose places were restored on the stream, until they have work lists again."""
        self.asked = False
        """A question about the readers is on its way."""
        self.asked_at = 0.0
        self.waiting = False
        """A writer waits for the readers."""
        self.patience = 0.0
        """Expected length of its next wait, seconds."""
        self._asked_bytes = 0
        self._read_to = NOBODY
        """What the groups had acknowledged as of the last answer that said it."""

    def ask_again(self, now: float, seconds: float) -> bool:
        """Whether to ask for the readers' progress: after `seconds`, or after many new bytes."""
        if self.asked or not self.kept:
            return False
        return now - self.asked_at > seconds or (self.kept_bytes - self._asked_bytes) * 4 > self._size

    def asking(self, now: float) -> None:
        """A question is being sent."""
        self.asked, self.asked_at, self._asked_bytes = True, now, self.kept_bytes

    def has_room(self, size: int) -> bool:
        """Whether a payload of this size fits into the window; into an empty one any payload does."""
        return not self.kept or self.kept_bytes + size + _OVERHEAD <= self._size

    def excess(self, share: float) -> int:
        """Bytes that are kept beyond this share of the window."""
        return max(0, self.kept_bytes - int(share * self._size)) if self.kept else 0

    def announced(self, listeners: int, now: float) -> None:
        """An announcement was published; only the first one is news.  `now`: s, monotonic."""
        if self._heard_at is None:
            self._heard_at = now if listeners else float("-inf")

    def awaits_readers(self, now: float) -> bool:
        """Whether who heard the first announcement still has time to say that it reads the stream."""
        return self._heard_at is not None and now - self._heard_at < HEARING_SECONDS

    def discard(self, entry: StreamEntry) -> None:
        """Forget an entry that the server refuses for good."""
        if entry in self.kept:
            self.kept.remove(entry)
            self.kept_bytes -= entry.size

    @property
    def half_full(self) -> bool:
        """Whether it is time to ask for the readers' progress."""
        return self.kept_bytes * 2 > self._size

    def add(self, payload: bytes) -> StreamEntry:
        """Keep a payload that is about to be sent."""
        entry = StreamEntry(self.path, payload)
        self.kept.append(entry)
        self.kept_bytes += entry.size
        self.written = True
        return entry

    def live_groups(self, leases: Mapping[bytes, bytes], asked: float, answered: float) -> set[bytes]:
        """Groups to wait for: seen alive within the timeout, on the server or by us before it lost them."""
        self._leases.look(leases, asked, answered)
        return self.living_groups()

    def living_groups(self) -> set[bytes]:
        """Groups that lived when the readers were last asked about."""
        return {group_of(field) for field in self._leases.living(self._group_timeout)}

    def acknowledged(self, up_to: tuple[int, int], confirmed: int = 0) -> None:
        """All live groups have acknowledged the ids up to this one; `NOTHING`: there are groups, not known how far.

        `confirmed`: number of the last entry that enough replicas have.
        """
        if up_to != NOTHING or self._read_to == NOBODY:
            self._read_to = up_to
        while self.kept and _is_done(self.kept[0], up_to, confirmed):
            entry = self.kept.popleft()
            self.kept_bytes -= entry.size
            self.retained.append(entry)
            self._retained_bytes += entry.size

    def unread(self) -> int:
        """How many of the retained payloads a group still reads, which came when nobody seemed to."""
        return sum(entry.id is not None and entry.id > self._read_to for entry in self.retained)

    def forget_ids(self, now: float) -> None:
        """The server was restarted, replaced or emptied: earlier ids mean nothing, and its clock may be behind them.

        Readers that this producer has not met yet have to find their way again, too.  `now`: s, monotonic.
        """
        for _ in range(self.unread()):
            entry = self.retained.pop()
            self._retained_bytes -= entry.size
            self.kept.appendleft(entry)
            self.kept_bytes += entry.size
        self._read_to = NOTHING
        self._heard_at = now
        self.made = False
        for entry in (*self.retained, *self.kept):
            entry.id = None

    def trim_point(self, streams: int = 1) -> tuple[int, int] | None:
        """Forget the oldest retained payloads over the share of one of `streams`, and those of too long ago.

        Returns the id from which to keep; None if nothing was forgotten, or if the id is from before a restart of the
        server.
        """
        trimmed = False
        while len(self.retained) > 1 and (self._retained_bytes > self._retain // streams or self._too_old()):
            self._retained_bytes -= self.retained.popleft().size
            trimmed = True
        return self.retained[0].id if trimmed else None

    def _too_old(self) -> bool:
        """Whether the newest retained payload was written long after the oldest, by the server's clock."""
        oldest, newest = self.retained[0].id, self.retained[-1].id
        return oldest is not None and newest is not None and newest[0] - oldest[0] > self._retain_ms


def _is_done(entry: StreamEntry, up_to: tuple[int, int], confirmed: int) -> bool:
    return entry.id is not None and entry.id <= up_to and entry.number <= confirmed


def next_pause(waited: float, freed: int, missing: int, longest: float) -> float:
    """Seconds until the next question: `freed` bytes in `waited` seconds, `missing` bytes still to free."""
    expected = waited * missing / freed if freed > 0 else 2 * waited
    return min(max(expected, LEAST_PAUSE), longest)


def parse_id(text: bytes | str) -> tuple[int, int]:
    """A stream id as a pair that compares; raises `UpdatesUnavailable` for anything else."""
    try:
        ms, _, number = (text.decode("ascii") if isinstance(text, bytes) else text).partition("-")
        return int(ms), int(number or 0)
    except (ValueError, AttributeError):
        raise UpdatesUnavailable(f"the server gave {text!r:.60} for a stream's id") from None
