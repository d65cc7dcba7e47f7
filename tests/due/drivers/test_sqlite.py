"""The file archive: many processes at a time, index use, honest errors, nothing left open over a fork."""

import gc
import multiprocessing
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from due.archiver import Archiver
from due.codec import pack
from due.drivers import sqlite_file
from due.drivers.query import parse
from due.drivers.spool_slots import SlottedSpool
from due.drivers.sqlite import SqliteArchive
from due.errors import ArchiveUnavailable, BackendError, InvalidOption
from due.messages import Item
from tests.due.conftest import wait_for

T0 = 1_700_000_000_000_000_000
ROOT = Path(__file__).parents[3]


def items(
    count: int, *, key: str = "a.b", start: int = 1, instance: str = "i", step: int = 1000
) -> list[Item]:
    return [
        Item(key, n, T0 + n * step, T0 + n * step, "app", instance, n) for n in range(start, start + count)
    ]


def opened(folder: Path) -> SqliteArchive:
    return SqliteArchive(f"sqlite://{folder}/archive.db")


@pytest.mark.parametrize(
    "url",
    ["sqlite:archive", "sqlite://", "sqlite://host/archive.db", "mysql:///a.db", "sqlite:///a.db?synchronous=off",
     "sqlite:///a.db?cache=1"],
)  # fmt: skip
def test_wrong_urls_are_refused(url: str) -> None:
    with pytest.raises(InvalidOption, match="sqlite"):
        SqliteArchive(url)


def test_nothing_is_opened_before_the_first_call(tmp_path: Path) -> None:
    archive = opened(tmp_path / "not yet")
    assert not (tmp_path / "not yet").exists()
    archive.insert(items(1))
    archive.close()
    assert (tmp_path / "not yet" / "archive.db").exists()


def test_full_synchronisation_is_an_option(tmp_path: Path) -> None:
    archive = SqliteArchive(f"sqlite://{tmp_path}/archive.db?synchronous=full")
    archive.insert(items(1))
    assert len(archive.find({})) == 1
    archive.close()


