"""One SQLite file of an archive: schema, connections, and its two small tables of texts.

keys(key), sources(app, instance)       each text once
frames(key_id, source_id, first and last of time, event time and sequence, payload)
"""

import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from due.drivers.query import ArchiveQuery
from due.drivers.query_tree import Condition
from due.drivers.sqlite_place import ArchivePlace, FileId
from due.errors import ArchiveUnavailable, BackendError, InvalidKey
from due.keys import Key
from due.messages import Item

_VERSION = 1
_DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_FULL = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN)
"""What SQLite says where the disk takes no more, of the archive or of the files beside it."""
_WAL_PAGES = 4000
WAL_BYTES: Final = 64 << 20
"""What the WAL keeps at the most; 4,000 pages are 31 MiB, and a transaction may come on top."""
_SHRINK_PAGES = 1000
_BUSY_S = 5.0
_AGAIN_S = 0.01
_LOOKUPS = 256
_COMPARE_S = 60.0
"""Seconds between a reader's checks for pruned keys and sources."""
_SCHEMA = """
PRAGMA page_size = 8192;
PRAGMA auto_vacuum = INCREMENTAL;
PRAGMA journal_mode = WAL;
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS keys(
    id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE,
    time_span INTEGER NOT NULL DEFAULT 0, event_span INTEGER NOT NULL DEFAULT 0);
CREATE TABLE IF NOT EXISTS sources(
    id INTEGER PRIMARY KEY, app TEXT NOT NULL, instance TEXT NOT NULL, UNIQUE(app, instance));
CREATE TABLE IF NOT EXISTS frames(
    id INTEGER PRIMARY KEY, key_id INTEGER NOT NULL, source_id INTEGER NOT NULL,
    format INTEGER NOT NULL, count INTEGER NOT NULL,
    first_sequence INTEGER NOT NULL, last_sequence INTEGER NOT NULL,
    first_time INTEGER NOT NULL, last_time INTEGER NOT NULL,
    first_event INTEGER NOT NULL, last_event INTEGER NOT NULL, payload BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS frames_time ON frames(key_id, first_time, last_time);
CREATE INDEX IF NOT EXISTS frames_event ON frames(key_id, first_event, last_event);
CREATE UNIQUE INDEX IF NOT EXISTS frames_item ON frames(source_id, key_id, last_sequence);
PRAGMA user_version = 1;
COMMIT;
"""


class DamagedCell(Exception):
    """A cell holds what no archive writes there, and the file's own checks let it pass."""


class ArchiveDiskFull(ArchiveUnavailable):
    """The archive's disk took no more, or cannot be used."""


# a connection inherited by fork is neither used nor closed: its locks belong to the parent
_inherited: list[sqlite3.Connection] = []


class Dictionary:
    """The ids of one small table of texts, and which of them meet a condition; read as it grows.

    Args:
        table: its name.
        used_as: the column of `frames` that refers to it.
        columns: those with the texts.
        check: raises `InvalidKey` for a first text that is damaged.
    """

    def __init__(
        self, table: str, used_as: str, *columns: str, check: Callable[[str], object] | None = None
    ) -> None:
        self._select = f"SELECT id, {', '.join(columns)} FROM {table} WHERE id > ? ORDER BY id"  # noqa: S608 our own names
        self._insert = (
            f"INSERT INTO {table}({', '.join(columns)}) VALUES({', '.join('?' * len(columns))}) RETURNING id"
        )
        same = " AND ".join(f"{column} = ?" for column in columns)
        self._known = f"SELECT id FROM {table} WHERE {same}"  # noqa: S608 our own names
        # the last id stays: reusing it would rename rows of concurrent transactions
        self._prune = (
            f"DELETE FROM {table} WHERE id < (SELECT max(id) FROM {table}) "  # noqa: S608 our own names
            f"AND NOT EXISTS (SELECT 1 FROM frames WHERE {used_as} = {table}.id)"
        )
        self._check = check
        self._lock = threading.Lock()
        self._last = 0
        self._compare_at = 0.0
        self._ids: dict[tuple[str, ...], int] = {}
        self._found: dict[Condition, tuple[int, list[int]]] = {}
        self.entries: dict[int, tuple[str, ...]] = {}
        self.unreadable: set[int] = set()
        """Ids whose texts are damaged: rows that name them are left out."""

    def refresh(self, connection: sqlite3.Connection) -> None:
        with self._lock:
            for number, *texts in connection.execute(self._select, (self._last,)):
                self._last = whole_number(number)
                try:
                    decoded = tuple(map(_decoded, texts))
                    if self._check is not None:
                        self._check(decoded[0])
                except (DamagedCell, InvalidKey):
                    self.unreadable.add(number)
                else:
                    self.entries[number] = decoded
            if time.monotonic() >= self._compare_at:
                self._compare_at = time.monotonic() + _COMPARE_S
                self._drop_pruned({whole_number(each[0]) for each in connection.execute(self._select, (0,))})

    def _drop_pruned(self, there: set[int]) -> None:
        """Forget pruned ids; another reader may see a later state of the file, so newer ids stay."""
        gone = [number for number in self.entries if number not in there and number < max(there, default=0)]
        if gone:
            self.entries = {
                number: texts for number, texts in self.entries.items() if number not in set(gone)
            }
            self._found.clear()

    def id_of(self, connection: sqlite3.Connection, *texts: str) -> int:
        """The id of these texts, added within the caller's transaction if it is new."""
        known = self._ids.get(texts)
        if known is None:
            found = connection.execute(self._known, texts).fetchone()
            found = found or connection.execute(self._insert, texts).fetchone()
            known = self._ids[texts] = whole_number(found[0])
        return known

    def forget(self) -> None:
        """Forget the ids, which hold for one transaction: others prune, and a rollback makes them void."""
        self._ids.clear()

    def prune(self, connection: sqlite3.Connection) -> int:
        """Delete texts that no row refers to; returns how many."""
        return connection.execute(self._prune).rowcount

    def meeting(self, condition: Condition) -> list[int]:
        with self._lock:
            seen, ids = self._found.get(condition, (0, []))
            if seen < self._last:
                matches = ArchiveQuery(condition).matches
                ids = ids + [n for n, texts in self.entries.items() if n > seen and matches(_named(texts))]
                if len(self._found) >= _LOOKUPS:
                    self._found.clear()
                self._found[condition] = (self._last, ids)
            return ids


