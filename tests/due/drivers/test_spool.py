"""The spool keeps frames in order and within its size, over crashes, and says what did not fit."""

import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from due.codec import pack
from due.drivers.spool import DiskSpool
from due.errors import BackendError
from due.messages import Item, PackedFrame


def frame(n: int, size: int = 10, count: int = 2) -> PackedFrame:
    return pack([Item("a", bytes(size), n, n, "app", "i", n * count + k) for k in range(count)])


def test_first_in_first_out(tmp_path: Path) -> None:
    spool = DiskSpool(tmp_path, 1 << 20)
    frames = [frame(n) for n in range(5)]
    assert spool.put(frames[:3]) == 0
    assert spool.put(frames[3:]) == 0
    assert len(spool) == 5
    assert spool.take(2) == frames[:2]
    assert spool.take(2) == frames[:2], "taking does not remove"
    spool.done(2)
    assert spool.take(10) == frames[2:]
    spool.done(3)
    assert (spool.take(1), len(spool)) == ([], 0)
    spool.close()
    spool.close()


def test_what_does_not_fit_is_told_in_items(tmp_path: Path) -> None:
    spool = DiskSpool(tmp_path, 10_000)
    assert spool.put([frame(n, 1000) for n in range(10)]) == 12
    kept = len(spool)
    assert kept == 4
    spool.done(2)
    assert spool.put([frame(99, 1000)]) == 0
    assert spool.take(9)[-1].first_timestamp == 99
    spool.close()


def test_it_outlives_its_process(tmp_path: Path) -> None:
    program = """
import os, signal, sys
from pathlib import Path
from tests.due.drivers.test_spool import frame
from due.drivers.spool import DiskSpool
spool = DiskSpool(Path(sys.argv[1]), 1 << 20)
spool.put([frame(n) for n in range(7)])
spool.done(3)
os.kill(os.getpid(), signal.SIGKILL)
"""
    root = Path(__file__).parents[3]
    environment = os.environ | {"PYTHONPATH": str(root)}
    ended = subprocess.run([sys.executable, "-c", program, str(tmp_path)], env=environment, check=False)
    assert ended.returncode == -signal.SIGKILL
    spool = DiskSpool(tmp_path, 1 << 20)
    assert spool.take(10) == [frame(n) for n in range(3, 7)]
    spool.close()


def test_a_damaged_file_is_set_aside_and_the_queue_goes_on(tmp_path: Path, caplog) -> None:
    for _ in range(5):
        (tmp_path / "spool.db").write_bytes(b"something else" * 100)
        spool = DiskSpool(tmp_path, 1 << 20)
        assert spool.set_aside == 1
        spool.put([frame(1)])
        assert spool.take(5) == [frame(1)]
        spool.close()
    kept = list(tmp_path.glob("spool.damaged-*"))
    assert len(kept) == 3
    assert all(path.read_bytes() == b"something else" * 100 for path in kept)
    assert "is damaged" in caplog.text


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendError, match=r"spool\.db"):
        DiskSpool(tmp_path / "file", 1 << 20)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.integers(0, 2**16), st.binary(min_size=1, max_size=64)), min_size=1, max_size=5))
def test_whatever_is_in_the_file_it_works_or_says_why(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, bytes]]
) -> None:
    folder = tmp_path_factory.mktemp("spool")
    spool = DiskSpool(folder, 1 << 20)
    spool.put([frame(n) for n in range(50)])
    spool.close()
    content = bytearray((folder / "spool.db").read_bytes())
    for place, change in changes:
        position = place % len(content)
        content[position : position + len(change)] = change
    (folder / "spool.db").write_bytes(content)
    with suppress(BackendError):
        spool = DiskSpool(folder, 1 << 20)
        while taken := spool.take(7):
            spool.done(len(taken))
        spool.put([frame(100)])
        spool.close()


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(st.tuples(st.sampled_from(["put", "take", "done", "reopen"]), st.integers(0, 4)), max_size=20)
)
def test_it_behaves_like_a_list(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    folder = tmp_path_factory.mktemp("spool")
    spool, model = DiskSpool(folder, 1 << 20), list[PackedFrame]()
    for number, (step, count) in enumerate(steps):
        if step == "put":
            frames = [frame(number * 10 + n) for n in range(count)]
            assert spool.put(frames) == 0
            model += frames
        elif step == "take":
            assert spool.take(count) == model[:count]
        elif step == "done":
            spool.done(count)
            del model[:count]
        else:
            spool.close()
            spool = DiskSpool(folder, 1 << 20)
        assert len(spool) == len(model)
    spool.close()


def test_a_damaged_file_that_cannot_be_replaced_at_once_is_replaced_later(
    tmp_path: Path, monkeypatch
) -> None:
    """On a full disk; meanwhile nothing is in the spool."""
    spool = DiskSpool(tmp_path, 1 << 20)
    spool.put([frame(n) for n in range(200)])
    for statement in ("wal_checkpoint(TRUNCATE)", "cache_size = 0", "shrink_memory"):
        spool._file.execute(f"PRAGMA {statement}")
    with spool.path.open("r+b") as file:
        file.seek(4096)
        file.write(b"\xaa" * (spool.path.stat().st_size - 4096))

    def full(*_: object, **__: object) -> None:
        raise sqlite3.OperationalError("unable to open database file")

    with monkeypatch.context() as disk:
        disk.setattr(sqlite3, "connect", full)
        for n in range(2):
            with pytest.raises(BackendError):
                spool.put([frame(n)])
            assert len(spool) == 0
        spool.done(1)
    assert spool.put([frame(1)]) == 0
    assert spool.take(9) == [frame(1)]
    assert (len(spool), spool.damaged) == (1, 1)
    spool.close()


@pytest.mark.parametrize("data", [b"\xa5\xff", bytes.fromhex("9ba1ffa3617070"), None, 7, "text"])
def test_a_record_that_is_none_is_dropped_and_the_others_stay(tmp_path: Path, data: object) -> None:
    """Texts that are no UTF-8, a record without size, values of other types."""
    spool = DiskSpool(tmp_path, 1 << 20)
    spool.put([frame(1)])
    for statement in (
        "ALTER TABLE frames RENAME TO old",
        "CREATE TABLE frames(id INTEGER PRIMARY KEY, size, data)",
    ):
        spool._file.execute(statement)
    spool._file.execute("INSERT INTO frames SELECT * FROM old")
    spool._file.execute("INSERT INTO frames VALUES(0, NULL, ?)", (data,))
    assert spool.take(5) == [frame(1)]
    spool.done(1)
    assert spool.take(5) == []
    spool.close()


def test_a_schema_that_is_no_text_is_damage(tmp_path: Path) -> None:
    """What SQLite says of it cannot be decoded: an empty file takes its place."""
    DiskSpool(tmp_path, 1 << 20).close()
    file = tmp_path / "spool.db"
    file.write_bytes(file.read_bytes().replace(b"CREATE TABLE frames(", b"CREATE T\x80BLE fr\xffm\xff(", 1))
    spool = DiskSpool(tmp_path, 1 << 20)
    assert spool.set_aside == 1
    spool.put([frame(1)])
    assert spool.take(1) == [frame(1)]
    spool.close()
