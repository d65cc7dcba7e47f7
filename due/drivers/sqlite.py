"""Data Archives in one file: SQLite in WAL mode, many processes at a time.

A row holds one encoded frame, or the value of one item.  Queries narrow rows by index on
key and time, then `query.matches` decides item by item.  URL: `sqlite:///folder/file.db`, with
`?synchronous=full` to survive a power cut as well as a killed process.
"""

import logging
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from heapq import merge
from itertools import groupby
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs, unquote, urlsplit

from due.codec import decode_value, encode_value, unpack
from due.drivers.lasting import NOTHING, SHARE, Lasting
from due.drivers.latest_items import by_age, latest_items
from due.drivers.query import ArchiveQuery, parse
from due.drivers.query_time import in_time, time_left
from due.drivers.query_tree import INT64, Condition
from due.drivers.sqlite_file import ArchiveDiskFull, DamagedCell, SqliteFile, whole_number
from due.drivers.sqlite_reserve import PruningReserve
from due.errors import DecodeError, InvalidKey, InvalidOption, Timeout
from due.messages import Item, PackedFrame

log = logging.getLogger("due.archive")

_VALUE, _FRAME = 0, 1
_ROW_OVERHEAD = 200
_PRUNE_ROWS = 5000
_STEPS = 10_000
_SYNCHRONOUS = ("normal", "full")
_INSERT = "INSERT INTO frames VALUES(NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
_SELECT = (
    "SELECT key_id, source_id, format, first_sequence, first_time, first_event, payload FROM frames WHERE "
)
_HEADS = "SELECT last_time, id FROM frames WHERE "
_AMONG = "id IN (SELECT value FROM json_each(?))"
_OVERLAP = """SELECT first_sequence, last_sequence FROM frames
WHERE source_id = ? AND key_id = ? AND last_sequence >= ? ORDER BY last_sequence LIMIT 1"""
_WIDEN = """UPDATE keys SET time_span = max(time_span, ?), event_span = max(event_span, ?) WHERE id = ?"""
# casts, because a damaged row is pruned, too
_OLDER = "SELECT id, coalesce(CAST(count AS INTEGER), 0) FROM frames WHERE key_id = ? AND first_time < ? AND last_time < ? LIMIT ?"
_DELETE = "DELETE FROM frames WHERE id = ?"
_OLDEST = """SELECT coalesce(CAST(first_time AS INTEGER), 0), id, coalesce(CAST(count AS INTEGER), 0),
    coalesce(length(payload), 0)
FROM frames WHERE key_id = ? ORDER BY first_time"""
_BYTES = "SELECT count(*), coalesce(sum(length(payload)), 0) FROM frames WHERE key_id = ?"

_by_identity = attrgetter("instance_id", "key", "sequence")
_by_stream = attrgetter("instance_id", "key")


class _Row(NamedTuple):
    """One row of `frames`, in the order of its columns; `items` is its count."""

    key: int
    source: int
    format: int
    items: int
    first_sequence: int
    last_sequence: int
    first_time: int
    last_time: int
    first_event: int
    last_event: int
    payload: bytes


