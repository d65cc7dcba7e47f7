"""Findings 5 and 6: a publisher with the archive on and off, and batches of 1 to 1,000, unthrottled.

SQLite, and nx-27017, which speaks MongoDB's protocol over a real connection: a figure of it is one of that server.
Every run is a process of its own.  An unthrottled publisher outruns any of them: once the archive's queue is full, its
`write` waits.  So beside the whole run stands its beginning, `BURST` messages, for which the queue has room.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from benchmarks.faults_stage import ArchiveServer
from benchmarks.paper_findings import Measured
from due import DB_ONLY, PUB_ONLY, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer

BATCHES: Final = (1, 10, 100, 1_000)
_MESSAGE: Final = bytes(range(200))
_AT_ONCE: Final = 100
BURST: Final = 200_000
"""With their headers less than the archive's queue of 64 MiB."""
_DRAIN_S: Final = 120.0
KEY: Final = "bench.archive.paper.message"


def figures(rounds: int, *, quick: bool) -> tuple[dict[int, dict[str, Measured]], dict[str, Any]]:
    """Findings 5 and 6 by number, and all cells."""
    seconds = 1.0 if quick else 3.0
    batches = (1, 1_000) if quick else BATCHES
    found: dict[int, dict[str, Measured]] = {5: {}, 6: {}}
    cells: dict[str, Any] = {}
    for name in ("sqlite", "mongodb"):
        try:
            kept = [_round(name, batches, seconds) for _ in range(rounds)]
        except LookupError as error:  # nx-27017 is not installed: the finding says so
            cells[name] = str(error)
            continue
        for figure, above, below in (
            ("on_to_off", "on", "off"),
            ("burst_on_to_off", "burst on", "burst off"),
            ("archive_alone_to_off", f"batch {batches[-1]}", "off"),
        ):
            found[5][f"{name}_{figure}"] = Measured(tuple(one[above] / one[below] for one in kept))
        found[6][f"{name}_batch1000_to_1"] = Measured(
            tuple(one["batch 1000"] / one["batch 1"] for one in kept)
        )
        cells[name] = {field: Measured(tuple(one[field] for one in kept)).to_value() for field in kept[0]}
    return found, cells


def _round(name: str, batches: tuple[int, ...], seconds: float) -> dict[str, float]:
    with _archive(name) as url:
        found = {f"batch {batch}": _run(url, batch, seconds, "alone")[0] for batch in batches}
        for mode in ("off", "on"):
            found[mode], found[f"burst {mode}"] = _run(url, batches[-1], seconds, mode)
    return found


@contextmanager
def _archive(name: str) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        if name == "sqlite":
            yield f"sqlite://{folder}/archive.db"
            return
        server = ArchiveServer(Path(folder))
        try:
            yield server.start()
        finally:
            server.stop()


def _run(url: str, batch: int, seconds: float, mode: str) -> tuple[float, float]:
    command = [sys.executable, "-m", "benchmarks.paper_archive", url, str(batch), str(seconds), mode]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[1], check=True, stdout=subprocess.PIPE, text=True, timeout=300
    )
    whole, burst = json.loads(done.stdout.splitlines()[-1])
    return float(whole), float(burst)


def _measure(url: str, batch: int, seconds: float, mode: str) -> tuple[float, float]:
    """Messages a second: published with the archive on or off, or archived alone (all in the archive).

    Returns:
        The rate of the whole run, and that of its first `BURST` messages (the same for a run with fewer).
    """
    flags = {"on": (), "off": (PUB_ONLY,), "alone": (DB_ONLY,)}[mode]
    with tempfile.TemporaryDirectory() as folder, EmbeddedServer(f"{folder}/updates") as server:
        options = Options(
            updates=server.url,
            archive=url,
            directory=folder,
            coordinated=False,
            archive_batch=batch,
            frame_bytes=min(Options().frame_bytes, batch * (len(_MESSAGE) + 12)),
            archive_queue_bytes=1 << 20 if mode == "alone" else Options().archive_queue_bytes,
        )
        engine = Engine(options)
        engine.init("paper")
        begun, written, burst = time.perf_counter(), 0, 0.0
        while time.perf_counter() - begun < seconds:
            for _ in range(_AT_ONCE):
                engine.write(KEY, _MESSAGE, flags)
            written += _AT_ONCE
            if written == BURST:
                burst = BURST / (time.perf_counter() - begun)
        if mode == "alone":
            engine.flush(_DRAIN_S)
        rate = written / (time.perf_counter() - begun)
        engine.close()
    return rate, burst or rate


if __name__ == "__main__":
    print(json.dumps(_measure(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4])))
