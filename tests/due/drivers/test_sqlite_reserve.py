"""A full disk is pruned: what was kept in reserve is used for it."""

import shutil
from contextlib import closing
from pathlib import Path

import pytest

from due.drivers.sqlite import SqliteArchive
from due.errors import ArchiveUnavailable
from due.messages import Item
from tests.due.drivers.conftest import Disk, fill

SIZE = 20_000
LIMIT = 16 << 20


def write_until_full(archive: SqliteArchive, start: int) -> int:
    """Returns the first sequence number that did not fit."""
    while True:
        rows = [Item("a", bytes(SIZE), n, n, "app", "i", n) for n in range(start, start + 100)]
        try:
            archive.insert(rows)
        except ArchiveUnavailable:
            return start
        start += len(rows)


def opened(disk: Path) -> SqliteArchive:
    return SqliteArchive(f"sqlite://{disk}/archive.db")


@pytest.mark.parametrize("again", [False, True], ids=["open", "opened when full"])
def test_the_oldest_make_room_where_the_archive_fills_the_disk(small_disk: Disk, again: bool) -> None:
    disk = small_disk(150)
    archive = opened(disk)
    archive.prune(max_bytes=LIMIT)
    for _ in range(3):
        start = write_until_full(archive, 1)
        assert start > LIMIT / SIZE
        if again:
            archive.close()
            archive = opened(disk)
        assert archive.prune(max_bytes=LIMIT) > 0
        left = [item.sequence for item in archive.find({})]
        assert left == list(range(left[0], start))
        archive.insert([Item("a", 0, start, start, "app", "i", start)])
        archive.prune(before=start + 1)
    archive.close()


def test_the_oldest_make_room_where_others_fill_the_disk(small_disk: Disk) -> None:
    """Not even the WAL's first byte can be written without the reserve."""
    disk = small_disk(150)
    with closing(opened(disk)) as archive:
        archive.insert([Item("a", bytes(SIZE), n, n, "app", "i", n) for n in range(1, 2001)])
        archive.prune(max_bytes=1 << 30)
    fill(disk)
    with closing(opened(disk)) as archive:
        assert archive.prune(max_bytes=LIMIT) > 0
        archive.insert([Item("a", 0, 2001, 2001, "app", "i", 2001)])
        assert archive.find({})[-1].sequence == 2001


def test_a_disk_without_room_for_the_reserve_is_told_of_once(small_disk: Disk, caplog) -> None:
    disk = small_disk(8)
    with closing(opened(disk)) as archive:
        for _ in range(2):
            archive.prune(max_bytes=LIMIT)
        archive.insert([Item("a", 0, 1, 1, "app", "i", 1)])
    assert len([each for each in caplog.messages if "archive.db-reserve" in each]) == 1
    assert not (disk / "archive.db-reserve").exists()
    assert shutil.disk_usage(disk).free > 7 << 20