class SqliteArchive:
    """`ArchiveDriver` over one file; opened at the first call.  Raises InvalidOption for a wrong URL."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        options = parse_qs(parts.query)
        path = Path(unquote(parts.path))
        synchronous = options.pop("synchronous", ["normal"])[-1].lower()
        if parts.scheme != "sqlite" or parts.netloc or not path.name or not path.is_absolute():
            raise InvalidOption(f"archive URL {url!r}: write sqlite:///folder/file.db")
        if options or synchronous not in _SYNCHRONOUS:
            raise InvalidOption(f"archive URL {url!r}: the only option is synchronous=normal or =full")
        self._file = SqliteFile(path, synchronous)
        self._reserve = PruningReserve(path)
        self._url = url
        self._damaged_rows = 0

    @property
    def damaged(self) -> int:
        """Rows, keys and sources that could not be decoded and are missing from results."""
        return self._damaged_rows + len(self._file.keys.unreadable) + len(self._file.sources.unreadable)

    def insert(self, items: Sequence[Item]) -> None:
        """Store items, one row each."""
        with self._file.writing() as connection:
            self._insert_items(connection, items)

    def insert_frames(self, frames: Sequence[PackedFrame]) -> None:
        """Store frames unchanged; item by item if an index is wanted or a frame is stored partly."""
        with self._file.writing() as connection:
            for frame in frames:
                row = self._frame_row(connection, frame)
                overlap = _overlap(connection, row)
                if overlap == (row.first_sequence, row.last_sequence):
                    continue
                if frame.index or overlap is not None:
                    self._insert_items(connection, unpack(frame))
                    continue
                connection.execute(_INSERT, row)
                self._widen(connection, row)

    def find(self, query: Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Items that match, oldest first (timestamp, then sequence); of more than `limit` the latest."""
        parsed = parse(query)
        with self._file.reading() as connection, _interrupted_in_time(connection):
            text, parameters = self._where(connection, parsed)
            if limit is not None:
                heads = connection.execute(_HEADS + text, parameters).fetchall()

                def read(numbers: Sequence[int]) -> Iterator[Item]:
                    rows = connection.execute(_SELECT + _AMONG, (f"[{','.join(map(str, numbers))}]",))
                    return (item for row in in_time(rows.fetchall()) for item in self._items(row, parsed))

                by_end = sorted(map(_head, heads), key=itemgetter(0), reverse=True)
                return latest_items(by_end, read, limit)
            rows = connection.execute(_SELECT + text, parameters).fetchall()
        items = [item for row in in_time(rows) for item in self._items(row, parsed)]
        items.sort(key=by_age)
        return items

    def prune(
        self, *, before: int | None = None, max_bytes: int | None = None, lasting: Lasting = NOTHING
    ) -> int:
        """Delete rows that are wholly older than `before`, then the oldest down to `max_bytes`.

        Where the disk is full, what was kept in reserve for this is used.
        """
        try:
            try:
                return self._pruned(before, max_bytes, lasting)
            except ArchiveDiskFull:
                if not self._reserve.give_up():
                    raise
            self._file.checkpoint()
            return self._pruned(before, max_bytes, lasting)
        finally:
            self._reserve.allocate()

    def _pruned(self, before: int | None, max_bytes: int | None, lasting: Lasting) -> int:
        deleted = 0
        if before is not None or lasting.before is not None:
            deleted += self._in_steps(lambda connection: self._prune_older(connection, before, lasting))
        if max_bytes is not None:
            deleted += self._in_steps(lambda connection: self._prune_lasting(connection, max_bytes, lasting))
            deleted += self._in_steps(lambda connection: self._prune_others(connection, max_bytes, lasting))
        if deleted:
            with self._file.writing() as connection:
                self._file.keys.prune(connection)
                self._file.sources.prune(connection)
            self._file.shrink()
        return deleted

    def _prune_older(self, connection: sqlite3.Connection, before: int | None, lasting: Lasting) -> int:
        lasts, others = self._divided(connection, lasting)
        return _delete_older(connection, others, before) or _delete_older(connection, lasts, lasting.before)

    def _prune_lasting(self, connection: sqlite3.Connection, max_bytes: int, lasting: Lasting) -> int:
        excess = _used(connection) - max_bytes
        if excess <= 0:
            return 0
        lasts, _ = self._divided(connection, lasting)
        too_much = _size(connection, lasts) - max_bytes // SHARE
        return _delete_oldest(connection, lasts, min(excess, too_much))

    def _prune_others(self, connection: sqlite3.Connection, max_bytes: int, lasting: Lasting) -> int:
        excess = _used(connection) - max_bytes
        if excess <= 0:
            return 0
        _, others = self._divided(connection, lasting)
        return _delete_oldest(connection, others, excess)

    def _divided(self, connection: sqlite3.Connection, lasting: Lasting) -> tuple[list[int], list[int]]:
        """Ids of keys whose items last, and of the others; damaged ones do not last."""
        self._file.keys.refresh(connection)
        ids = {text: number for number, (text,) in self._file.keys.entries.items()}
        lasts = {ids[key] for key in lasting.among(ids)}
        every = [whole_number(number) for (number,) in connection.execute("SELECT id FROM keys")]
        return sorted(lasts), [number for number in every if number not in lasts]

    def _in_steps(self, step: Callable[[sqlite3.Connection], int]) -> int:
        """Use many short transactions, so that writers in other processes are not blocked for long."""
        deleted = 0
        while True:
            with self._file.writing() as connection:
                count = step(connection)
            if not count:
                return deleted
            deleted += count

    def tend(self) -> None:
        """See `ArchiveDriver.tend`."""
        self._file.tend()

    def close(self) -> None:
        """Close the file; further calls raise BackendError."""
        self._file.close()

    def _insert_items(self, connection: sqlite3.Connection, items: Sequence[Item]) -> None:
        for _, group in groupby(sorted(items, key=_by_identity), _by_stream):
            rows = [self._item_row(connection, item) for item in group]
            # for sequence numbers that occur twice in one call, the first counts
            rows = [
                row for n, row in enumerate(rows) if not n or row.first_sequence != rows[n - 1].first_sequence
            ]
            if _overlap(connection, rows[0]._replace(last_sequence=rows[-1].last_sequence)) is not None:
                rows = [row for row in rows if _overlap(connection, row) is None]
            connection.executemany(_INSERT, rows)

    def _item_row(self, connection: sqlite3.Connection, item: Item) -> _Row:
        key = self._file.keys.id_of(connection, item.key)
        source = self._file.sources.id_of(connection, item.app_id, item.instance_id)
        number, time, event = item.sequence, item.timestamp, item.event_time
        payload = encode_value(item.value)
        return _Row(key, source, _VALUE, 1, number, number, time, time, event, event, payload)

    def _frame_row(self, connection: sqlite3.Connection, frame: PackedFrame) -> _Row:
        return _Row(
            key=self._file.keys.id_of(connection, frame.key),
            source=self._file.sources.id_of(connection, frame.app_id, frame.instance_id),
            format=_FRAME,
            items=frame.count,
            first_sequence=frame.sequence,
            last_sequence=frame.sequence + frame.count - 1,
            first_time=frame.first_timestamp,
            last_time=frame.last_timestamp,
            first_event=frame.first_event_time,
            last_event=frame.last_event_time,
            payload=frame.payload,
        )

    def _widen(self, connection: sqlite3.Connection, row: _Row) -> None:
        """Record the largest span of the items in one row, for readers."""
        time, event = row.last_time - row.first_time, row.last_event - row.first_event
        known_time, known_event = self._file.spans.get(row.key, (0, 0))
        if time > known_time or event > known_event:
            # twice as much; otherwise a slowly growing span would be written with every frame
            spans = (max(2 * time, known_time), max(2 * event, known_event))
            connection.execute(_WIDEN, (*spans, row.key))
            self._file.spans[row.key] = spans

    def _where(self, connection: sqlite3.Connection, query: ArchiveQuery) -> tuple[str, list[Any]]:
        self._file.keys.refresh(connection)
        self._file.sources.refresh(connection)
        named = list(query.conditions("dataKey"))
        keys = self._file.keys.meeting(named[0]) if named else list(self._file.keys.entries)
        ids = "[" + ",".join(map(str, keys)) + "]"
        among = "IN (SELECT value FROM json_each(?))"
        spans = connection.execute(
            f"SELECT max(time_span), max(event_span) FROM keys WHERE id {among}",  # noqa: S608 no text of others
            (ids,),
        ).fetchone()
        time, event = map(_span, spans)
        text, parameters = query.to_sql(self._lookup, {"timestamp": time, "eventTime": event})
        # without a key no index would be used
        return (text, parameters) if named else (f"key_id {among} AND {text}", [ids, *parameters])

    def _lookup(self, condition: Condition) -> Sequence[int]:
        table = self._file.keys if condition.field == "dataKey" else self._file.sources
        return table.meeting(condition)

    def _items(self, row: tuple[Any, ...], query: ArchiveQuery) -> Iterator[Item]:
        try:
            _check_cells(row)
            if row[2] == _FRAME:
                yield from _matching(unpack(row[-1]), query)
            else:
                yield from self._single(row, query)
        except (DecodeError, InvalidKey, DamagedCell) as error:
            self._damaged_rows += 1
            if self._damaged_rows == 1:
                text = "%s: a row is damaged and left out: %s; further ones are only counted"
                log.error(text, self._url, error)  # noqa: TRY400

    def _single(self, row: tuple[Any, ...], query: ArchiveQuery) -> Iterator[Item]:
        key_id, source_id, _, sequence, time, event, payload = row
        keys, sources = self._file.keys.entries, self._file.sources.entries
        if key_id not in keys or source_id not in sources:  # pruned while reading, or unreadable
            return
        (key,), (app, instance) = keys[key_id], sources[source_id]
        item = Item(key, None, time, event, app, instance, sequence)
        if query.matches_metadata(item):
            item = Item(key, decode_value(payload), time, event, app, instance, sequence)
            if not query.uses_value or query.matches(item):
                yield item


