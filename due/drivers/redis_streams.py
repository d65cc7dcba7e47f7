"""The producer's side of reliable delivery: one Redis stream per path, and what its readers still need.

    XADD ──reply──► kept (unacknowledged by readers) ──all live groups acknowledged──► retained (for replay)

A payload stays in `kept` until every live group of readers has acknowledged it; `kept` is bounded by
the window, and that bound is the back-pressure.  A group lives while one of its instances renewed its
lease (hash `due:readers:<path>`, field `<group>/<instance>`, value unix ms, 0 = left) within
`group_timeout`.  If the server comes back empty, retained and kept payloads are sent again; readers
recognise repeats.  Readers' clocks must agree within a few seconds.
"""

from collections import deque

STREAMS = "due:streams"
"""Set of the paths that are streams, and the channel on which new ones are announced."""
_OVERHEAD = 200
LEAST_PAUSE = 0.0025
"""Seconds between two questions how far the readers are, at least."""


def stream_name(path: str) -> str:
    """The Redis key of a stream."""
    return f"due:stream:{path}"


def readers_name(path: str) -> str:
    """The Redis hash of a stream's leases."""
    return f"due:readers:{path}"


class Entry:
    """A payload on its way: its id is known once the server has answered."""

    __slots__ = ("id", "path", "payload")

    def __init__(self, path: str, payload: bytes) -> None:
        self.path = path
        self.payload = payload
        self.id: tuple[int, int] | None = None

    @property
    def size(self) -> int:
        """Bytes that count against the window."""
        return len(self.payload) + _OVERHEAD


class StreamLedger:
    """What one producer has written to one stream and still keeps.  Not thread-safe."""

    def __init__(self, path: str, window: int, retain: int, group_timeout: float) -> None:
        self.path = path
        self.kept: deque[Entry] = deque()
        self.kept_bytes = 0
        self.retained: deque[Entry] = deque()
        self._retained_bytes = 0
        self._window = window
        self._retain = retain
        self._group_timeout = group_timeout
        self._leases: dict[str, float] = {}
        self.groups: tuple[bytes, ...] = ()
        """Live groups of readers, as of the last answer."""
        self.asked = False
        """A question about the readers is on its way."""
        self.asked_at = 0.0
        self.waiting = False
        """A writer waits for the readers."""
        self.patience = 0.0
        """How long it is likely to wait the next time, seconds."""
        self._asked_bytes = 0

    def ask_again(self, now: float, seconds: float) -> bool:
        """Whether to ask how far the readers are: after so long, or when much was added since the last time."""
        if self.asked or not self.kept:
            return False
        return now - self.asked_at > seconds or (self.kept_bytes - self._asked_bytes) * 4 > self._window

    def asking(self, now: float) -> None:
        """A question is being sent."""
        self.asked, self.asked_at, self._asked_bytes = True, now, self.kept_bytes

    def has_room(self, size: int) -> bool:
        """Whether a payload of that size fits; a lone big one always does."""
        return not self.kept or self.kept_bytes + size + _OVERHEAD <= self._window

    def excess(self, share: float) -> int:
        """Bytes that are kept beyond this share of the window."""
        return max(0, self.kept_bytes - int(share * self._window)) if self.kept else 0

    @property
    def half_full(self) -> bool:
        """Time to ask how far the readers are."""
        return self.kept_bytes * 2 > self._window

    def add(self, payload: bytes) -> Entry:
        """Keep a payload that is about to be sent."""
        entry = Entry(self.path, payload)
        self.kept.append(entry)
        self.kept_bytes += entry.size
        return entry

    def live_groups(self, leases: dict[str, float], now: float) -> set[str]:
        """Groups to wait for: seen alive within the time-out, by the server or by us before it lost them."""
        self._leases.update(leases)
        self._leases = {f: at for f, at in self._leases.items() if now - at < self._group_timeout}
        return {field.rpartition("/")[0] for field in self._leases}

    def acknowledged(self, up_to: tuple[int, int]) -> None:
        """All live groups are done with ids up to this one."""
        while self.kept and (at := self.kept[0].id) is not None and at <= up_to:
            entry = self.kept.popleft()
            self.kept_bytes -= entry.size
            self.retained.append(entry)
            self._retained_bytes += entry.size

    def trim_point(self, streams: int = 1) -> tuple[int, int] | None:
        """Forget the oldest retained payloads over the share of one of `streams`; the id from which to keep."""
        trimmed = False
        while len(self.retained) > 1 and self._retained_bytes > self._retain // streams:
            self._retained_bytes -= self.retained.popleft().size
            trimmed = True
        return self.retained[0].id if trimmed else None


def next_pause(waited: float, freed: int, missing: int, longest: float) -> float:
    """Seconds until asking again is worth it: `freed` bytes in `waited` seconds, `missing` are to come."""
    expected = waited * missing / freed if freed > 0 else 2 * waited
    return min(max(expected, LEAST_PAUSE), longest)


def parse_id(text: bytes | str) -> tuple[int, int]:
    """A stream id as a pair that compares."""
    ms, _, number = (text.decode() if isinstance(text, bytes) else text).partition("-")
    return int(ms), int(number or 0)
