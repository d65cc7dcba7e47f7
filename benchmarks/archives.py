"""What the archive costs a publisher, and how fast it takes and finds: `python -m benchmarks.archives --json FILE`.

Every run is a process of its own that writes 200-byte messages under one key through the embedded Data
Updates server; runs with and without the archive alternate, and medians are given.  "Batch" is the number
of messages per frame and per archive transaction.

`--items N` fills an archive with so many items instead and asks for some of them (`benchmarks.archives_large`);
docs/scaling.md gives figures of 10,000,000.
"""

import argparse
import json
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import archives_large, measure
from due import PUB_ONLY, Engine, Item, Options, RecordBatch
from due.codec import pack
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.sqlite import SqliteArchive

MESSAGE = bytes(200)
OFFERED_PER_S = 100_000
BATCHES = (1, 100, 1000)
KEY = "bench.archives.app.message"
_ITEM_BYTES = len(MESSAGE) + 12
_BURST = 500
_SECONDS = 30.0
_SETTLE_S = 0.1


def main(argv: Sequence[str] | None = None) -> int:
    """Run all, print a table and bars, write the figures."""
    parser = measure.arguments("archives", __doc__, rounds=2)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--items", type=int, help="fill an archive with so many items instead")
    parser.add_argument(
        "--folder", type=Path, help="for that archive; default: the folder of temporary files"
    )
    chosen = parser.parse_args(argv)
    if chosen.items is not None:
        if chosen.items < archives_large.LEAST:
            parser.error(f"--items {chosen.items}: at least {archives_large.LEAST:,}")
        if chosen.folder is not None and not chosen.folder.is_dir():
            parser.error(f"--folder {chosen.folder}: there is no such folder")
        large = archives_large.figures_of(chosen.items, chosen.folder)
        archives_large.show(large)
        measure.write_json(chosen.json, {"machine": measure.machine(), "large": large})
        return 0
    if chosen.worker:
        print(json.dumps(publish(**json.loads(chosen.worker))))
        return 0
    figures = {"machine": measure.machine(), **figures_of(_SECONDS * chosen.scale, chosen.rounds)}
    show(figures)
    measure.write_json(chosen.json, figures)
    return 0


def figures_of(seconds: float, rounds: int) -> dict[str, Any]:
    """All figures; runs at batch 1 and 100 are a third as long."""
    by_batch = {
        str(batch): _compared(rounds, batch=batch, seconds=seconds if batch == BATCHES[-1] else seconds / 3)
        for batch in BATCHES
    }
    full_speed = _compared(rounds, batch=BATCHES[-1], seconds=seconds / 10, offered=0)
    with tempfile.TemporaryDirectory() as folder:
        driver = driver_figures(Path(folder))
    headline = by_batch[str(BATCHES[-1])]
    return {
        **{name: headline[name] for name in ("archived_per_s", "publish_slowdown", "backlog")},
        "by_batch": by_batch,
        "full_speed": full_speed,
        "offered_per_s": OFFERED_PER_S,
        "seconds": seconds,
        **driver,
    }


def _compared(rounds: int, **options: Any) -> dict[str, float]:
    """Medians with and without the archive, run in turn."""
    runs = [[_run(archive=archive, **options) for archive in (False, True)] for _ in range(rounds)]
    alone, published = (statistics.median(pair[n]["published_per_s"] for pair in runs) for n in (0, 1))
    return {
        "archived_per_s": statistics.median(pair[1]["archived_per_s"] for pair in runs),
        "publish_slowdown": round(max(0.0, 1 - published / alone), 4),
        "published_per_s": published,
        "published_without_archive_per_s": alone,
        "backlog": max(pair[1]["backlog"] for pair in runs),
        "lost": sum(pair[1]["lost"] for pair in runs),
    }


def _run(**options: Any) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.archives", "--worker", json.dumps(options)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def publish(*, batch: int, seconds: float, archive: bool, offered: int = OFFERED_PER_S) -> dict[str, Any]:
    """One run: write at the offered rate (0: as fast as it goes), then wait until the archive has it all.

    `backlog`: frames that are not archived 0.1 s after the last write, five times the archiver's linger.
    """
    with tempfile.TemporaryDirectory() as folder, EmbeddedServer(f"{folder}/updates") as server:
        options = Options(
            updates=server.url,
            archive=f"sqlite://{folder}/archive.db",
            directory=folder,
            coordinated=False,
            archive_batch=batch,
            frame_bytes=min(Options().frame_bytes, batch * _ITEM_BYTES),
        )
        engine = Engine(options)
        engine.init("bench")
        begun = time.perf_counter()
        written = _write(engine, seconds, offered, () if archive else (PUB_ONLY,))
        ended = time.perf_counter()
        time.sleep(_SETTLE_S)
        before = engine.health().get("archive", {})
        engine.flush(300)
        drained = time.perf_counter()
        after = engine.health().get("archive", {})
        engine.close()
    return {
        "published_per_s": round(written / (ended - begun)),
        "archived_per_s": round(after.get("archived", 0) / (drained - begun - _SETTLE_S)),
        "backlog": before.get("backlog", 0),
        "lost": after.get("lost", 0),
    }