def _head(head: tuple[Any, int]) -> tuple[int, int]:
    """A row whose time is damaged is read with the latest: reading it finds the damage."""
    time, number = head
    return (time if isinstance(time, int) else INT64 - 1), number


def _span(cell: object) -> int:
    """A damaged span keeps no row out."""
    if cell is None:
        return 0
    return cell if isinstance(cell, int) and 0 <= cell <= INT64 else INT64


def _check_cells(row: tuple[Any, ...]) -> None:
    """Raises `DamagedCell`; of a row as `_SELECT` gives it."""
    for cell in row[:-1]:
        whole_number(cell)
    if not isinstance(row[-1], bytes):
        raise DamagedCell("no payload")


@contextmanager
def _interrupted_in_time(connection: sqlite3.Connection) -> Iterator[None]:
    """Let SQLite check the time limit from time to time."""
    if time_left() is None:
        yield
        return
    connection.set_progress_handler(_late, _STEPS)
    try:
        yield
    except sqlite3.OperationalError:
        time_left()
        raise
    finally:
        connection.set_progress_handler(None, 0)


def _late() -> bool:
    try:
        time_left()
    except Timeout:
        return True
    return False


def _matching(items: list[Item], query: ArchiveQuery) -> Iterator[Item]:
    """Of one key that matches already."""
    if query.time_range is None:
        return filter(query.matches, items)
    first, last = query.time_range
    return (item for item in items if first <= item.timestamp <= last)