def test_many_processes_write_and_read_one_file(tmp_path: Path) -> None:
    program = """
import sys
from pathlib import Path
from tests.due.drivers.test_sqlite import items, opened
from due.codec import pack
archive = opened(Path(sys.argv[1]))
for start in range(1, 501, 50):
    archive.insert_frames([pack(items(50, key=f"a.{sys.argv[2]}", start=start, instance=sys.argv[2]))])
    archive.insert(items(1, key="shared", start=start))
    assert len(archive.find({"dataKey": f"a.{sys.argv[2]}"})) == start + 49
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    writers = [
        subprocess.Popen([sys.executable, "-c", program, str(tmp_path), f"w{n}"], env=environment)
        for n in range(4)
    ]
    assert [writer.wait(120) for writer in writers] == [0] * 4
    archive = opened(tmp_path)
    assert len(archive.find({"dataKey": "a.*"})) == 2000
    assert len(archive.find({"dataKey": "shared"})) == 10, "the same items from four writers"
    archive.close()


def test_a_reader_sees_keys_that_others_add_later(tmp_path: Path) -> None:
    reader, writer = opened(tmp_path), opened(tmp_path)
    assert reader.find({"dataKey": "a.*"}) == []
    for n, key in enumerate(("a.x", "a.y", "b.z"), 1):
        writer.insert(items(1, key=key))
        assert len(reader.find({"dataKey": "a.*"})) == min(n, 2)
        assert len(reader.find({"dataKey": {"$nin": ["b.*"]}})) == min(n, 2)
    reader.close()
    writer.close()


def test_a_source_that_comes_while_one_searches_is_found_the_next_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = opened(tmp_path), opened(tmp_path)
    writer.insert(items(1))
    refresh = sqlite_file.Dictionary.refresh

    def meanwhile(table: sqlite_file.Dictionary, connection: sqlite3.Connection) -> None:
        refresh(table, connection)
        if table is reader._file.sources:
            writer.insert(items(1, start=2, instance="another"))

    with monkeypatch.context() as patch:
        patch.setattr(sqlite_file.Dictionary, "refresh", meanwhile)
        assert [i.sequence for i in reader.find({"dataKey": "a.b"})] == [1]
    assert [i.sequence for i in reader.find({"dataKey": "a.b"})] == [1, 2]
    reader.close()
    writer.close()


def test_two_that_make_the_file_wait_for_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = sqlite3.connect(tmp_path / "archive.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    waited = []

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        other.close()

    monkeypatch.setattr(sqlite_file, "_BUSY_S", 0.05)
    monkeypatch.setattr(sqlite_file, "time", SimpleNamespace(monotonic=lambda: 0.0, sleep=sleep))
    archive = opened(tmp_path)
    archive.insert(items(1))
    assert len(waited) == 1
    assert len(archive.find({})) == 1
    archive.close()


def _read_in_child(archive: SqliteArchive, result: "multiprocessing.Queue[int]") -> None:
    archive.insert(items(1, key="child"))
    result.put(len(archive.find({})))
    archive.close()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_opens_its_own(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    archive.insert(items(3))
    assert len(archive.find({})) == 3
    context = multiprocessing.get_context("fork")
    result = context.Queue()
    child = context.Process(target=_read_in_child, args=(archive, result))
    child.start()
    assert result.get(timeout=60) == 4
    child.join(60)
    archive.insert(items(1, key="parent"))
    assert len(archive.find({})) == 5
    archive.close()


def test_a_range_query_uses_the_index_for_frames_and_items(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    archive.insert_frames([pack(items(100, start=start, key="framed")) for start in range(1, 5001, 100)])
    archive.insert(items(5000, key="single"))
    file = sqlite3.connect(tmp_path / "archive.db")
    for key in ("framed", "single"):
        query = {"dataKey": key, "timestamp": {"$gte": T0 + 2_000_000, "$lt": T0 + 2_100_000}}
        assert [i.value for i in archive.find(query)] == list(range(2000, 2100))
    for field, index in (("timestamp", "frames_time"), ("eventTime", "frames_event")):
        parsed = parse({"dataKey": "framed", field: {"$gte": T0, "$lt": T0 + 100}})
        text, parameters = parsed.to_sql(lambda _: [1], {"timestamp": 100, "eventTime": 100})
        explain = "EXPLAIN QUERY PLAN SELECT payload FROM frames WHERE " + text  # noqa: S608 our own
        plan = file.execute(explain, parameters).fetchall()
        assert any(index in step[3] for step in plan), plan
        assert all("SCAN frames" not in step[3] for step in plan), plan
    file.close()
    archive.close()


def test_frames_of_any_length_in_time_are_found(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    long = [Item("a.b", n, T0 + n * 10**9, T0 - n * 10**9, "app", "i", n) for n in range(1, 101)]
    archive.insert_frames([pack(items(10, key="a.c")), pack(long)])
    reader = opened(tmp_path)
    for first in (1, 50, 100):
        found = reader.find({"dataKey": "a.*", "timestamp": {"$gte": T0 + first * 10**9}})
        assert [i.value for i in found] == list(range(first, 101))
        found = reader.find({"eventTime": {"$lte": T0 - first * 10**9}})
        assert [i.value for i in found] == list(range(first, 101))
    reader.close()
    archive.close()


def test_a_locked_file_is_unavailable_and_works_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_file, "_BUSY_S", 0.05)
    archive = opened(tmp_path)
    archive.insert(items(1))
    other = sqlite3.connect(tmp_path / "archive.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(ArchiveUnavailable, match="locked"):
        archive.insert(items(1, key="new.key", start=2))
    assert len(archive.find({})) == 1, "readers are not held up"
    other.execute("COMMIT")
    other.close()
    archive.insert(items(1, key="new.key", start=2))
    assert len(archive.find({"dataKey": "new.key"})) == 1
    archive.close()


def test_a_folder_that_cannot_be_made_is_unavailable(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ArchiveUnavailable, match="file"):
        opened(tmp_path / "file").find({})


def test_a_damaged_file_is_unavailable_until_it_is_moved_away(tmp_path: Path) -> None:
    (tmp_path / "archive.db").write_bytes(b"no database at all" * 1000)
    archive = opened(tmp_path)
    for call in (lambda: archive.insert(items(1)), lambda: archive.find({})):
        with pytest.raises(ArchiveUnavailable, match=r"damaged.*move it away"):
            call()
    (tmp_path / "archive.db").rename(tmp_path / "damaged.db")
    archive.insert(items(1))
    assert len(archive.find({})) == 1
    archive.close()


@pytest.mark.parametrize("instead", [False, True], ids=["nothing", "a_copy"])
def test_a_file_that_is_moved_away_is_written_no_more(tmp_path: Path, *, instead: bool) -> None:
    """Damage that no statement meets, or a copy put there by hand: what is archived goes where the name is."""
    archive, reader = opened(tmp_path), opened(tmp_path)
    archive.insert(items(2))
    assert len(reader.find({})) == 2
    if instead:
        copy = sqlite3.connect(tmp_path / "copy.db")
        with sqlite3.connect(tmp_path / "archive.db") as source:
            source.backup(copy)
        copy.close()
    archive.insert(items(1, start=3))
    for end in ("-wal", "-shm", ""):
        (tmp_path / f"archive.db{end}").rename(tmp_path / f"old.db{end}")
    if instead:
        (tmp_path / "copy.db").rename(tmp_path / "archive.db")
    archive.insert(items(1, start=4))
    numbers = [1, 2, 4] if instead else [4]
    for each in (archive, reader, opened(tmp_path)):
        assert [item.sequence for item in each.find({})] == numbers
        each.close()
    (tmp_path / "folder").mkdir()
    for end in ("-wal", "-shm", ""):
        if (old := tmp_path / f"old.db{end}").exists():
            old.rename(tmp_path / "folder" / f"archive.db{end}")
    old = opened(tmp_path / "folder")
    assert [item.sequence for item in old.find({})] == [1, 2, 3], "what stood there stays readable"
    old.close()


@pytest.mark.parametrize("idle", [False, True])
def test_a_file_that_was_replaced_takes_no_space(tmp_path: Path, idle: bool) -> None:
    """Nobody waits for the garbage collector, which may come late or never; nor for a call that needs the archive."""
    archive = opened(tmp_path)
    gc.disable()
    try:
        for start in (1, 2, 3):
            archive.insert(items(1, start=start))
            assert archive.find({})
            shutil.copyfile(tmp_path / "archive.db", tmp_path / "copy.db")
            for end in ("-wal", "-shm"):
                (tmp_path / f"archive.db{end}").unlink(missing_ok=True)
            (tmp_path / "copy.db").replace(tmp_path / "archive.db")
            if idle:
                archive.tend()
            else:
                archive.insert(items(1, start=start + 20))
            held = [str(each.readlink()) for each in Path("/proc/self/fd").iterdir() if each.is_symlink()]
            assert [each for each in held if str(tmp_path) in each and "deleted" in each] == []
    finally:
        gc.enable()
    archive.close()


def test_what_runs_is_not_taken_from_under_it(tmp_path: Path) -> None:
    """A file that is replaced is let go while others read and write it; they end as if it was not."""
    archive, stop = opened(tmp_path), threading.Event()

    def again(call: Callable[[], object]) -> int:
        answered = 0
        while not stop.is_set():
            with suppress(ArchiveUnavailable):  # moved while it was opened
                call()
                answered += 1
        return answered

    with ThreadPoolExecutor(3) as threads:
        calls = (archive.tend, lambda: archive.find({}), lambda: archive.find({}))
        answered = [threads.submit(again, call) for call in calls]
        for start in range(1, 200):
            with suppress(ArchiveUnavailable):
                archive.insert(items(1, start=start))
            if start % 5 == 0:
                for end in ("-wal", "-shm", ""):
                    (tmp_path / f"archive.db{end}").unlink(missing_ok=True)
        stop.set()
    archive.close()
    assert all(each.result() > 0 for each in answered)


@pytest.mark.parametrize("tended", [False, True])
def test_a_file_that_is_moved_away_while_it_is_written_has_not_taken_it(tmp_path: Path, tended: bool) -> None:
    """The writer is told, and writes again; also if it was another thread that noticed."""
    file = sqlite_file.SqliteFile(tmp_path / "archive.db", "NORMAL")
    with file.writing():
        pass

    def move_away() -> None:
        (tmp_path / "archive.db").rename(tmp_path / "old.db")
        if tended:
            file.tend()

    with pytest.raises(ArchiveUnavailable, match="moved away"), file.writing():
        move_away()
    with file.writing():
        pass
    file.close()
    assert (tmp_path / "archive.db").exists()


def test_a_damaged_row_costs_that_row_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    archive = opened(tmp_path)
    archive.insert_frames([pack(items(10, start=start)) for start in (1, 11, 21)])
    archive.insert(items(3, key="single"))
    file = sqlite3.connect(tmp_path / "archive.db", isolation_level=None)
    file.execute("UPDATE frames SET payload = x'c1c1c1' WHERE id IN (2, 4)")
    file.close()
    assert len(archive.find({})) == 22
    assert archive.damaged == 2
    assert caplog.text.count("left out") == 1
    archive.close()


def test_a_full_disk_sends_items_to_the_spool_and_loses_none(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    archive.insert(items(1))
    archive._file._writer.execute("PRAGMA max_page_count = 20")  # as a disk without room
    archiver = Archiver(archive, SlottedSpool(tmp_path, 1 << 24), batch=1)
    for start in range(2, 202):
        archiver.put(pack([Item("a.b", bytes(2000), start, start, "app", "i", start)]))
    archiver.flush(60)
    assert archiver.statistics()["spooled"] > 0
    archive._file._writer.execute("PRAGMA max_page_count = 100000")
    wait_for(lambda: not archiver.backlog())
    assert archiver.statistics()["lost"] == archiver.statistics()["refused"] == 0
    assert [i.sequence for i in archive.find({"dataKey": "a.b"}) if isinstance(i.value, bytes)] == list(
        range(2, 202)
    )
    archiver.close()
    archive.close()


def test_what_no_file_can_hold_is_refused_for_good(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    for number in (2**63, 2**64 - 1, -(2**63) - 1):
        with pytest.raises(BackendError) as raised:
            archive.insert([Item("a.b", 1, 5, number, "app", "i", 1)])
        assert not isinstance(raised.value, ArchiveUnavailable)
    archive.insert(items(1))
    archive.close()


def test_keys_and_sources_go_with_their_last_row_and_writers_and_readers_notice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_file, "_COMPARE_S", 0.0)
    writer, other, reader = opened(tmp_path), opened(tmp_path), opened(tmp_path)
    for n in range(50):
        writer.insert([Item(f"gone.k{n}", n, n + 1, n + 1, "app", f"i{n}", 1)])
    writer.insert([Item("stays", 1, 10**6, 10**6, "app", "last", 1)])
    assert len(reader.find({})) == 51
    assert other.prune(before=1000) == 50
    file = sqlite3.connect(tmp_path / "archive.db")
    counts = [file.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in ("keys", "sources")]  # noqa: S608
    file.close()
    assert counts == [1, 1]
    # the writer knew the ids of what was pruned
    writer.insert([Item("gone.k7", 7, 10**6, 10**6, "app", "i7", 2)])
    writer.insert_frames([pack([Item("gone.k8", 8, 10**6, 10**6, "app", "i8", 2)])])
    found = {(item.key, item.instance_id) for item in reader.find({})}
    assert found == {("stays", "last"), ("gone.k7", "i7"), ("gone.k8", "i8")}
    assert [item.value for item in reader.find({"dataKey": "gone.*"})] == [7, 8]
    assert len(reader._file.keys.entries) == 3
    for archive in (writer, other, reader):
        archive.close()


def test_a_file_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    archive.insert(items(1))
    archive.close()
    file = sqlite3.connect(tmp_path / "archive.db")
    file.execute("PRAGMA user_version = 99")
    file.close()
    with pytest.raises(BackendError, match="newer version"):
        opened(tmp_path).find({})


def test_a_failed_call_leaves_nothing_behind(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    bad = Item("b", object(), 1, 1, "app", "i", 1)
    for _ in range(2):
        with pytest.raises(TypeError):
            archive.insert([*items(3, key="a"), bad])
    assert archive.find({}) == []
    archive.insert(items(3, key="a"))
    assert len(archive.find({"dataKey": "a"})) == 3
    archive.close()


def test_deleted_space_is_used_again_or_given_back(tmp_path: Path) -> None:
    archive = opened(tmp_path)
    archive.insert([Item("a", bytes(10_000), n, n, "app", "i", n) for n in range(1, 501)])
    assert archive.prune(before=400) == 399
    archive.close()
    assert (tmp_path / "archive.db").stat().st_size < 2_500_000


def test_a_frame_whose_own_key_is_none_costs_that_row_only(tmp_path: Path) -> None:
    """The row's key was looked up, the frame says another, which is no key."""
    archive = opened(tmp_path)
    archive.insert_frames([pack(items(10, start=start)) for start in (1, 11)])
    file = sqlite3.connect(tmp_path / "archive.db", isolation_level=None)
    payload = pack([Item("a..\0", 1, 1, 1, "app", "i", 1)]).payload
    file.execute("UPDATE frames SET payload = ? WHERE id = 1", (payload,))
    file.close()
    assert len(archive.find({"dataKey": "a.*", "value": {"$exists": True}})) == 10
    assert archive.damaged == 1
    archive.close()


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE keys SET key = CAST(x'ff61' AS TEXT) WHERE key = 'single'",
        "UPDATE keys SET key = char(1) || '.b' WHERE key = 'single'",
        "UPDATE sources SET instance = NULL WHERE instance = 'other'",
        "UPDATE frames SET first_sequence = 'x' WHERE key_id = 2",
        "UPDATE frames SET last_time = 'x', payload = NULL WHERE key_id = 2",
        "UPDATE frames SET first_time = x'00', count = NULL WHERE key_id = 2",
        "UPDATE keys SET time_span = 'x', event_span = -1",
    ],
)
@pytest.mark.parametrize("limit", [None, 20])
def test_damaged_cells_cost_their_rows_only(tmp_path: Path, damage: str, limit: int | None) -> None:
    """Whatever a cell holds, the other rows are read, and the archive is written and pruned."""
    archive = opened(tmp_path)
    archive.insert_frames([pack(items(10))])
    archive.insert(items(1, key="single", instance="other"))
    file = sqlite3.connect(tmp_path / "archive.db", isolation_level=None)
    file.execute("PRAGMA writable_schema = ON")
    file.execute("UPDATE sqlite_schema SET sql = replace(sql, 'NOT NULL', '')")
    file.close()
    file = sqlite3.connect(tmp_path / "archive.db", isolation_level=None)
    file.execute(damage)
    file.close()
    archive.close()
    archive = opened(tmp_path)
    harmless = "time_span" in damage
    for query in ({"timestamp": {"$gte": T0}}, {"dataKey": "**"}):
        assert len(archive.find(query, limit=limit)) == 10 + harmless
    assert (archive.damaged == 0) is harmless
    archive.insert(items(1, key="single", start=2, instance="other"))
    assert archive.prune(before=T0 + 10**9) >= 11
    archive.insert(items(3, start=20))
    assert archive.prune(max_bytes=1) >= 3
    archive.close()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"INTEGER PRIMARY KEY, key", b"INTEGER PRIMARY KEX, key"),
        (b"INTEGER PRIMARY KEY, app", b"INTEGER PRIMARY KEX, app"),
        (b"frames_timeframes", b"\xfframes_timeframes"),
        (b"CREATE TABLE frames(", b"CREATE TABLE fr\xffmes("),
    ],
)
def test_a_damaged_schema_is_told_as_damage(tmp_path: Path, old: bytes, new: bytes) -> None:
    archive = opened(tmp_path)
    archive.insert(items(3))
    archive.close()
    content = (tmp_path / "archive.db").read_bytes()
    assert old in content
    (tmp_path / "archive.db").write_bytes(content.replace(old, new))
    archive = opened(tmp_path)

    def used_twice() -> None:
        for start in (10, 20):
            archive.insert(items(3, key="new", start=start))
            archive.find({"dataKey": "a.*"})

    with pytest.raises(BackendError):
        used_twice()


def test_an_archive_of_version_0_1_opens(tmp_path):
    """Its items are found and more are written; `archive_0_1.sql` is what sqlite3's `.dump` says of a real one."""
    with sqlite3.connect(tmp_path / "archive.db") as old:
        old.executescript(Path(__file__).with_name("archive_0_1.sql").read_text(encoding="ascii"))
        old.execute("PRAGMA user_version = 1")
    old.close()
    archive = opened(tmp_path)
    alerts = archive.find({"dataKey": "network.anomaly.kitsune.alert"})
    assert alerts[0].value["sender"]["mac"] == "34:c3:d2:e0:fc:c9"
    archive.insert(items(2))
    assert len(archive.find({})) == 4 + 2
    archive.close()