def _write(engine: Engine, seconds: float, offered: int, flags: tuple[Any, ...]) -> int:
    write, written = engine.write, 0
    begun = time.perf_counter()
    while True:
        now = time.perf_counter() - begun
        if now >= seconds:
            return written
        if offered and written > now * offered:
            time.sleep(0.0005)
            continue
        for _ in range(_BURST):
            write(KEY, MESSAGE, flags)
        written += _BURST


def driver_figures(folder: Path) -> dict[str, Any]:
    """The embedded driver by itself, and rows in plain sqlite3 as its peer."""
    archive = SqliteArchive(f"sqlite://{folder}/items.db")
    items = [_item(n) for n in range(1_000_000)]
    frames = [pack(items[start : start + 500]) for start in range(0, len(items), 500)]
    figures: dict[str, Any] = {"peer_sqlite_rows_per_s": round(_peer_rows(folder, items[:200_000]))}
    figures["driver_items_per_s"] = round(_rate(200_000, lambda: _insert_items(archive, items[:200_000])))
    archive.close()
    archive = SqliteArchive(f"sqlite://{folder}/frames.db")
    figures["driver_framed_items_per_s"] = round(_rate(len(items), lambda: archive.insert_frames(frames)))
    figures["query_1000_of_1m_ms"] = _query_times(archive, items)
    batch = RecordBatch({"time_us": np.arange(10_000), "length": np.zeros(10_000, np.uint16)})
    packed = [pack([Item("bench.records", batch, n, n, "bench", "r", n)]) for n in range(1, 501)]
    figures["driver_records_per_s"] = round(_rate(500 * 10_000, lambda: archive.insert_frames(packed)))
    archive.close()
    return figures


def _item(number: int) -> Item:
    moment = 1_700_000_000_000_000_000 + number * 10_000
    return Item(KEY, MESSAGE, moment, moment, "bench", "i", number)


def _rate(count: int, action: Callable[[], None]) -> float:
    begun = time.perf_counter()
    action()
    return count / (time.perf_counter() - begun)


def _insert_items(archive: SqliteArchive, items: Sequence[Item]) -> None:
    for start in range(0, len(items), 1000):
        archive.insert(items[start : start + 1000])


def _peer_rows(folder: Path, items: Sequence[Item]) -> float:
    file = sqlite3.connect(folder / "peer.db", isolation_level=None)
    file.executescript(
        "PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL;"
        "CREATE TABLE items(key TEXT, time INTEGER, value BLOB); CREATE INDEX by_time ON items(key, time);"
    )

    def insert() -> None:
        for start in range(0, len(items), 1000):
            file.execute("BEGIN")
            rows = ((one.key, one.timestamp, one.value) for one in items[start : start + 1000])
            file.executemany("INSERT INTO items VALUES(?, ?, ?)", rows)
            file.execute("COMMIT")

    rate = _rate(len(items), insert)
    file.close()
    return rate


def _query_times(archive: SqliteArchive, items: Sequence[Item]) -> dict[str, float]:
    times = []
    for start in np.random.default_rng(1).integers(0, len(items) - 1000, 200):
        first, behind = items[int(start)].timestamp, items[int(start) + 1000].timestamp
        begun = time.perf_counter()
        found = archive.find({"dataKey": KEY, "timestamp": {"$gte": first, "$lt": behind}})
        times.append((time.perf_counter() - begun) * 1000)
        assert len(found) == 1000
    return {
        "p50": round(float(np.percentile(times, 50)), 3),
        "p95": round(float(np.percentile(times, 95)), 3),
    }


def show(figures: dict[str, Any]) -> None:
    """A table and bars."""
    print(f"offered {figures['offered_per_s']:,} messages/s of {len(MESSAGE)} B")
    rows = {**figures["by_batch"], "full speed": figures["full_speed"]}
    fields = (
        "published_per_s",
        "published_without_archive_per_s",
        "archived_per_s",
        "publish_slowdown",
        "backlog",
    )
    heads = ("batch", "published/s", "without archive", "archived/s", "slowdown", "backlog frames")
    measure.table(heads, [[name, *(row[field] for field in fields)] for name, row in rows.items()])
    measure.bars("archived messages/s, by batch", {name: row["archived_per_s"] for name, row in rows.items()})
    names = {
        "framed messages": "driver_framed_items_per_s",
        "messages as rows": "driver_items_per_s",
        "plain sqlite3 rows": "peer_sqlite_rows_per_s",
        "packet records": "driver_records_per_s",
    }
    measure.bars("driver alone, per second", {name: figures[field] for name, field in names.items()})
    query = figures["query_1000_of_1m_ms"]
    print(f"\n1,000 of 1,000,000 by key and time: p50 {query['p50']} ms, p95 {query['p95']} ms")


if __name__ == "__main__":
    sys.exit(main())