def _overlap(connection: sqlite3.Connection, row: _Row) -> tuple[int, int] | None:
    """First and last sequence number of a stored row that shares items with this one."""
    found = connection.execute(_OVERLAP, (row.source, row.key, row.first_sequence)).fetchone()
    whole = found is not None and all(isinstance(cell, int) for cell in found)
    return found if whole and found[0] <= row.last_sequence else None


def _delete_older(connection: sqlite3.Connection, keys: Sequence[int], before: int | None) -> int:
    for key in keys if before is not None else ():
        old = connection.execute(_OLDER, (key, before, before, _PRUNE_ROWS)).fetchall()
        if old:
            connection.executemany(_DELETE, [(number,) for number, _ in old])
            return sum(count for _, count in old)
    return 0


def _delete_oldest(connection: sqlite3.Connection, keys: Sequence[int], excess: int) -> int:
    """Delete the oldest rows that hold so many bytes together, or the most of a step."""
    deleted, ids = 0, list[tuple[int]]()
    with ExitStack() as stack:
        # closed also when deleting fails: a cursor that is read later would keep the WAL from being written again
        each = [stack.enter_context(closing(connection.execute(_OLDEST, (key,)))) for key in keys]
        for _, number, count, size in merge(*each, key=itemgetter(0)):
            if excess <= 0 or len(ids) >= _PRUNE_ROWS:
                break
            ids.append((number,))
            deleted += count
            excess -= size + _ROW_OVERHEAD
    connection.executemany(_DELETE, ids)
    return deleted


def _size(connection: sqlite3.Connection, keys: Sequence[int]) -> int:
    """Bytes of these keys' rows."""
    each = (connection.execute(_BYTES, (key,)).fetchone() for key in keys)
    return sum(int(rows * _ROW_OVERHEAD + payloads) for rows, payloads in each)


def _used(connection: sqlite3.Connection) -> int:
    """Bytes of pages in use."""
    pages, free, size = (
        connection.execute(f"PRAGMA {name}").fetchone()[0]
        for name in ("page_count", "freelist_count", "page_size")
    )
    return int((pages - free) * size)
