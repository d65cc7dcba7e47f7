"""What is put reaches the archive: at once, after it was away, through the spool, or is counted as lost."""

import threading

import msgspec
import pytest

from due.archiver import Archiver
from due.codec import pack, unpack
from due.drivers.spool import DiskSpool
from due.drivers.sqlite import SqliteArchive
from due.errors import ArchiveUnavailable, BackendError, Timeout
from due.messages import Item
from tests.due.conftest import wait_for


class Shelf:
    """An archive in memory that can be away or refuse."""

    def __init__(self) -> None:
        self.items: dict[int, Item] = {}
        self.problem = None
        self.calls = 0
        self.open = threading.Event()
        self.open.set()

    def insert_frames(self, frames):
        self.open.wait()
        self.calls += 1
        if self.problem is not None:
            raise self.problem
        for frame in frames:
            for item in unpack(frame):
                self.items[item.sequence] = item

    def insert(self, items): ...
    def find(self, query): ...
    def prune(self, *, before=None, max_bytes=None, lasting=None): ...
    def tend(self): ...
    def close(self): ...


class Bare(DiskSpool):
    """A spool alone in its folder."""

    def adopt(self):
        pass


def _frame(first: int, count: int = 10):
    return pack([Item("a.b", bytes(100), n, n, "app", "inst", n) for n in range(first, first + count)])


@pytest.fixture
def shelf():
    return Shelf()


def test_a_frame_that_no_archive_can_hold_is_counted_and_costs_no_other(tmp_path):
    archive = SqliteArchive(f"sqlite://{tmp_path / 'archive.db'}")
    archiver = Archiver(archive)
    late = msgspec.structs.replace(_frame(20), first_event_time=2**63, last_event_time=2**63)
    for frame in (_frame(0), late, _frame(40)):
        archiver.put(frame)
    archiver.flush(60)
    assert (archiver.statistics()["archived"], archiver.statistics()["refused"]) == (20, 10)
    archiver.put(_frame(60))
    archiver.flush(60)
    assert len(archive.find({})) == 30
    archiver.close()
    archive.close()


def test_flush_means_archived(shelf):
    archiver = Archiver(shelf, linger=30.0, batch=10**6)
    for first in range(0, 100, 10):
        archiver.put(_frame(first))
    archiver.flush(20)
    assert sorted(shelf.items) == list(range(100))
    assert archiver.statistics()["archived"] == 100
    archiver.close()


def test_batches_hold_at_least_so_many_items_under_load(shelf):
    shelf.open.clear()
    archiver = Archiver(shelf, batch=50, linger=0.0)
    for first in range(0, 1000, 10):
        archiver.put(_frame(first))
    shelf.open.set()
    archiver.flush(20)
    assert shelf.calls <= 22
    archiver.close()


def test_frames_go_to_the_spool_while_the_archive_is_away_and_come_back(shelf, tmp_path):
    shelf.problem = ArchiveUnavailable("away")
    archiver = Archiver(shelf, Bare(tmp_path, 1 << 20))
    for first in range(0, 200, 10):
        archiver.put(_frame(first))
    archiver.flush(20)
    assert archiver.statistics()["spooled"] == 200
    assert archiver.statistics()["backlog"] == 20
    shelf.problem = None
    wait_for(lambda: len(shelf.items) == 200)
    wait_for(lambda: archiver.backlog() == 0)
    archiver.close()


def test_the_spool_outlives_the_process(shelf, tmp_path):
    shelf.problem = ArchiveUnavailable("away")
    archiver = Archiver(shelf, Bare(tmp_path, 1 << 20))
    archiver.put(_frame(0))
    archiver.close()
    shelf.problem = None
    again = Archiver(shelf, Bare(tmp_path, 1 << 20))
    wait_for(lambda: len(shelf.items) == 10)
    again.close()


def test_what_does_not_fit_into_the_spool_is_counted(shelf, tmp_path):
    shelf.problem = ArchiveUnavailable("away")
    archiver = Archiver(shelf, Bare(tmp_path, 4000))
    for first in range(0, 100, 10):
        archiver.put(_frame(first))
    archiver.flush(20)
    counts = archiver.statistics()
    assert counts["lost"] > 0
    assert counts["lost"] + counts["spooled"] == 100
    archiver.close()


