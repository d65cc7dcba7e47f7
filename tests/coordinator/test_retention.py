"""Retention deletes what is too old or too much, only where allowed, and outlives an archive that is away."""

import threading
import time
from pathlib import Path
from typing import Any

from coordinator.retention import Retention
from due.drivers.sqlite import SqliteArchive
from due.messages import Item


def filled(folder: Path) -> SqliteArchive:
    """Two items of an hour ago and two of now, 20 KB each."""
    archive = SqliteArchive(f"sqlite://{folder}/archive.db")
    now = time.time_ns()
    times = (now - 3_600_000_000_000, now - 3_599_000_000_000, now - 1000, now)
    archive.insert([Item("a", bytes(20_000), t, t, "app", "i", n) for n, t in enumerate(times, 1)])
    return archive


def run(archive: SqliteArchive, folder: Path, turns: int, allowed: bool = True, **limits: Any) -> Retention:
    """Let it have some turns."""
    asked = threading.Semaphore(0)

    def may() -> bool:
        asked.release()
        return allowed

    retention = Retention(
        lambda: SqliteArchive(f"sqlite://{folder}/archive.db"),
        may,
        age_s=limits.get("age_s", 0),
        max_bytes=int(limits.get("max_bytes", 0)),
        every_s=0.01,
        lasting_keys=limits.get("lasting_keys", ()),
        lasting_age_s=limits.get("lasting_age_s", 0),
    )
    retention.start()
    for _ in range(turns):
        asked.acquire(timeout=60)
    retention.stop()
    return retention


def test_what_is_too_old_goes(tmp_path: Path) -> None:
    archive = filled(tmp_path)
    assert run(archive, tmp_path, 2, age_s=60).deleted == 2
    assert [item.sequence for item in archive.find({})] == [3, 4]
    archive.close()


def test_what_is_too_much_goes_oldest_first(tmp_path: Path) -> None:
    archive = filled(tmp_path)
    run(archive, tmp_path, 2, max_bytes=130_000)
    left = [item.sequence for item in archive.find({})]
    assert left
    assert left == [1, 2, 3, 4][-len(left) :]
    assert len(left) < 4
    archive.close()


def test_what_lasts_stays_until_an_age_of_its_own(tmp_path: Path) -> None:
    archive = filled(tmp_path)
    assert run(archive, tmp_path, 2, age_s=60, lasting_keys=("*",)).deleted == 0
    assert run(archive, tmp_path, 2, lasting_age_s=3599.5, lasting_keys=("*",)).deleted == 1
    assert [item.sequence for item in archive.find({})] == [2, 3, 4]
    archive.close()


def test_a_standby_deletes_nothing(tmp_path: Path) -> None:
    archive = filled(tmp_path)
    assert run(archive, tmp_path, 3, allowed=False, age_s=60).deleted == 0
    assert len(archive.find({})) == 4
    archive.close()


def test_without_limits_it_does_not_even_start(tmp_path: Path) -> None:
    archive = filled(tmp_path)
    assert run(archive, tmp_path, 0).deleted == 0
    assert len(archive.find({})) == 4
    archive.close()


def test_an_archive_that_is_away_is_tried_again(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.write_text("a file where the folder will be")
    turns = threading.Semaphore(0)

    def may() -> bool:
        turns.release()
        return True

    retention = Retention(
        lambda: SqliteArchive(f"sqlite://{place}/archive.db"), may, age_s=60, max_bytes=0, every_s=0.01
    )
    retention.start()
    turns.acquire(timeout=60)
    place.unlink()
    archive = filled(place)
    deadline = time.monotonic() + 60
    while not retention.deleted and time.monotonic() < deadline:
        time.sleep(0.01)
    retention.stop()
    assert retention.deleted == 2
    archive.close()
