"""Data Archives in the memory of one process: for tests, notebooks and single programs.

URL: `memory://` or `memory://NAME`; engines that give the same name share what is stored, and it is gone with
the process.  A row holds one frame as it travelled, so what a reader does to a value changes nothing here.
"""

import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from due.codec import pack, unpack
from due.drivers.lasting import NOTHING, SHARE, Lasting
from due.drivers.latest_items import by_age
from due.drivers.query import parse
from due.errors import BackendError, InvalidOption
from due.keys import Key
from due.messages import Item, PackedFrame

_OVERHEAD = 200
"""Estimated bytes of a row besides its payload."""


class _Row(NamedTuple):
    frame: PackedFrame
    wanted: frozenset[int]
    """Sequence numbers of this frame that no earlier row holds."""


class _Store:
    """The data shared by all archives of one name."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.rows: list[_Row] = []
        self.stored: dict[tuple[str, str], set[int]] = {}
        """Sequence numbers by (instance, key)."""

    def add(self, frame: PackedFrame) -> None:
        stored = self.stored.setdefault((frame.instance_id, frame.key), set())
        wanted = frozenset(range(frame.sequence, frame.sequence + frame.count)) - stored
        if wanted:
            stored |= wanted
            self.rows.append(_Row(frame, wanted))

    def drop(self, rows: Iterable[_Row]) -> int:
        gone = set(map(id, rows))
        if not gone:
            return 0
        deleted = 0
        for row in self.rows:
            if id(row) in gone:
                deleted += len(row.wanted)
                name = (row.frame.instance_id, row.frame.key)
                self.stored[name] -= row.wanted
                if not self.stored[name]:
                    del self.stored[name]
        self.rows = [row for row in self.rows if id(row) not in gone]
        return deleted


_stores: dict[str, _Store] = {}
_stores_lock = threading.Lock()


def memory_name(url: str) -> str:
    """The NAME of `memory://NAME`; raises InvalidOption for any other URL."""
    parts = urlsplit(url)
    if parts.scheme != "memory" or parts.path not in ("", "/") or parts.query or parts.fragment:
        raise InvalidOption(f"URL {url!r}: write memory:// or memory://NAME")
    return parts.netloc


class MemoryArchive:
    """`ArchiveDriver` over the memory of this process.  Raises InvalidOption for a wrong URL."""

    def __init__(self, url: str) -> None:
        with _stores_lock:
            self._store = _stores.setdefault(memory_name(url), _Store())
        self._closed = False
        self.damaged = 0
        """See `ArchiveDriver.damaged`; memory has none."""

    def insert(self, items: Sequence[Item]) -> None:
        """Store items, one row each."""
        self.insert_frames([pack([item]) for item in items])

    def insert_frames(self, frames: Sequence[PackedFrame]) -> None:
        """Store frames unchanged; of a frame that is stored partly, the missing items."""
        with self._open().lock:
            for frame in frames:
                self._store.add(frame)

    def find(self, query: Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Items that match, oldest first (timestamp, then sequence); of more than `limit` the latest."""
        parsed = parse(query)
        keys = [condition.operand for condition in parsed.conditions("dataKey") if _plain(condition)]
        with self._open().lock:
            rows = list(self._store.rows)
        among: dict[str, bool] = {}
        found = []
        for row in rows:
            text = row.frame.key
            if text not in among:
                among[text] = all(key.matches(Key(text)) for key in keys)
            if among[text]:
                items = unpack(row.frame)
                found += [item for item in items if item.sequence in row.wanted and parsed.matches(item)]
        found.sort(key=by_age)
        return found if limit is None else found[max(0, len(found) - limit) :]

    def prune(
        self, *, before: int | None = None, max_bytes: int | None = None, lasting: Lasting = NOTHING
    ) -> int:
        """Delete rows that are wholly older than `before`, then the oldest down to `max_bytes`."""
        with self._open().lock:
            lasts = frozenset(lasting.among({row.frame.key for row in self._store.rows}))
            deleted = 0
            for kept, moment in ((False, before), (True, lasting.before)):
                if moment is not None:
                    deleted += self._store.drop(
                        row
                        for row in self._store.rows
                        if (row.frame.key in lasts) is kept and row.frame.last_timestamp < moment
                    )
            if max_bytes is not None:
                deleted += self._store.drop(_oldest(self._store.rows, max_bytes, lasts))
            return deleted

    def tend(self) -> None:
        """Nothing is held that others could need."""

    def close(self) -> None:
        """Further calls raise BackendError; what is stored stays for others of the same name."""
        self._closed = True

    def _open(self) -> _Store:
        if self._closed:
            raise BackendError("the archive is closed")
        return self._store


def _plain(condition: Any) -> bool:
    return condition.operator == "eq" and not condition.negated


def _oldest(rows: Sequence[_Row], max_bytes: int, lasts: frozenset[str]) -> list[_Row]:
    lasting = [row for row in rows if row.frame.key in lasts]
    excess = _size(rows) - max_bytes
    gone = _up_to(min(excess, _size(lasting) - max_bytes // SHARE), lasting)
    return gone + _up_to(excess - _size(gone), [row for row in rows if row.frame.key not in lasts])


def _size(rows: Sequence[_Row]) -> int:
    return sum(len(row.frame.payload) + _OVERHEAD for row in rows)


def _up_to(size: int, rows: Sequence[_Row]) -> list[_Row]:
    """The oldest rows that hold so many bytes together."""
    gone: list[_Row] = []
    for row in sorted(rows, key=lambda one: one.frame.first_timestamp):
        if size <= 0:
            break
        gone.append(row)
        size -= len(row.frame.payload) + _OVERHEAD
    return gone