def whole_number(cell: object) -> int:
    """A cell that was written as a whole number; raises `DamagedCell`."""
    if not isinstance(cell, int):
        raise DamagedCell(f"{str(cell)[:40]!r} where a whole number belongs")
    return cell


def _decoded(cell: object) -> str:
    if not isinstance(cell, bytes):
        raise DamagedCell(f"{str(cell)[:40]!r} where a text belongs")
    try:
        return cell.decode()
    except UnicodeDecodeError as error:
        raise DamagedCell(str(error)) from None


def _named(texts: tuple[str, ...]) -> Item:
    """An item with names only."""
    key, app, instance = (texts[0], "", "") if len(texts) == 1 else ("", *texts)
    return Item(key, None, 0, 0, app, instance, 0)


class SqliteFile:
    """Connections to one file: one for writing, and one for each concurrent reader."""

    def __init__(self, path: Path, synchronous: str) -> None:
        self._path = path
        self._place = ArchivePlace(path)
        self._synchronous = synchronous
        self._closed = False
        self._written: sqlite3.Connection | None = None
        """The connection whose transaction runs now; its thread closes it if it was released meanwhile."""
        self._born()

    def _born(self) -> None:
        self._pid = os.getpid()
        self._lock = threading.RLock()
        """Guards which connections there are, not what is done with them."""
        self._reset()

    def _reset(self) -> None:
        self._file: FileId | None = None
        self._writer: sqlite3.Connection | None = None
        self._idle: deque[sqlite3.Connection] = deque()
        self.keys = Dictionary("keys", "key_id", "key", check=Key.parse)
        self.sources = Dictionary("sources", "source_id", "app", "instance")
        self.spans: dict[int, tuple[int, int]] = {}

    @contextmanager
    def _entered(self) -> Iterator[None]:
        """Hold the lock; what connections there are belong to the file that has the archive's name now."""
        if self._pid != os.getpid():
            _inherited.extend(self._idle)
            if self._writer is not None:
                _inherited.append(self._writer)
            self._born()
        with self._lock:
            if self._closed:
                raise BackendError(f"archive {self._path} is closed")
            if self._file is not None and self._file != self._place.file():
                # moved away or replaced: what is written into the old file would be in no archive
                self._let_go()
            yield

    def tend(self) -> None:
        """See `ArchiveDriver.tend`."""
        with self._errors(), self._entered():
            pass

    def _check_place(self, written: sqlite3.Connection) -> None:
        """Raises `ArchiveUnavailable` if the file was moved while it was written; what is repeated is known by its numbers."""
        with self._lock:
            if self._file is not None and self._file != self._place.file():
                self._let_go()
            # it may have been let go by another thread
            if self._writer is not written and not self._closed:
                raise ArchiveUnavailable(
                    f"archive {self._path} was moved away or replaced while it was written"
                )

    def _connect(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._place.opening():
            if (before := self._place.file()) is None:
                # SQLite gives the files beside it the same mode, and tells what is wrong where it cannot be made
                with suppress(OSError):
                    os.close(os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o600))
            connection = sqlite3.connect(
                self._path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False
            )
            # decoded by us, cell by cell: one that is no UTF-8 would fail the whole query
            connection.text_factory = bytes
            try:
                self._prepare(connection)
            except BaseException:
                connection.close()
                raise
            self._file = self._file or before or self._place.file()
        return connection

    def _prepare(self, connection: sqlite3.Connection) -> None:
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version > _VERSION:
            raise BackendError(f"archive {self._path} is of a newer version ({version}); update SDNator")
        if version < _VERSION:
            _make_tables(connection)
        connection.execute(f"PRAGMA synchronous = {self._synchronous}")
        connection.execute(f"PRAGMA wal_autocheckpoint = {_WAL_PAGES}")
        connection.execute(f"PRAGMA journal_size_limit = {WAL_BYTES}")

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction: committed at the end, rolled back on any error."""
        with self._errors(), self._writer_in_use() as connection:
            try:
                connection.execute("BEGIN IMMEDIATE")
                self.keys.forget()
                self.sources.forget()
                yield connection
                connection.execute("COMMIT")
                self._check_place(connection)
            except BaseException:
                self.spans.clear()
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise

    @contextmanager
    def _writer_in_use(self) -> Iterator[sqlite3.Connection]:
        with self._entered():
            connection = self._written = self._writer
        try:
            if connection is None:
                connection = self._connect()
                with self._lock:
                    self._written = connection
                    # of a file that was closed meanwhile nobody would close it
                    self._writer = None if self._closed else connection
            yield connection
        finally:
            with self._lock:
                self._written = None
                released = connection is not self._writer
            if connection is not None and released:
                connection.close()

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """One snapshot of the file: no row appears whose key or source was not known before."""
        with self._errors():
            with self._entered():
                idle = self._idle
                connection = idle.pop() if idle else None
            if connection is None:
                connection = self._connect()
            try:
                connection.execute("BEGIN")
                yield connection
            finally:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                with self._lock:
                    released = idle is not self._idle
                    if not released:
                        idle.append(connection)
                if released:
                    connection.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF in _FULL:
                raise ArchiveDiskFull(f"archive {self._path}: {error}") from error
            raise ArchiveUnavailable(f"archive {self._path}: {error}") from error
        except sqlite3.Error as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF in _DAMAGED:
                raise self._damaged(error) from error
            raise BackendError(f"archive {self._path}: {error}; is it an archive of SDNator?") from error
        except (DamagedCell, UnicodeDecodeError) as error:
            # the latter: what SQLite says of a damaged schema may itself be no text
            raise self._damaged(error) from error
        except OSError as error:
            raise ArchiveUnavailable(f"archive {self._path}: {error}") from error
        except (OverflowError, UnicodeEncodeError) as error:
            raise BackendError(
                f"archive {self._path}: a number or text that it cannot hold: {error}"
            ) from error

    def _damaged(self, error: Exception) -> ArchiveUnavailable:
        self._let_go()
        return ArchiveUnavailable(
            f"archive {self._path} is damaged or not an archive ({error}): move it away, or put a copy there; "
            f"until then items wait in the spool"
        )

    def _let_go(self) -> None:
        """Drop connections to a damaged or moved file; the next call reopens it.  What runs closes its own.

        Left to the garbage collector they would keep the old file's space taken.
        """
        with self._lock:
            self._disconnect()
            self._reset()

    def _disconnect(self) -> None:
        for connection in self._idle:
            connection.close()
        if self._writer is not None and self._writer is not self._written:
            self._writer.close()
        self._idle, self._writer = deque(), None

    def checkpoint(self) -> None:
        """Bring what is in the WAL into the file, so that the WAL's own space can be written again."""
        with self._errors(), self._writer_in_use() as connection:
            connection.execute("PRAGMA wal_checkpoint(RESTART)").fetchall()

    def shrink(self) -> None:
        """Return free pages to the file system, some at a time: each page that moves takes room in the WAL first."""
        with self._errors(), self._writer_in_use() as connection:
            free = connection.execute("PRAGMA freelist_count").fetchone()[0]
            for _ in range(0, free, _SHRINK_PAGES):
                # not `execute`: it would free a single page only
                connection.executescript(
                    f"PRAGMA incremental_vacuum({_SHRINK_PAGES}); PRAGMA wal_checkpoint(PASSIVE);"
                )

    def close(self) -> None:
        """Close all connections; what runs closes its own."""
        if self._pid != os.getpid():
            self._closed = True
            return
        with self._lock:
            self._closed = True
            self._disconnect()


def _make_tables(connection: sqlite3.Connection) -> None:
    """Raises `sqlite3.OperationalError` when the file is locked for long."""
    give_up = time.monotonic() + 2 * _BUSY_S
    while True:
        try:
            connection.executescript(_SCHEMA)
        except sqlite3.OperationalError as error:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            # two processes that change a new file's journal mode at once block each other until one gives up
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > give_up:
                raise
            time.sleep(_AGAIN_S)
        else:
            return
