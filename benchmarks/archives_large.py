"""An archive of many items on SQLite: how fast it fills, what an item takes, and how long queries last in it.

    python -m benchmarks.archives --items 10000000 --json FILE

Items of 200 bytes under 200 keys, in frames of 100, in order of time, as many writers make them.  The rate is given for
each tenth, so that a decline shows.  Each kind of query is asked at 200 random places, and finds 1,000 items.
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import measure
from due import Item
from due.codec import pack
from due.drivers.sqlite import SqliteArchive
from due.messages import PackedFrame

KEYS = 200
FRAME = 100
SIZE = 200
FOUND = 1_000
LEAST = KEYS * FRAME * 10
"""Items from which each key has enough of them."""
_QUERIES = 200
_TENTHS = 10
_TRANSACTION = 50
"""Frames; the archiver waits 20 ms for more, which at 250,000 items a second are so many."""
_ITEM_NS = 10_000
_START_NS = 1_700_000_000_000_000_000

Query = Mapping[str, Any]


def figures_of(items: int, folder: Path | None = None) -> dict[str, Any]:
    """Fill an archive and ask.

    Args:
        items: how many; rounded down to whole frames of all keys in ten equal parts.
        folder: on the disk to be measured; default: that of temporary files.
    """
    with tempfile.TemporaryDirectory(prefix="archive-", dir=folder) as name:
        file = Path(name) / "archive.db"
        archive = SqliteArchive(f"sqlite://{file}")
        rounds = items // (KEYS * FRAME)
        rates = [_filled(archive, part) for part in np.array_split(np.arange(rounds), min(_TENTHS, rounds))]
        archive.close()  # writes the log into the file
        stored, size = rounds * KEYS * FRAME, file.stat().st_size
        archive = SqliteArchive(f"sqlite://{file}")
        found = {
            kind: _times(archive, make, wanted, rounds) for kind, (make, wanted) in _kinds(rounds).items()
        }
        archive.close()
    each = stored / len(rates)
    return {
        "items": stored,
        "insert_items_per_s": round(stored / sum(each / rate for rate in rates)),
        "insert_items_per_s_tenths": [round(rate) for rate in rates],
        "bytes_per_item": round(size / stored, 1),
        "gb": round(size / 1e9, 3),
        "payload_bytes_per_item": SIZE,
        "query_ms": found,
    }


def _filled(archive: SqliteArchive, rounds: Any) -> float:
    """Items a second; making the frames is not counted."""
    took, count = 0.0, 0
    for number in rounds:
        frames = [_frame(int(number), key) for key in range(KEYS)]
        for start in range(0, KEYS, _TRANSACTION):
            began = time.perf_counter()
            archive.insert_frames(frames[start : start + _TRANSACTION])
            took += time.perf_counter() - began
        count += KEYS * FRAME
    return count / took


def _frame(number: int, key: int) -> PackedFrame:
    first, name = number * FRAME, _key(key)
    values = np.random.default_rng((number, key)).bytes(SIZE)
    return pack([_item(name, key, first + place, values) for place in range(FRAME)])


def _item(name: str, key: int, sequence: int, value: bytes) -> Item:
    moment = _time(sequence, key)
    return Item(name, value, moment, moment, "bench", "i", sequence)


def _key(number: int) -> str:
    return f"bench.items.switch{number // 10}.kind{number % 10}"


def _time(sequence: int, key: int) -> int:
    """Items of all keys take turns."""
    return _START_NS + (sequence * KEYS + key) * _ITEM_NS


def _kinds(rounds: int) -> dict[str, tuple[Callable[[int], Query], int]]:
    """Queries by a place in time (a sequence number), and how many items they find."""
    last = rounds * FRAME
    below = FOUND // KEYS
    pattern = FOUND // 10

    def between(first: int, count: int) -> Query:
        return {"timestamp": {"$gte": _time(first, 0), "$lt": _time(first + count, 0)}}

    return {
        "key_and_time": (lambda at: {"dataKey": _key(at % KEYS), **between(min(at, last - FOUND), FOUND)}, FOUND),
        "pattern_and_time": (
            lambda at: {
                "dataKey": f"bench.items.switch{at % (KEYS // 10)}.*",
                **between(min(at, last - pattern), pattern),
            },
            FOUND,
        ),
        "time": (lambda at: between(min(at, last - below), below), FOUND),
    }  # fmt: skip


def _times(
    archive: SqliteArchive, make: Callable[[int], Query], wanted: int, rounds: int
) -> dict[str, float]:
    times = []
    for at in np.random.default_rng(1).integers(0, rounds * FRAME, _QUERIES):
        query = make(int(at))
        began = time.perf_counter()
        found = archive.find(query)
        times.append((time.perf_counter() - began) * 1000)
        assert len(found) == wanted, f"{query}: {len(found)} items instead of {wanted}"
    return {f"p{share}": round(float(np.percentile(times, share)), 3) for share in (50, 99)}


def show(figures: Mapping[str, Any]) -> None:
    """Lines of text, and the rate of each tenth as bars."""
    print(
        f"{figures['items']:,} items, {figures['gb']} GB: {figures['insert_items_per_s']:,} items/s in, "
        f"{figures['bytes_per_item']} bytes an item of {SIZE} bytes"
    )
    measure.table(
        ("1,000 items by", "p50 ms", "p99 ms"),
        [(kind.replace("_", " "), each["p50"], each["p99"]) for kind, each in figures["query_ms"].items()],
    )
    tenths = figures["insert_items_per_s_tenths"]
    measure.bars("items/s in, by tenth", {str(place): rate for place, rate in enumerate(tenths, start=1)})