def test_what_the_archive_refuses_is_counted_and_does_not_stop_the_rest(shelf, caplog):
    shelf.problem = BackendError("never")
    archiver = Archiver(shelf)
    archiver.put(_frame(0))
    archiver.flush(20)
    shelf.problem = None
    archiver.put(_frame(10))
    archiver.flush(20)
    assert sorted(shelf.items) == list(range(10, 20))
    assert archiver.statistics()["refused"] == 10
    assert "refused 10 items of a.b" in caplog.text
    archiver.close()


def test_a_full_queue_makes_the_writer_wait(shelf):
    shelf.open.clear()
    archiver = Archiver(shelf, queue_bytes=3000)

    def write():
        for first in range(0, 100, 10):
            archiver.put(_frame(first))

    writer = threading.Thread(target=write)
    writer.start()
    wait_for(lambda: archiver.statistics()["held_back"] > 0)
    assert writer.is_alive()
    shelf.open.set()
    writer.join(20)
    archiver.flush(20)
    assert sorted(shelf.items) == list(range(100))
    archiver.close()


def test_one_bad_frame_does_not_cost_the_others_of_its_batch(shelf):
    bad = msgspec.structs.replace(_frame(10), payload=b"DUE\x01 damaged")
    archiver = Archiver(shelf, linger=30.0, batch=10**6)
    for frame in (_frame(0), bad, _frame(20)):
        archiver.put(frame)
    archiver.flush(20)
    assert sorted(shelf.items) == [*range(10), *range(20, 30)]
    assert archiver.statistics()["refused"] == 10
    archiver.put(_frame(30))
    archiver.flush(20)
    assert max(shelf.items) == 39
    archiver.close()


def _fill(spool):
    """No page more: what SQLite says then is what it says on a full disk."""
    (pages,) = spool._file.execute("PRAGMA page_count").fetchone()
    spool._file.execute(f"PRAGMA max_page_count = {pages}")


def test_frames_wait_while_a_full_disk_takes_neither_archive_nor_spool(shelf, tmp_path):
    """Archive and spool often stand on one disk; `flush` does not say that all is well meanwhile."""
    spool = Bare(tmp_path, 1 << 20)
    _fill(spool)
    shelf.problem = ArchiveUnavailable("database or disk is full")
    archiver = Archiver(shelf, spool)
    for first in range(0, 1000, 10):
        archiver.put(_frame(first))
    with pytest.raises(Timeout):
        archiver.flush(0.5)
    shelf.problem = None
    archiver.flush(60)
    wait_for(lambda: not archiver.backlog())  # a few frames may have fitted into what was left of the spool
    assert sorted(shelf.items) == list(range(1000))
    assert archiver.statistics()["lost"] == 0
    archiver.close()


def test_on_a_full_disk_writers_do_not_wait_for_ever(shelf, tmp_path):
    """What the queue cannot hold is lost and counted; what it holds is archived later."""
    spool = Bare(tmp_path, 1 << 20)
    _fill(spool)
    shelf.problem = ArchiveUnavailable("database or disk is full")
    archiver = Archiver(shelf, spool, queue_bytes=20_000)
    for first in range(0, 1000, 10):
        archiver.put(_frame(first))
    shelf.problem = None
    archiver.flush(60)
    counts = archiver.statistics()
    assert counts["lost"] > 0
    assert counts["lost"] + len(shelf.items) == 1000
    archiver.close()


def test_a_broken_spool_does_not_slow_down_the_archive(shelf, tmp_path, monkeypatch):
    """What is put goes to the archive as if there were no spool."""

    def failing(frames):
        raise BackendError("disk")

    spool = Bare(tmp_path, 1 << 20)
    spool.put([_frame(0)])
    monkeypatch.setattr(spool, "take", failing)
    archiver = Archiver(shelf, spool)
    for first in range(10, 210, 10):
        archiver.put(_frame(first))
        archiver.flush(60)
    counts = archiver.statistics()
    assert (counts["archived"], counts["spooled"], counts["away"]) == (200, 0, 0)
    archiver.close()


def test_a_broken_spool_does_not_end_the_archiver(shelf, tmp_path, monkeypatch):
    spool = Bare(tmp_path, 1 << 20)
    spool.put([_frame(0)])
    broken = [True]
    take = spool.take

    def failing(frames):
        if broken.pop():
            raise BackendError("disk")
        broken.append(False)
        return take(frames)

    monkeypatch.setattr(spool, "take", failing)
    broken[:] = [False, True]
    archiver = Archiver(shelf, spool)
    wait_for(lambda: sorted(shelf.items) == list(range(10)))
    archiver.close()
