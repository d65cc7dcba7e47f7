"""Which files beside an archive's file are its own: its WAL, and the index of that.

    archive.db          may be replaced by its operator while processes have it open
    archive.db-wal      what was written last; belongs to the file that had the name when it was made
    archive.db-shm      index of the WAL
    archive.db-place    which file it was: inode numbers of all three, and a lock for those who open them

SQLite finds a WAL by its name alone.  Where the file was replaced and the WAL of the one before was left, or was made
by a process that opened the old file at the last moment, SQLite would put pages of the one into the other.  A folder
that was copied as a whole has other inode numbers throughout, and is taken as it is.
"""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

from due.errors import ArchiveUnavailable

_WAIT_S: Final = 5.0
_LOOK_S: Final = 0.01
"""Between looks at the lock: one that waits inside `flock` cannot be told to give up."""
_MOST_BYTES: Final = 512

FileId = tuple[int, int]
"""Device and inode number."""
_NO_FILE: Final[FileId] = (0, 0)


class PlacedFiles(NamedTuple):
    """The files of an archive, as they were after one was opened."""

    file: FileId
    wal: FileId
    shm: FileId


class ArchivePlace:
    """The place of one archive.

    Args:
        path: its file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._beside = [path.with_name(f"{path.name}-{end}") for end in ("wal", "shm")]
        self._notes = path.with_name(f"{path.name}-place")

    def file(self) -> FileId | None:
        """Which file has the archive's name now; None: none."""
        found = _id_of(self._path)
        return None if found == _NO_FILE else found

    @contextmanager
    def opening(self) -> Iterator[None]:
        """Open the archive inside: what is left of another file is gone then, and nobody else opens it meanwhile.

        Where the notes cannot be written or locked, such as on a full disk, it is opened without.

        Raises:
            ArchiveUnavailable: another process has been opening it for seconds.
        """
        notes = self._open_notes()
        if notes is None:
            yield
            return
        try:
            self._lock(notes)
            try:
                self._remove_leftovers(_read(notes))
                yield
            finally:
                self._write(notes)
                with suppress(OSError):
                    # closing alone would leave the lock to a child that was forked meanwhile
                    fcntl.flock(notes, fcntl.LOCK_UN)
        finally:
            os.close(notes)

    def _open_notes(self) -> int | None:
        try:
            return os.open(self._notes, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except OSError:
            return None

    def _lock(self, notes: int) -> None:
        give_up = time.monotonic() + _WAIT_S
        while True:
            try:
                fcntl.flock(notes, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > give_up:
                    raise ArchiveUnavailable(
                        f"archive {self._path} is being opened by another process, which does not end"
                    ) from None
                time.sleep(_LOOK_S)
            except OSError:
                return  # a file system without such locks
            else:
                return

    def _now(self) -> PlacedFiles:
        return PlacedFiles(*map(_id_of, (self._path, *self._beside)))

    def _remove_leftovers(self, noted: PlacedFiles) -> None:
        now = self._now()
        if now.file == noted.file:
            return
        for path, was, there in zip(self._beside, noted[1:], now[1:], strict=True):
            if was == there != _NO_FILE:
                path.unlink(missing_ok=True)

    def _write(self, notes: int) -> None:
        with suppress(OSError):
            text = " ".join(f"{number:016x}" for each in self._now() for number in each)
            os.pwrite(notes, text.encode(), 0)
            archive = self._path.stat()
            if os.fstat(notes).st_uid != archive.st_uid:
                os.fchown(notes, archive.st_uid, archive.st_gid)


def _id_of(path: Path) -> FileId:
    try:
        found = path.stat()
    except FileNotFoundError:
        return _NO_FILE
    return found.st_dev, found.st_ino


def _read(notes: int) -> PlacedFiles:
    """What was noted last; nothing if that cannot be read."""
    try:
        numbers = [int(each, 16) for each in os.pread(notes, _MOST_BYTES, 0).split()]
        file, wal, shm = zip(numbers[::2], numbers[1::2], strict=True)
    except (OSError, ValueError):
        return PlacedFiles(_NO_FILE, _NO_FILE, _NO_FILE)
    return PlacedFiles(file, wal, shm)
