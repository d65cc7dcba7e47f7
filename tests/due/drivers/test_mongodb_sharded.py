"""On a sharded MongoDB cluster: collections are sharded by key and time, and commands name the shard key."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymongo import MongoClient

from due.codec import pack
from due.drivers import mongodb
from due.drivers.mongodb import MongoArchive
from due.drivers.mongodb_apps import shard_keys_of
from due.drivers.mongodb_sharding import SHARD_KEYS, commands, shard
from due.messages import Item
from tests.due.drivers.mongo_router import MongoRouter, mongo_router

T0 = 1_700_000_000_000_000_000
BY_TIME = {"dataKey": 1, "timestamp": 1}


def items(count: int, *, key: str = "a.b", start: int = 1) -> list[Item]:
    return [Item(key, {"n": n}, T0 + n, T0 + n, "app", "i", n) for n in range(start, start + count)]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, MongoRouter]]:
    with mongo_router(tmp_path_factory.mktemp("cluster")) as made:
        yield made


@pytest.fixture
def router(cluster: tuple[str, MongoRouter]) -> Iterator[MongoRouter]:
    router = cluster[1]
    router.commands.clear()
    router.scattered.clear()
    yield router
    router.forbidden = ()


@pytest.fixture
def url(cluster: tuple[str, MongoRouter], request: pytest.FixtureRequest) -> str:
    return f"{cluster[0]}?collection={request.node.name}"


def test_collections_are_sharded_by_key_and_time_at_the_first_use(url: str, router: MongoRouter) -> None:
    name = "due_test." + url.rpartition("=")[2]
    for _ in range(2):
        archive = MongoArchive(url)
        archive.insert(items(1))
        archive.close()
    asked = [one for one in router.commands if next(iter(one)) in ("enableSharding", "shardCollection")]
    assert asked == [
        {"enableSharding": "due_test"},
        {"shardCollection": name, "key": BY_TIME},
        {"shardCollection": f"{name}_parts", "key": {"_id": "hashed"}},
    ], "once"


def test_the_collections_of_each_app_are_sharded(
    router: MongoRouter, cluster: tuple[str, MongoRouter]
) -> None:
    with MongoClient[dict[str, Any]](cluster[0]) as client:
        shard(client["due_test"], shard_keys_of("kitsune"))
    asked = [one for one in router.commands if next(iter(one)) == "shardCollection"]
    assert asked == [
        {"shardCollection": "due_test.items__kitsune", "key": BY_TIME},
        {"shardCollection": "due_test.items_parts__kitsune", "key": {"_id": "hashed"}},
    ]


def test_documents_are_spread_and_none_is_stored_twice(url: str, router: MongoRouter) -> None:
    """The same item comes to the same shard, which knows it."""
    archive, other = MongoArchive(url), MongoArchive(url)
    for key in ("a.b", "a.c"):
        archive.insert(items(20, key=key))
        archive.insert_frames([pack(items(10, key=key, start=start)) for start in (21, 31, 11)])
        other.insert_frames([pack(items(10, key=key, start=start)) for start in (31, 41)])
        archive._store(archive._table(), [mongodb._item_document(one) for one in items(20, key=key)])
    assert [one.sequence for one in archive.find({"dataKey": "a.b"})] == list(range(1, 51))
    held = [len(shard) for shard in router.documents("due_test", archive._name())]
    assert min(held) > 5
    assert sum(held) == 2 * (20 + 3)
    other.close()
    archive.close()


def test_reads_writes_and_retention_name_the_shard_key(
    url: str, router: MongoRouter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mongodb, "_PART_BYTES", 1000)
    archive = MongoArchive(url)
    archive.insert([*items(30), Item("a.large", bytes(5000), T0, T0, "app", "i", 1)])
    archive.insert_frames([pack(items(10, key="b.c"))])
    assert len(archive.find({"dataKey": "a.*", "timestamp": {"$gte": T0 + 10}})) == 21
    assert archive.find({"timestamp": {"$lt": T0 + 1}})[0].value == bytes(5000)
    assert len(archive.find({"dataKey": "a.b"}, limit=3)) == 3
    assert archive.prune(before=T0 + 6) == 6
    assert archive.prune(max_bytes=0) == 35
    for companion in ("", "parts"):
        assert router.documents("due_test", archive._name(companion)) == [[], []]
    assert router.scattered == []
    archive.close()


def test_who_may_not_shard_is_told_what_to_run_and_goes_on(
    url: str, router: MongoRouter, caplog: pytest.LogCaptureFixture
) -> None:
    router.forbidden = ("enableSharding", "shardCollection", "collStats")
    archive = MongoArchive(url)
    with caplog.at_level(logging.WARNING, logger="due.archive"):
        archive.insert(items(3))
    name = archive._name()
    (said,) = (one.getMessage() for one in caplog.records)
    assert "not authorized" in said
    assert said.endswith(
        'sh.enableSharding("due_test"); '
        f'sh.shardCollection("due_test.{name}", {{dataKey: 1, timestamp: 1}}); '
        f'sh.shardCollection("due_test.{name}_parts", {{_id: "hashed"}})'
    )
    assert len(archive.find({"dataKey": "a.b"})) == 3
    assert archive.prune(max_bytes=0) == 3, "without the server's own count"
    archive.close()


def test_a_shard_key_of_the_operators_is_kept(
    url: str, router: MongoRouter, caplog: pytest.LogCaptureFixture
) -> None:
    name = "due_test." + url.rpartition("=")[2]
    router.sharded[name] = {"dataKey": "hashed", "timestamp": 1}
    router.forbidden = ("collStats",)  # then only the attempt tells
    archive = MongoArchive(url)
    archive.insert(items(5))
    assert [one.sequence for one in archive.find({"dataKey": "a.b"})] == [1, 2, 3, 4, 5]
    assert router.sharded[name] == {"dataKey": "hashed", "timestamp": 1}
    assert not caplog.records
    archive.close()


def test_a_server_that_is_no_cluster_is_not_asked_to_shard(
    url: str, router: MongoRouter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.due.drivers.mongo_router._HELLO", _single_server())
    archive = MongoArchive(url)
    archive.insert(items(1))
    assert not [one for one in router.commands if next(iter(one)) in ("enableSharding", "shardCollection")]
    archive.close()


def test_the_documentation_has_the_commands() -> None:
    text = (Path(__file__).parents[3] / "docs" / "operations.md").read_text(encoding="utf-8")
    keys = {"items": SHARD_KEYS[""], "items_parts": SHARD_KEYS["parts"]}
    for line in list(commands("sdnator", keys))[1:]:
        assert line + "\n" in text


def _single_server() -> dict[str, object]:
    from tests.due.drivers.mongo_router import _HELLO

    return {name: value for name, value in _HELLO.items() if name != "msg"}
