"""Frames that a full disk does not take: kept in space allocated before, over kill -9, and archived later."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from due import Capability, Engine, Options
from due.archiver import Archiver
from due.codec import pack
from due.drivers.spool_reserve import SpoolReserve
from due.drivers.spool_slots import SlottedSpool
from due.drivers.sqlite import SqliteArchive
from due.messages import Item, PackedFrame
from tests.due.conftest import wait_for
from tests.due.drivers.conftest import Disk, fill

ROOT = Path(__file__).parents[3]
PRODUCER = """
import sys
from due import Capability, Engine, Options
engine = Engine(Options(coordinated=False, directory=sys.argv[2]))
engine.set_pubsub(sys.argv[1])
engine.set_db(sys.argv[3])
engine.init("decider", capabilities=[Capability("t.decision.decider", archive="always")])
print("ready", flush=True)
for line in sys.stdin:
    engine.write("t.decision.decider", int(line))
    engine.flush(60)
    print("kept", line, end="", flush=True)
"""


def frame(n: int, size: int = 10) -> PackedFrame:
    return pack([Item("a", b"x" * size, n, n, "app", "i", n)])


def test_what_is_flushed_on_a_full_disk_is_archived_when_there_is_room(small_disk: Disk, server) -> None:
    """The disk holds archive and spool; the process is killed while it is full, and another reads what it kept."""
    disk = small_disk(8)
    archive = f"sqlite://{disk / 'archive.db'}"
    command = [sys.executable, "-c", PRODUCER, server.url, str(disk), archive]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": ROOT}
    with subprocess.Popen(command, **pipes) as producer:  # type: ignore[call-overload]
        assert producer.stdout.readline() == "ready\n"
        producer.stdin.write("0\n")
        producer.stdin.flush()
        assert producer.stdout.readline() == "kept 0\n"
        filler = fill(disk)
        for number in range(1, 51):
            producer.stdin.write(f"{number}\n")
            producer.stdin.flush()
            assert producer.stdout.readline() == f"kept {number}\n"
        producer.kill()
    with SqliteArchiveOf(archive) as reader:
        assert len(reader.find({})) < 51, "the disk was full"
    with subprocess.Popen(command, **pipes) as again:  # type: ignore[call-overload]
        assert again.stdout.readline() == "ready\n", "it starts on a full disk, too"
        filler.unlink()
        with SqliteArchiveOf(archive) as reader:
            wait_for(lambda: [item.value for item in reader.find({})] == list(range(51)))
        again.kill()


class SqliteArchiveOf:
    """An archive that is closed at the end."""

    def __init__(self, url: str) -> None:
        self._archive = SqliteArchive(url)

    def __enter__(self) -> SqliteArchive:
        return self._archive

    def __exit__(self, *_: object) -> None:
        self._archive.close()


def test_a_reserve_keeps_whole_frames_only_and_all_of_them(tmp_path: Path) -> None:
    """Also over a restart, with a record torn by it, and used again when it is empty."""
    reserve = SpoolReserve(tmp_path / "r", 4096)
    assert reserve.put([frame(1), frame(2)])
    assert reserve.put([frame(3)])
    assert not reserve.put([frame(4, size=5000)])
    again = SpoolReserve(tmp_path / "r", 4096)
    assert again.take(2) == [frame(1), frame(2)]
    again.done(2)
    assert again.take(9) == [frame(3)]
    again.done(1)
    assert not len(again)
    assert again.put([frame(5)])
    size = len((tmp_path / "r").read_bytes().partition(bytes(8))[0])
    assert again.put([frame(6)])
    with (tmp_path / "r").open("r+b") as file:
        file.seek(size + 20)
        file.write(b"torn")
    torn = SpoolReserve(tmp_path / "r", 4096)
    assert torn.take(9) == [frame(5)]
    for each in (reserve, again, torn):
        each.close()


def test_a_reserve_that_cannot_be_emptied_on_disk_is_delivered_again_after_a_restart(tmp_path: Path) -> None:
    """A broken disk ends no thread, and no frame is lost."""
    reserve = SpoolReserve(tmp_path / "r", 4096)
    reserve.put([frame(1)])
    unwritable = os.open(tmp_path / "r", os.O_RDONLY)
    os.dup2(unwritable, reserve._file)
    os.close(unwritable)
    reserve.done(1)
    assert not len(reserve)
    reserve.close()
    again = SpoolReserve(tmp_path / "r", 4096)
    assert again.take(9) == [frame(1)]
    again.close()


@pytest.mark.parametrize("content", [b"", b"\xff" * 4096, b"\1\0\0\0" * 1024, os.urandom(4096)])
def test_a_damaged_reserve_is_an_empty_one(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "r").write_bytes(content)
    reserve = SpoolReserve(tmp_path / "r", 4096)
    assert reserve.take(9) == []
    assert reserve.put([frame(1)])
    assert reserve.take(9) == [frame(1)]
    reserve.close()


def test_a_batch_too_large_for_the_reserve_is_kept_as_far_as_it_fits(tmp_path: Path) -> None:
    """Of a backlog larger than the reserve the small frames are safe, and the rest waits."""
    full = SlottedSpool(tmp_path, 1 << 20, 4096)
    full._own.spool._disk._file.execute("PRAGMA max_page_count = 1")
    (tmp_path / "archive").write_text("no folder")
    archiver = Archiver(SqliteArchive(f"sqlite://{tmp_path}/archive/a.db"), full, batch=100)
    for n in range(1, 20):
        archiver.put(frame(n))
    archiver.flush(60)
    assert (archiver.statistics()["spooled"], archiver.statistics()["lost"]) == (19, 0)
    archiver.close()
    left = SlottedSpool(tmp_path, 1 << 20, 4096)
    assert sorted(each.sequence for each in left.take(99)) == list(range(1, 20))
    left.close()


def test_only_an_app_that_always_archives_allocates_a_reserve(tmp_path: Path, server) -> None:
    for app, archive in (("always", "always"), ("sometimes", "on_demand")):
        engine = Engine(Options(coordinated=False, directory=str(tmp_path), spool_reserve_bytes=1 << 16))
        engine.set_pubsub(server.url)
        engine.set_db(f"sqlite://{tmp_path}/archive.db")
        engine.init(app, capabilities=[Capability(f"t.reserve.{app}", archive=archive)])  # type: ignore[arg-type]
        reserve = tmp_path / "spool" / app / "spool.reserve"
        assert reserve.exists() == (app == "always")
        if app == "always":
            assert reserve.stat().st_blocks * 512 >= 1 << 16
        engine.close()
        assert not reserve.exists(), "nothing is left in it"
