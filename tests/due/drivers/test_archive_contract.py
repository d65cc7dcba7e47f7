"""Every archive driver keeps one contract: same dialect, same order, same types back, nothing twice."""

import datetime as dt
import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from due.backends import open_archive as archive_of
from due.codec import pack
from due.drivers.base import ArchiveDriver
from due.drivers.lasting import Lasting
from due.errors import BackendError, InvalidKey, InvalidQuery
from due.messages import Item, RecordBatch
from tests.due.drivers.mongo_router import mongo_router
from tests.due.drivers.mongo_server import PATIENT, mongo_server
from tests.naive.archive_query import naive_find

T0 = 1_700_000_000_123_456_789
LASTING = Lasting(("network.block.*", "network.meter.*"))
DRIVERS = ("sqlite", "mongodb", "mongodb_cluster", "memory")
Open = Callable[[], ArchiveDriver]


@pytest.fixture(scope="module")
def mongo_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with mongo_server(tmp_path_factory.mktemp("mongo")) as url:
        yield url


@pytest.fixture(scope="module")
def mongo_cluster_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Of a double of mongos: no sharded cluster runs here."""
    with mongo_router(tmp_path_factory.mktemp("mongo_cluster")) as (url, _):
        yield url


def _url(request: pytest.FixtureRequest, folder: Path) -> str:
    unique = abs(hash(request.node.nodeid))
    if request.param == "sqlite":
        return f"sqlite://{folder}/archive.db"
    if request.param == "memory":
        return f"memory://t{unique}"
    server = "mongo_url" if request.param == "mongodb" else "mongo_cluster_url"
    return request.getfixturevalue(server) + f"?{PATIENT}&collection=t{unique}"


@pytest.fixture(params=DRIVERS)
def open_archive(request: pytest.FixtureRequest, tmp_path) -> Iterator[Open]:
    """Opens the same empty archive as often as it is called."""
    opened: list[ArchiveDriver] = []
    url = _url(request, tmp_path)

    def make() -> ArchiveDriver:
        opened.append(archive_of(url))
        return opened[-1]

    yield make
    make().prune(max_bytes=0)
    for archive in opened:
        archive.close()


@pytest.fixture
def archive(open_archive: Open) -> ArchiveDriver:
    return open_archive()


def item(key: str = "a.b.c", value: Any = None, n: int = 1, **more: Any) -> Item:
    fields: dict[str, Any] = {
        "timestamp": T0 + n * 1000,
        "event_time": T0 + n * 1000,
        "app_id": "app",
        "instance_id": "i1",
    }
    return Item(key=key, value=value, sequence=n, **(fields | more))


def same(value: Any, other: Any) -> bool:
    """Equal and of one type, NaN and numpy included."""
    if isinstance(value, np.ndarray):
        return (
            isinstance(other, np.ndarray)
            and value.dtype == other.dtype
            and value.shape == other.shape
            and np.array_equal(value, other, equal_nan=value.dtype.kind == "f")
        )
    if isinstance(value, dict):
        return (
            isinstance(other, dict)
            and list(value) == list(other)
            and all(same(value[k], other[k]) for k in value)
        )
    if isinstance(value, list):
        return isinstance(other, list) and len(value) == len(other) and all(map(same, value, other))
    if isinstance(value, float) and math.isnan(value):
        return isinstance(other, float) and math.isnan(other)
    return type(value) is type(other) and bool(value == other)


VALUES = [
    None,
    True,
    0,
    -(2**63),
    2**63 - 1,
    1.5,
    float("nan"),
    float("-inf"),
    "",
    "text with \x00 and ☃",
    b"",
    bytes(range(256)),
    dt.datetime(2024, 2, 29, 12, 0, 0, 123456, tzinfo=dt.UTC),
    dt.datetime(2024, 2, 29, 12, 0, 0, 1),  # noqa: DTZ001 naive ones come back naive
    np.datetime64(T0, "ns"),
    [],
    [1, "two", [3.0, None], {"four": b"4"}],
    {},
    {"a": {"b": [1, 2]}, "c.d": 1, "$e": 2, "": 3},
    np.arange(6, dtype=np.uint16).reshape(2, 3),
    np.array([1.0, np.nan]),
    RecordBatch({"time_us": np.arange(1000), "length": np.full(1000, 60, np.uint16)}),
]


@pytest.mark.parametrize("as_frame", [False, True], ids=["items", "frame"])
def test_values_come_back_with_their_types(archive: ArchiveDriver, as_frame: bool) -> None:
    items = [item(value=value, n=n, event_time=n) for n, value in enumerate(VALUES, 1)]
    if as_frame:
        archive.insert_frames([pack(items)])
    else:
        archive.insert(items)
    found = archive.find({"dataKey": "a.b.c"})
    assert [i.sequence for i in found] == [i.sequence for i in items]
    for original, back in zip(items, found, strict=True):
        assert same(original.value, back.value), original.value
        assert (back.timestamp, back.event_time) == (original.timestamp, original.event_time)
        assert (back.key, back.app_id, back.instance_id) == ("a.b.c", "app", "i1")


def test_oldest_first_whatever_the_order_of_writing(archive: ArchiveDriver) -> None:
    archive.insert([item(n=3), item(n=1), item("a.b.d", n=2)])
    archive.insert([item("a.b.e", n=9, timestamp=T0), item("a.b.e", n=8, timestamp=T0)])
    assert [i.sequence for i in archive.find({})] == [8, 9, 1, 2, 3]


def test_nothing_is_stored_twice(open_archive: Open) -> None:
    items = [item(value=n, n=n) for n in range(1, 21)]
    frames = [pack(items[:10]), pack(items[10:])]
    archive = open_archive()
    archive.insert_frames(frames)
    archive.insert_frames(frames)
    archive.insert([*items[5:15], items[5]])
    open_archive().insert_frames(frames[1:])
    assert [i.value for i in archive.find({})] == list(range(1, 21))


def test_a_frame_fills_what_is_missing(archive: ArchiveDriver) -> None:
    items = [item(value=n, n=n) for n in range(1, 11)]
    archive.insert(items[3:5])
    archive.insert_frames([pack(items)])
    assert [i.value for i in archive.find({})] == list(range(1, 11))


def test_other_instances_and_keys_are_other_items(archive: ArchiveDriver) -> None:
    archive.insert([item(n=1), item(n=1, instance_id="i2"), item("a.b", n=1)])
    assert len(archive.find({})) == 3


def test_an_indexed_frame_is_searched_by_value(archive: ArchiveDriver) -> None:
    items = [item(value={"rate": n, "host": f"h{n % 3}"}, n=n) for n in range(1, 31)]
    archive.insert_frames([pack(items, index=True)])
    found = archive.find({"dataKey": "a.b.c", "value.host": "h1", "value.rate": {"$gt": 10}})
    assert [i.value["rate"] for i in found] == [13, 16, 19, 22, 25, 28]


def test_record_batches_are_found_by_key_and_time(archive: ArchiveDriver) -> None:
    batches = [item(value=RecordBatch({"x": np.arange(5000) + n}), n=n) for n in range(1, 6)]
    archive.insert_frames([pack([one]) for one in batches])
    found = archive.find({"dataKey": "a.*.c", "timestamp": {"$gte": T0 + 2000, "$lt": T0 + 4000}})
    assert [i.value["x"][0] for i in found] == [2, 3]


@pytest.mark.parametrize("limit", [1, 3, 30, 100, 1000])
def test_of_more_than_the_limit_the_latest_are_found_oldest_first(archive: ArchiveDriver, limit: int) -> None:
    # frames of two instances that overlap in time, and single items between them
    for first in range(0, 200, 20):
        archive.insert_frames([pack([item(n=first + k + 1) for k in range(20)])])
        archive.insert([item(n=first + 10, instance_id="single", value=first)])
        archive.insert_frames(
            [
                pack(
                    [
                        item(n=k + 1, instance_id="late", timestamp=T0 + (first + k) * 1000)
                        for k in range(first, first + 20)
                    ]
                )
            ]
        )
    # another key, with frames that hold some of these
    for first in range(0, 200, 50):
        wide = [item("a.wide", n=first + k + 1, timestamp=T0 + (first + 4 * k) * 1000) for k in range(10)]
        archive.insert_frames([pack(wide)])
    for query in (
        {"dataKey": "a.b.c"},
        {"dataKey": "a.wide"},
        {"dataKey": "a.**"},
        {"dataKey": {"$in": ["a.wide", "a.b.c"]}, "sequence": {"$gt": 7}},
        {"dataKey": "a.**", "instanceId": "late"},
        {"timestamp": {"$lt": T0 + 90_000}},
    ):
        assert archive.find(query, limit=limit) == archive.find(query)[-limit:]


def test_times_are_datetimes_or_nanoseconds(archive: ArchiveDriver) -> None:
    moment = dt.datetime(2024, 1, 1, tzinfo=dt.UTC)
    ns = 1_704_067_200_000_000_000
    archive.insert([item(n=n, timestamp=ns + n - 2, event_time=n) for n in range(1, 4)])
    for now in (moment, moment.replace(tzinfo=None), ns, np.datetime64(ns, "ns")):
        assert [i.sequence for i in archive.find({"timestamp": {"$gt": now}})] == [3]
        assert [i.sequence for i in archive.find({"timestamp": now})] == [2]


def test_tending_costs_no_item(archive: ArchiveDriver) -> None:
    archive.tend()
    archive.insert([Item("a", 1, T0, T0, "app", "i", 1)])
    archive.tend()
    assert [item.value for item in archive.find({})] == [1]


def test_retention_by_age(archive: ArchiveDriver) -> None:
    archive.insert([item(n=n) for n in range(1, 11)])
    archive.insert_frames([pack([item("f", n=n) for n in range(1, 4)])])
    assert archive.prune(before=T0 + 4000) == 6
    assert [i.sequence for i in archive.find({"dataKey": "a.b.c"})] == list(range(4, 11))
    assert archive.find({"dataKey": "f"}) == []
    assert archive.prune(before=T0) == 0


def test_retention_by_age_keeps_a_frame_until_all_of_it_is_old(archive: ArchiveDriver) -> None:
    archive.insert_frames([pack([item(n=n) for n in range(1, 11)])])
    archive.insert([item(value=n, n=n) for n in range(11, 21)])
    assert archive.prune(before=T0 + 5000) == 0
    assert len(archive.find({})) == 20
    assert archive.prune(before=T0 + 10_001) == 10
    assert [i.value for i in archive.find({})] == list(range(11, 21))


def test_retention_by_age_leaves_no_key_out(archive: ArchiveDriver) -> None:
    for key in ("a.b", "a.b.c", "z"):
        archive.insert([item(key, n=n) for n in (1, 3)])
    assert archive.prune(before=T0 + 2000) == 3
    assert sorted((i.key, i.sequence) for i in archive.find({})) == [("a.b", 3), ("a.b.c", 3), ("z", 3)]
    assert archive.prune(before=T0 + 2000) == 0


def test_retention_by_size_takes_the_oldest_first(archive: ArchiveDriver) -> None:
    for key in ("a", "b"):
        archive.insert([item(key, value=bytes(20_000), n=n) for n in range(1, 101)])
    deleted = archive.prune(max_bytes=2_000_000)
    left = archive.find({})
    assert len(left) == 200 - deleted
    assert 40 <= len(left) <= 110
    assert min(i.sequence for i in left) >= 100 - len(left) // 2
    assert archive.prune(max_bytes=0) == len(left)


def test_what_lasts_makes_way_for_nothing_else(archive: ArchiveDriver) -> None:
    archive.insert([item("network.block.x", value=bytes(1000), n=n) for n in range(1, 11)])
    archive.insert([item("a", value=bytes(20_000), n=n) for n in range(11, 101)])
    archive.prune(max_bytes=600_000, lasting=LASTING)
    assert [i.sequence for i in archive.find({"dataKey": "network.block.x"})] == list(range(1, 11))
    left = [i.sequence for i in archive.find({"dataKey": "a"})]
    assert 5 <= len(left) <= 40
    assert left == list(range(101 - len(left), 101))


def test_what_lasts_has_room_for_half(archive: ArchiveDriver) -> None:
    archive.insert([item("network.block.x", value=bytes(20_000), n=n) for n in range(1, 101)])
    archive.insert([item("a", value=bytes(20_000), n=n) for n in range(1, 21)])
    archive.prune(max_bytes=1_200_000, lasting=LASTING)
    left = [i.sequence for i in archive.find({"dataKey": "network.block.x"})]
    assert 20 <= len(left) <= 40
    assert left == list(range(101 - len(left), 101))
    assert archive.find({"dataKey": "a"})


def test_what_lasts_has_an_age_of_its_own(archive: ArchiveDriver) -> None:
    for key in ("network.block.x", "network.block:a=b", "a"):
        archive.insert([item(key, n=n) for n in range(1, 11)])
    assert archive.prune(before=T0 + 8001, lasting=LASTING) == 16
    assert [i.sequence for i in archive.find({"dataKey": "network.block.x"})] == list(range(1, 11))
    assert archive.prune(lasting=LASTING._replace(before=T0 + 3001)) == 3
    assert [i.sequence for i in archive.find({"dataKey": "network.block.x"})] == list(range(4, 11))
    assert len(archive.find({})) == 11


def test_a_damaged_key_lasts_no_longer_than_others() -> None:
    assert LASTING.among(["network.block.x", "network..block", "a"]) == ["network.block.x"]


def test_wrong_queries_name_the_fault(archive: ArchiveDriver) -> None:
    with pytest.raises(InvalidQuery, match="colour"):
        archive.find({"colour": 1})
    with pytest.raises(InvalidKey):
        archive.find({"dataKey": "a..b"})


def test_a_closed_archive_says_so(open_archive: Open) -> None:
    archive = open_archive()
    archive.close()
    archive.close()
    with pytest.raises(BackendError, match="closed"):
        archive.find({})
    with pytest.raises(BackendError, match="closed"):
        archive.insert([item()])


def test_readers_and_the_writer_work_at_the_same_time(archive: ArchiveDriver) -> None:
    counts: list[list[int]] = [[], []]

    def read(mine: list[int]) -> None:
        while not mine or mine[-1] < 500:
            mine.append(len(archive.find({"dataKey": "a.b.c"})))

    readers = [threading.Thread(target=read, args=(mine,)) for mine in counts]
    for reader in readers:
        reader.start()
    for start in range(1, 500, 50):
        archive.insert([item(n=n) for n in range(start, start + 50)])
    for reader in readers:
        reader.join(60)
    assert all(mine == sorted(mine) and mine[-1] == 500 for mine in counts)


KEYS = ["a.b", "a.b.c", "a.x.c", "a.b.c:f=1", "a.b.c:f=2,g=1", "b"]
PATTERNS = [*KEYS, "a.*.c", "a.**", "**", "*", "a.b.c:f=*", "a.*.c:f=1|2"]
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([0.5, 1.0, float("nan"), float("inf")]),
    st.sampled_from(["", "x", "xy"]),
    st.sampled_from([b"", b"x"]),
)
values = st.one_of(
    scalars,
    st.lists(scalars, max_size=3),
    st.dictionaries(
        st.sampled_from(["p", "q"]), st.one_of(scalars, st.lists(scalars, max_size=2)), max_size=2
    ),
)
items_strategy = st.lists(
    st.tuples(
        st.sampled_from(KEYS), values, st.integers(0, 9), st.integers(0, 9), st.sampled_from(["i1", "i2"])
    ),
    max_size=12,
)
orderable = st.one_of(st.integers(-3, 3), st.sampled_from([1.0, float("nan")]), st.sampled_from(["", "x"]))
value_tests = st.one_of(
    values.filter(lambda v: not isinstance(v, dict)),
    st.builds(lambda op, v: {op: v}, st.sampled_from(["$gt", "$gte", "$lt", "$lte"]), orderable),
    st.builds(lambda op, v: {op: v}, st.sampled_from(["$eq", "$ne"]), values),
    st.builds(lambda op, v: {op: v}, st.sampled_from(["$in", "$nin"]), st.lists(scalars, max_size=3)),
    st.builds(lambda v: {"$exists": v}, st.booleans()),
    st.builds(lambda v: {"$size": v}, st.integers(0, 2)),
    st.just({"$regex": "^X", "$options": "i"}),
)
time_tests = st.one_of(
    st.integers(T0, T0 + 9),
    st.builds(
        lambda op, v: {op: v}, st.sampled_from(["$gt", "$gte", "$lt", "$lte", "$ne"]), st.integers(T0, T0 + 9)
    ),
    st.builds(lambda v: {"$not": {"$in": v}}, st.lists(st.integers(T0, T0 + 9), max_size=3)),
)
key_tests = st.one_of(
    st.sampled_from(PATTERNS),
    st.builds(
        lambda op, v: {op: v},
        st.sampled_from(["$in", "$nin"]),
        st.lists(st.sampled_from(PATTERNS), max_size=2),
    ),
    st.builds(lambda v: {"$ne": v}, st.sampled_from(PATTERNS)),
    st.just({"$regex": "c$"}),
)
clauses = st.fixed_dictionaries(
    {},
    optional={
        "dataKey": key_tests,
        "timestamp": time_tests,
        "eventTime": time_tests,
        "value": value_tests,
        "value.p": value_tests,
        "instanceId": st.sampled_from(["i1", {"$ne": "i1"}, {"$in": ["i2"]}, {"$gt": "i1"}]),
        "sequence": st.builds(lambda v: {"$lte": v}, st.integers(0, 12)),
    },
)
queries = st.recursive(
    clauses,
    lambda inner: st.builds(
        lambda op, parts, rest: {**rest, op: parts},
        st.sampled_from(["$and", "$or", "$nor"]),
        st.lists(inner, min_size=1, max_size=3),
        clauses,
    ),
    max_leaves=4,
)


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(rows=items_strategy, wanted=st.lists(queries, min_size=3, max_size=6), framed=st.booleans())
def test_every_query_answers_like_the_naive_twin(archive: ArchiveDriver, rows, wanted, framed: bool) -> None:
    archive.prune(max_bytes=0)
    stored = [
        Item(key, value, T0 + time, T0 + event, f"app-{instance}", instance, n)
        for n, (key, value, time, event, instance) in enumerate(rows)
    ]
    if framed:
        archive.insert_frames([pack([one]) for one in stored])
    else:
        archive.insert(stored)
    for query in wanted:
        found = [(i.key, i.sequence) for i in archive.find(query)]
        assert found == [(i.key, i.sequence) for i in naive_find(stored, query)], query
