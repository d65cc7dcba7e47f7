"""Values that nobody should send, and an engine that hands them to a real service's callbacks."""

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from reactivex import Subject

from due import Item, RecordBatch
from due.codec import decode_value, encode_value
from due.errors import UnsupportedValue

NOW = 1_700_000_000_000_000_000


def nested(depth: int) -> list[Any]:
    """Lists in lists."""
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


ATOMS: tuple[Any, ...] = (
    None, True, False, 0, -1, 255, 256, 65_536, 2**31, -(2**63), 2**63 - 1, 2**63, 2**64 - 1, 0.5, -0.0, math.nan,
    math.inf, -math.inf, "", "x" * 100_000, "0", "s1\nCRITICAL forged", "<script>alert(1)</script>", "\x00\x1b[2J\u202e",
    "10.0.0.1/33", "fe80::1%\u0085", "١٢", b"", b"\xff" * 1000, [], {}, [None], [[1]], {"a": {"b": nested(5)}},
)  # fmt: skip
ARRAYS: tuple[Any, ...] = (
    np.array(5), np.ones(2), np.zeros((3, 3)), np.array([], "u8"), np.array([math.nan, math.inf]),
    np.array(["a", "bc"]), np.array([b"x"]), np.array(["2020-01-01", "NaT"], "M8[ns]"), np.array([1, 2], "m8[s]"),
    np.array([1 + 2j]), np.array([True, False]), np.array([(1, 2.0)], [("a", "i4"), ("b", "f8")]),
    np.array([b"abcd"], "V4"), np.array([2**64 - 1], "u8"), np.array([-(2**63)], "i8"), np.ones(3, ">u4"),
    np.datetime64("2020-01-01", "ns"), np.float32(1.5),
)  # fmt: skip
BATCHES: tuple[Any, ...] = (
    RecordBatch({}),
    RecordBatch({"id": np.zeros(0, "u8")}),
    RecordBatch({"time_us": np.array([1.5, math.nan])}),
    RecordBatch({"time_us": np.array([-(2**63), 2**63 - 1]), "arrival": np.array([2**64 - 1, 0], "u8")}),
    RecordBatch({"\n<b>": np.array(["x", "y"])}),
)
ZOO: tuple[Any, ...] = (*ATOMS, *ARRAYS, *BATCHES, nested(900), nested(10_000), {"id": nested(10_000)})

atoms = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(), st.binary()
)
values = st.recursive(
    atoms, lambda part: st.lists(part, max_size=4) | st.dictionaries(st.text(max_size=8), part, max_size=4)
)


def carried(value: Any) -> Any:
    """As it comes out of a frame; what DUE would not carry stays as it is."""
    try:
        return decode_value(encode_value(value))
    except (UnsupportedValue, RecursionError, ValueError):
        return value


def mutations(genuine: Any) -> Iterator[Any]:
    """The zoo, and a genuine value with each of its fields wrong in every way."""
    yield from ZOO
    if isinstance(genuine, RecordBatch):
        yield from _wrong_batches(genuine)
    elif isinstance(genuine, dict):
        for name, field in genuine.items():
            yield {key: value for key, value in genuine.items() if key != name}
            for wrong in (*ATOMS, *ARRAYS, nested(9_000)):
                yield {**genuine, name: wrong}
            if isinstance(field, dict):
                for inner in mutations(field):
                    yield {**genuine, name: inner}
        yield {**genuine, "unknown": 1, **{f"more{n}": n for n in range(1000)}}


def _wrong_batches(genuine: RecordBatch) -> Iterator[Any]:
    columns, rows = dict(genuine), len(genuine)
    yield columns
    for name, column in columns.items():
        yield {**columns, name: np.concatenate([column, column])}
        yield RecordBatch({key: value for key, value in columns.items() if key != name})
        for kind in ("f8", "u1", "i8", "u8", "M8[ns]", "S3", "?", "c16", ">i4"):
            yield RecordBatch({**columns, name: np.ones(rows, "i8").astype(kind)})
        for number in (-(2**63), -2, 2**48, 2**63 - 1):
            yield RecordBatch({**columns, name: np.full(rows, number)})
        yield RecordBatch({**columns, name: np.full(rows, 2**64 - 1, "u8")})
        yield RecordBatch({**columns, name: np.full(rows, math.nan)})


class Hands:
    """What the services use of an engine: items are handed to their callbacks, what they write is kept."""

    def __init__(self) -> None:
        self.subjects: defaultdict[str, Subject[Item]] = defaultdict(Subject)
        self.written: list[tuple[str, Any]] = []
        self.archived: list[Item] = []
        self.callback: Any = None
        self.read = 0
        """Items that came out of the archive."""

    def observe(self, key: str, **_: object) -> Subject[Item]:
        return self.subjects[key]

    def write(self, key: str, value: Any, *_: object, event_time: int | None = None, **__: object) -> bool:
        assert event_time is None or 0 <= event_time < 2**63, (key, event_time)
        encode_value(value)
        self.written.append((key, value))
        return True

    def get(self, query: Any, *, limit: int | None = None) -> list[Item]:
        key = query if isinstance(query, str) else query["dataKey"]
        tests = query.get("timestamp", {}) if isinstance(query, dict) else {}
        parts = key.split(".")
        found = [
            item
            for item in self.archived
            if all(p in ("*", i) for p, i in zip(parts, item.key.split("."), strict=False))
            and item.timestamp > tests.get("$gt", -1)
            and item.timestamp < tests.get("$lt", 2**63)
        ]
        found = found if limit is None else found[max(0, len(found) - limit) :]
        self.read += len(found)
        return found

    def health(self) -> dict[str, Any]:
        return {"phase": "active", "active": True, "asking": False}

    def assignments(self) -> tuple[Any, ...]:
        return ()

    def wanted(self, _: str) -> bool:
        return False

    def on_assignments(self, callback: Any) -> None:
        self.callback = callback

    def hand(
        self, pattern: str, key: str, value: Any, *, app: str = "", at: int = NOW, event: int = 0
    ) -> None:
        """An item under a key; `app` is whoever wrote it, else the one that the key names."""
        named = key.partition(":")[0].split(".")[2]
        writer = app or {"sonata": "sonata_adapter", "firewall_kept": "firewall"}.get(named, named)
        self.subjects[pattern].on_next(Item(key, carried(value), at, event or at, writer, "i1", 1))

    def values(self, start: str) -> list[Any]:
        return [value for key, value in self.written if key.startswith(start)]

    def until(self, condition: Any, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, self.written[-3:]
            time.sleep(0.01)
