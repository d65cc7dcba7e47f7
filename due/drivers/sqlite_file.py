"""One SQLite file of an archive: schema, connections, and its two small tables of texts.

keys(key), sources(app, instance)       each text once
frames(key_id, source_id, first and last of time, event time and sequence, payload)
"""

import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from due.drivers.query import Query
from due.drivers.query_tree import Condition
from due.errors import ArchiveUnavailable, BackendError
from due.messages import Item

_VERSION = 1
_BUSY_S = 5.0
_AGAIN_S = 0.01
_LOOKUPS = 256
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

# a connection that came through a fork is neither used nor closed: its locks are the parent's
_inherited: list[sqlite3.Connection] = []


class Dictionary:
    """The ids of one small table of texts, and which of them meet a condition; read as it grows."""

    def __init__(self, table: str, *columns: str) -> None:
        self._select = f"SELECT id, {', '.join(columns)} FROM {table} WHERE id > ? ORDER BY id"  # noqa: S608 our own names
        self._insert = (
            f"INSERT INTO {table}({', '.join(columns)}) VALUES({', '.join('?' * len(columns))}) "
            f"ON CONFLICT DO UPDATE SET id = id RETURNING id"
        )
        self._lock = threading.Lock()
        self._last = 0
        self._ids: dict[tuple[str, ...], int] = {}
        self._found: dict[Condition, tuple[int, list[int]]] = {}
        self.entries: dict[int, tuple[str, ...]] = {}

    def refresh(self, connection: sqlite3.Connection) -> None:
        with self._lock:
            for number, *texts in connection.execute(self._select, (self._last,)):
                self.entries[number] = tuple(texts)
                self._last = number

    def id_of(self, connection: sqlite3.Connection, *texts: str) -> int:
        """The id, made if need be within the caller's transaction."""
        known = self._ids.get(texts)
        if known is None:
            known = self._ids[texts] = int(connection.execute(self._insert, texts).fetchone()[0])
        return known

    def forget(self) -> None:
        """Ids made in a transaction that was rolled back are void."""
        self._ids.clear()

    def meeting(self, condition: Condition) -> list[int]:
        with self._lock:
            seen, ids = self._found.get(condition, (0, []))
            if seen < self._last:
                matches = Query(condition).matches
                ids = ids + [n for n, texts in self.entries.items() if n > seen and matches(_named(texts))]
                if len(self._found) >= _LOOKUPS:
                    self._found.clear()
                self._found[condition] = (self._last, ids)
            return ids


def _named(texts: tuple[str, ...]) -> Item:
    """An item of which only the names count."""
    key, app, instance = (texts[0], "", "") if len(texts) == 1 else ("", *texts)
    return Item(key, None, 0, 0, app, instance, 0)


class SqliteFile:
    """Connections to one file: one that writes, and as many that read as there are readers."""

    def __init__(self, path: Path, synchronous: str) -> None:
        self._path = path
        self._synchronous = synchronous
        self._closed = False
        self._reset()

    def _reset(self) -> None:
        self._pid = os.getpid()
        self._writer: sqlite3.Connection | None = None
        self._idle: deque[sqlite3.Connection] = deque()
        self.keys = Dictionary("keys", "key")
        self.sources = Dictionary("sources", "app", "instance")
        self.spans: dict[int, tuple[int, int]] = {}

    def _enter(self) -> None:
        if self._closed:
            raise BackendError(f"archive {self._path} is closed")
        if self._pid != os.getpid():
            _inherited.extend(self._idle)
            if self._writer is not None:
                _inherited.append(self._writer)
            self._reset()

    def _connect(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        connection = sqlite3.connect(
            self._path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False
        )
        try:
            self._prepare(connection)
        except BaseException:
            connection.close()
            raise
        return connection

    def _prepare(self, connection: sqlite3.Connection) -> None:
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version > _VERSION:
            raise BackendError(f"archive {self._path} is of a newer version ({version}); update SDNator")
        if version < _VERSION:
            _make_tables(connection)
        connection.execute(f"PRAGMA synchronous = {self._synchronous}")
        connection.execute("PRAGMA wal_autocheckpoint = 4000")

    @contextmanager
    def writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction: committed at the end, rolled back on any error."""
        with self._errors():
            self._enter()
            if self._writer is None:
                self._writer = self._connect()
            connection = self._writer
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                self.keys.forget()
                self.sources.forget()
                self.spans.clear()
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """One view of the file: no row of others comes in whose key or source was not there a moment before."""
        with self._errors():
            self._enter()
            try:
                connection = self._idle.pop()
            except IndexError:
                connection = self._connect()
            try:
                connection.execute("BEGIN")
                yield connection
            finally:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                if self._closed:
                    connection.close()
                else:
                    self._idle.append(connection)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise ArchiveUnavailable(f"archive {self._path}: {error}") from error
        except sqlite3.Error as error:
            raise BackendError(f"archive {self._path}: {error}; is it an archive of SDNator?") from error
        except OSError as error:
            raise ArchiveUnavailable(f"archive {self._path}: {error}") from error

    def shrink(self) -> None:
        """Give pages that deletions left free back to the file system."""
        with self._errors():
            self._enter()
            if self._writer is not None:
                # not `execute`: it would take a single step, which frees a single page
                self._writer.executescript("PRAGMA incremental_vacuum; PRAGMA wal_checkpoint(PASSIVE);")

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if self._pid == os.getpid():
            for connection in (*self._idle, *((self._writer,) if self._writer else ())):
                connection.close()
            self._idle.clear()


def _make_tables(connection: sqlite3.Connection) -> None:
    """Raises `sqlite3.OperationalError` when the file is locked for long."""
    give_up = time.monotonic() + 2 * _BUSY_S
    while True:
        try:
            connection.executescript(_SCHEMA)
        except sqlite3.OperationalError as error:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            # two that change a new file's journal mode at once are in each other's way until one lets go
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > give_up:
                raise
            time.sleep(_AGAIN_S)
        else:
            return
