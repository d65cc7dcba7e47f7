"""A bounded queue of frames on disk while the archive is away: one SQLite file, first in first out."""

import logging
import sqlite3
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from due.errors import BackendError
from due.messages import PackedFrame

log = logging.getLogger("due.spool")

_SCHEMA = """
PRAGMA journal_mode = WAL;
CREATE TABLE IF NOT EXISTS frames(id INTEGER PRIMARY KEY AUTOINCREMENT, size INTEGER NOT NULL, data BLOB NOT NULL);
"""
_RECORD_OVERHEAD = 64
_DAMAGED_KEPT = 3


class DiskSpool:
    """A spool in `folder`/`name`.db, of at most about `limit` bytes; raises BackendError if it cannot be opened.

    Survives kill -9 of its process.  A damaged
    file is set aside under another name (the last three are kept) and an empty one takes its place; where none can
    be created, as on a full disk, the next `put` or `take` tries again.
    """

    def __init__(self, folder: Path, limit: int, name: str = "spool") -> None:
        self.path = folder / f"{name}.db"
        self._limit = limit
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(PackedFrame).decode
        self._closed = False
        self._count = self._bytes = 0
        self.set_aside = 0
        """Damaged files so far."""
        self._dropped = 0
        self._missing = True
        """There is no file: not yet, or a damaged one could not be replaced."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._open()
        except (OSError, sqlite3.Error) as error:
            raise BackendError(f"spool {self.path} cannot be opened: {error}; name another folder") from error

    def _open(self) -> None:
        """Open the file, unless it is; raises `sqlite3.Error` or `OSError`."""
        if not self._missing:
            return
        try:
            self._file = self._opened()
        except sqlite3.DatabaseError as error:
            if not _is_damage(error):
                raise
            self._set_aside(error)

    def _opened(self) -> sqlite3.Connection:
        file = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
        try:
            file.executescript(_SCHEMA)
            file.execute("PRAGMA synchronous = NORMAL")
            count, size = file.execute("SELECT count(*), total(size) FROM frames").fetchone()
        except UnicodeDecodeError as error:
            file.close()
            raise _damaged(error) from error
        except BaseException:
            file.close()
            raise
        self._count, self._bytes = int(count), int(size)
        self._missing = False
        return file

    def _set_aside(self, error: sqlite3.Error) -> None:
        """Continue with an empty file; raises `sqlite3.Error` or `OSError` if none can be created."""
        lost = self._count
        aside = self.path.with_suffix(f".damaged-{time.time_ns()}")
        self.path.with_suffix(".db-shm").unlink(missing_ok=True)
        with suppress(FileNotFoundError):
            self.path.with_suffix(".db-wal").rename(f"{aside}-wal")
        self.path.rename(aside)
        self._count = self._bytes = 0  # not before: a spool that is empty is deleted
        former = sorted(self.path.parent.glob(f"{self.path.stem}.damaged-*[0-9]"))
        for path in former[:-_DAMAGED_KEPT]:
            path.unlink(missing_ok=True)
            Path(f"{path}-wal").unlink(missing_ok=True)
        log.error(
            "spool %s is damaged (%s): %s frames in it stay in %s for manual repair; an empty spool replaces it",
            self.path,
            error,
            lost or "the",
            aside,
        )
        self.set_aside += 1
        self._file = self._opened()

    def _failed(self, error: OSError | sqlite3.Error) -> bool:
        """Handle an error; True if a damaged file was replaced by an empty one."""
        if isinstance(error, OSError) or not _is_damage(error):
            return False
        self._file.close()
        self._missing = True
        try:
            self._set_aside(error)
        except (OSError, sqlite3.Error) as again:
            log.error("spool %s: %s", self.path, again)  # noqa: TRY400 - no trace needed
            return False
        return True

    def put(self, frames: Sequence[PackedFrame]) -> int:
        """Append frames; returns how many items did not fit and are lost.  See `Spool.put`."""
        try:
            self._open()
            rows = self._fitting(frames)
            self._append(rows)
        except (OSError, sqlite3.Error) as error:
            if self._failed(error):
                return self.put(frames)
            raise BackendError(
                f"spool {self.path} cannot be written: {error}; make room on its disk"
            ) from error
        return sum(frame.count for frame in frames[len(rows) :])

    def _fitting(self, frames: Sequence[PackedFrame]) -> list[tuple[int, bytes]]:
        rows, space = [], self._limit - self._bytes
        for frame in frames:
            data = self._encode(frame)
            size = len(data) + _RECORD_OVERHEAD
            if size > space:
                break
            space -= size
            rows.append((size, data))
        return rows

    def take(self, frames: int) -> list[PackedFrame]:
        """Up to `frames` of the oldest frames, which stay until `done`; damaged records are dropped."""
        try:
            self._open()
            rows = self._rows("SELECT id, data FROM frames ORDER BY id LIMIT ?", frames)
        except (OSError, sqlite3.Error) as error:
            if self._failed(error):
                return []
            raise BackendError(f"spool {self.path}: {error}") from error
        return [frame for number, data in rows if (frame := self._read(number, data)) is not None]

    def done(self, frames: int) -> None:
        """Remove that many of the oldest frames."""
        self._remove("id IN (SELECT id FROM frames ORDER BY id LIMIT ?)", frames)

    def __len__(self) -> int:
        return self._count

    @property
    def damaged(self) -> int:
        """See `Spool.damaged`."""
        return self.set_aside + self._dropped

    def close(self) -> None:
        """Close the file; what is in it stays for the next start."""
        if not self._closed:
            self._closed = True
            self._file.close()

    def _read(self, number: int, data: bytes) -> PackedFrame | None:
        try:
            return self._decode(data)
        except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
            log.error("spool %s: record %d is damaged and dropped: %s", self.path, number, error)  # noqa: TRY400
            self._dropped += 1
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
        if self._missing:
            return
        try:
            removed = self._rows(f"DELETE FROM frames WHERE {which} RETURNING size", number)  # noqa: S608 our own text
        except sqlite3.Error as error:
            if self._failed(error):
                return
            raise BackendError(f"spool {self.path}: {error}") from error
        self._count -= len(removed)
        self._bytes -= sum(size for (size,) in removed if isinstance(size, int))

    def _rows(self, statement: str, number: int) -> list[Any]:
        try:
            return self._file.execute(statement, (number,)).fetchall()
        except UnicodeDecodeError as error:
            raise _damaged(error) from error


def _damaged(error: UnicodeDecodeError) -> sqlite3.DatabaseError:
    """What sqlite3 says of a damaged schema may itself be no text, and then that is all that comes out."""
    made = sqlite3.DatabaseError(f"the file is damaged: {error}")
    made.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
    return made


def _is_damage(error: sqlite3.Error) -> bool:
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
