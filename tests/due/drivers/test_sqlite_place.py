"""A file that takes the archive's place is not mixed with what was written beside the one before."""

import errno
import fcntl
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from due.drivers import sqlite_place
from due.drivers.sqlite import SqliteArchive
from due.errors import ArchiveUnavailable
from due.messages import Item

LATE = """
import sys
from pathlib import Path
from tests.due.drivers.test_sqlite_place import items, opened
archive = opened(Path(sys.argv[1]))
archive.insert(items(300, start=1000))
print("written", flush=True)
sys.stdin.read()
archive.insert(items(1, start=3000))
archive.close()
"""

ROOT = Path(__file__).parents[3]
T0 = 1_700_000_000_000_000_000


def items(count: int, start: int = 1) -> list[Item]:
    return [Item("a.b", "x" * 500, T0 + n, T0 + n, "app", "i", n) for n in range(start, start + count)]


def opened(folder: Path) -> SqliteArchive:
    return SqliteArchive(f"sqlite://{folder}/archive.db")


def numbers(archive: SqliteArchive) -> list[int]:
    return [item.sequence for item in archive.find({})]


def copied(folder: Path) -> Path:
    """A copy of the archive as it is now, which has all in one file."""
    to = folder / "copy.db"
    with closing(sqlite3.connect(folder / "archive.db")) as source, closing(sqlite3.connect(to)) as copy:
        source.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        source.backup(copy)
    return to


def sound(folder: Path) -> list[str]:
    with closing(sqlite3.connect(folder / "archive.db")) as connection:
        return [text for (text,) in connection.execute("PRAGMA integrity_check")]


def test_what_was_written_beside_the_old_file_is_not_in_the_copy(tmp_path: Path) -> None:
    """Its operator has replaced the file and left the WAL."""
    first = opened(tmp_path)
    first.insert(items(50))
    copy = copied(tmp_path)
    first.insert(items(300, start=1000))
    copy.replace(tmp_path / "archive.db")
    fresh = opened(tmp_path)
    assert numbers(fresh) == list(range(1, 51))
    for start, each in enumerate((first, fresh)):
        each.insert(items(1, start=2000 + start))
    for each in (first, fresh):
        assert numbers(each) == [*range(1, 51), 2000, 2001]
    for each in (first, fresh):
        each.close()
    assert sound(tmp_path) == ["ok"]


def test_nor_is_what_another_process_writes_while_the_file_is_being_replaced(tmp_path: Path) -> None:
    """It opens the old file when its WAL has been moved away already, and so makes another one."""
    archive = opened(tmp_path)
    archive.insert(items(50))
    copy = copied(tmp_path)
    archive.insert(items(50, start=100))
    for end in ("-wal", "-shm"):
        (tmp_path / f"archive.db{end}").rename(tmp_path / f"old.db{end}")
    with subprocess.Popen(
        [sys.executable, "-c", LATE, str(tmp_path)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as late:
        assert late.stdin is not None
        assert late.stdout is not None
        assert late.stdout.readline() == b"written\n"
        copy.replace(tmp_path / "archive.db")
        assert numbers(archive) == list(range(1, 51))
        archive.insert(items(1, start=2000))
        late.stdin.close()
    assert late.returncode == 0
    assert numbers(archive) == [*range(1, 51), 2000, 3000]
    archive.close()
    assert sound(tmp_path) == ["ok"]


def test_a_folder_that_was_copied_while_its_archive_was_open_has_all_of_it(tmp_path: Path) -> None:
    archive = opened(tmp_path / "here")
    archive.insert(items(50))
    shutil.copytree(tmp_path / "here", tmp_path / "there")
    archive.close()
    copy = opened(tmp_path / "there")
    assert numbers(copy) == list(range(1, 51))
    copy.close()


@pytest.mark.parametrize("notes", [b"", b"\xff" * 90, b"1 2 3", b"1 2 3 4 5 6 7 8"])
def test_notes_that_cannot_be_read_are_made_anew(tmp_path: Path, notes: bytes) -> None:
    opened(tmp_path).insert(items(5))
    (tmp_path / "archive.db-place").write_bytes(notes)
    archive = opened(tmp_path)
    assert numbers(archive) == [1, 2, 3, 4, 5]
    archive.close()


def test_an_archive_is_opened_where_no_notes_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "archive.db-place").symlink_to(tmp_path / "elsewhere")
    archive = opened(tmp_path)
    archive.insert(items(5))
    assert numbers(archive) == [1, 2, 3, 4, 5]
    archive.close()
    assert not (tmp_path / "elsewhere").exists()


def test_nor_does_an_archive_need_a_file_system_with_locks_of_this_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    archive = opened(tmp_path)
    archive.insert(items(5))
    assert numbers(archive) == [1, 2, 3, 4, 5]
    archive.close()


def test_one_that_does_not_end_opening_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_place, "_WAIT_S", 0.05)
    held = os.open(tmp_path / "archive.db-place", os.O_RDWR | os.O_CREAT)
    fcntl.flock(held, fcntl.LOCK_EX)
    archive = opened(tmp_path)
    with pytest.raises(ArchiveUnavailable, match="being opened by another process"):
        archive.insert(items(1))
    os.close(held)
    archive.insert(items(1))
    assert numbers(archive) == [1]
    archive.close()
