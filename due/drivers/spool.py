"""A bounded queue of frames on disk, for while the archive is away: one SQLite file, first in first out."""

import logging
import sqlite3
from collections.abc import Sequence
from pathlib import Path

import msgspec

from due.errors import BackendError
from due.messages import PackedFrame

log = logging.getLogger("due.spool")

_SCHEMA = """
PRAGMA journal_mode = WAL;
CREATE TABLE IF NOT EXISTS frames(id INTEGER PRIMARY KEY AUTOINCREMENT, size INTEGER NOT NULL, data BLOB NOT NULL);
"""
_RECORD_OVERHEAD = 64


class DiskSpool:
    """A spool in `folder`/`name`.db, of at most about `limit` bytes; raises BackendError if it cannot be opened.

    Survives kill -9 of its process.  What a full or broken disk does not take counts as not fitting.
    """

    def __init__(self, folder: Path, limit: int, name: str = "spool") -> None:
        self.path = folder / f"{name}.db"
        self._limit = limit
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(PackedFrame).decode
        self._closed = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
            self._file.executescript(_SCHEMA)
            self._file.execute("PRAGMA synchronous = NORMAL")
            self._count, self._bytes = self._measure()
        except (OSError, sqlite3.Error) as error:
            raise BackendError(f"spool {self.path} cannot be opened: {error}; name another folder") from error

    def put(self, frames: Sequence[PackedFrame]) -> int:
        """Append frames; returns how many items did not fit and are lost."""
        rows, space = [], self._limit - self._bytes
        for frame in frames:
            data = self._encode(frame)
            size = len(data) + _RECORD_OVERHEAD
            if size > space:
                break
            space -= size
            rows.append((size, data))
        try:
            self._append(rows)
        except sqlite3.Error as error:
            log.warning("spool %s: %s", self.path, error)
            rows = []
        return sum(frame.count for frame in frames[len(rows) :])

    def take(self, frames: int) -> list[PackedFrame]:
        """Up to `frames` of the oldest frames, which stay until `done`; damaged records are dropped."""
        try:
            rows = self._file.execute("SELECT id, data FROM frames ORDER BY id LIMIT ?", (frames,)).fetchall()
        except sqlite3.Error as error:
            raise BackendError(f"spool {self.path}: {error}") from error
        return [frame for number, data in rows if (frame := self._read(number, data)) is not None]

    def done(self, frames: int) -> None:
        """Remove that many of the oldest frames."""
        self._remove("id IN (SELECT id FROM frames ORDER BY id LIMIT ?)", frames)

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Close the file; what is in it stays for the next start."""
        if not self._closed:
            self._closed = True
            self._file.close()

    def _read(self, number: int, data: bytes) -> PackedFrame | None:
        try:
            return self._decode(data)
        except msgspec.MsgspecError as error:
            log.error("spool %s: record %d is damaged and dropped: %s", self.path, number, error)  # noqa: TRY400
            self._remove("id = ?", number)
            return None

    def _append(self, rows: Sequence[tuple[int, bytes]]) -> None:
        self._file.execute("BEGIN IMMEDIATE")
        try:
            self._file.executemany("INSERT INTO frames(size, data) VALUES(?, ?)", rows)
            self._file.execute("COMMIT")
        except sqlite3.Error:
            if self._file.in_transaction:
                self._file.execute("ROLLBACK")
            raise
        self._count += len(rows)
        self._bytes += sum(size for size, _ in rows)

    def _remove(self, which: str, number: int) -> None:
        try:
            removed = self._file.execute(
                f"DELETE FROM frames WHERE {which} RETURNING size",  # noqa: S608 our own text
                (number,),
            ).fetchall()
        except sqlite3.Error as error:
            raise BackendError(f"spool {self.path}: {error}") from error
        self._count -= len(removed)
        self._bytes -= sum(size for (size,) in removed)

    def _measure(self) -> tuple[int, int]:
        count, size = self._file.execute("SELECT count(*), total(size) FROM frames").fetchone()
        return int(count), int(size)
