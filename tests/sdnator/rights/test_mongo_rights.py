"""On MongoDB each app writes collections of its own, and reads those of whom it observes."""

import os
import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymongo import MongoClient
from pymongo.errors import OperationFailure

from due.backends import open_archive
from due.drivers.lasting import Lasting
from due.drivers.mongodb_apps import MongoAppsArchive, collections_of, of_app
from due.drivers.redis_rights import Rights
from due.errors import InvalidOption
from due.messages import Item
from sdnator.app_catalogue import ENFORCERS, OURS
from sdnator.rights.granting import OPERATOR, granted, operator
from sdnator.rights.identities import made
from sdnator.rights.mongo_keeper import MongoRightsKeeper, apps_url, privileges
from sdnator.rights.watching_keeper import RightsRefused
from tests.due.drivers.mongo_server import PATIENT, mongo_server

T0 = 1_700_000_000_000_000_000
MINE = Rights(app="mine", publish=("network.anomaly.mine.**",), read=("network.open.door.*",))
KITSUNE = Rights(app="kitsune", publish=("network.anomaly.kitsune.*",), read=("network.anomaly.mine.**",))
DOOR = Rights(app="door", publish=("network.open.door.*",), observe=("network.anomaly.mine.**",))
COORDINATOR = Rights(app="coordinator", publish=("due.assignment.*",), read=("**",))
EVERYBODY = {"mine": MINE, "kitsune": KITSUNE, "door": DOOR, "coordinator": COORDINATOR, OPERATOR: operator()}


def _items(app: str, key: str, count: int, start: int = 1) -> list[Item]:
    return [Item(key, n, T0 + n, T0 + n, app, f"{app}1", n) for n in range(start, start + count)]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with mongo_server(tmp_path_factory.mktemp("mongo")) as url:
        yield f"{url}?{PATIENT}"


def test_apps_write_collections_of_their_own_and_read_all_that_they_may(server: str) -> None:
    """Over MongoDB's protocol; which of them may be read, only a real server says."""
    archives = {
        name: open_archive(of_app(f"{server}&collection=own", name)) for name in ("mine", "door", "keys")
    }
    for name, archive in archives.items():
        assert isinstance(archive, MongoAppsArchive)
        archive.insert(_items(name, f"network.x.{name}", 3))
    with MongoClient(server) as client:
        names = set(client.get_default_database().list_collection_names())
    assert {"own__mine", "own_keys__mine", "own__door", "own__keys", "own_keys__keys"} <= names
    reader = archives["mine"]
    found = reader.find({"dataKey": "network.x.*"})
    assert sorted((item.app_id, item.value) for item in found) == [
        (name, number) for name in sorted(archives) for number in (1, 2, 3)
    ]
    assert [item.timestamp for item in found] == sorted(item.timestamp for item in found)
    latest = reader.find({"dataKey": "network.x.*"}, limit=3)
    assert {item.timestamp for item in latest} == {T0 + 3}
    assert reader.prune(before=T0 + 2) == 3
    assert reader.prune(max_bytes=0) == 6
    assert reader.find({"dataKey": "network.x.*"}) == []
    for archive in archives.values():
        archive.close()


def test_one_limit_holds_for_the_collections_of_all_apps(server: str) -> None:
    """What lasts stays in each collection, whatever share of the limit that collection would have had."""
    archives = {name: open_archive(of_app(f"{server}&collection=limit", name)) for name in ("fw", "ctrl")}
    big = bytes(20_000)
    for app, key, numbers in (
        ("fw", "network.block.fw", range(1, 21)),
        ("fw", "network.x.fw", range(21, 41)),
        ("ctrl", "network.x.ctrl", range(1, 101)),
    ):
        archives[app].insert([Item(key, big, T0 + n, T0 + n, app, f"{app}1", n) for n in numbers])
    reader = archives["ctrl"]
    reader.prune(max_bytes=1_200_000, lasting=Lasting(("network.block.*",)))
    assert len(reader.find({"dataKey": "network.block.fw"})) == 20
    assert 20 <= len(reader.find({"dataKey": "network.x.*"})) <= 45
    assert reader.find({"dataKey": "network.x.fw"}), "each collection keeps its newest"
    reader.prune(max_bytes=400_000, lasting=Lasting(("network.block.*",)))
    left = [item.sequence for item in reader.find({"dataKey": "network.block.fw"})]
    assert 5 <= len(left) <= 11
    assert left == list(range(21 - len(left), 21))
    for archive in archives.values():
        archive.close()


def test_what_apps_shared_before_can_still_be_read(server: str) -> None:
    before = open_archive(f"{server}&collection=shared_before")
    before.insert(_items("mine", "network.x.mine", 2))
    now = open_archive(of_app(f"{server}&collection=shared_before", "mine"))
    now.insert(_items("mine", "network.x.mine", 1, start=3))
    assert [item.sequence for item in now.find({"dataKey": "network.x.mine"})] == [1, 2, 3]
    for archive in (before, now):
        archive.close()


def test_an_app_id_that_is_none_is_refused() -> None:
    with pytest.raises(InvalidOption, match="app id"):
        open_archive("mongodb://h/db?app=a.b")


def _may(name: str) -> dict[str, set[str]]:
    held = privileges(name, EVERYBODY, "due")
    assert all(one["resource"]["db"] == "due" for one in held)
    return {one["resource"]["collection"]: set(one["actions"]) for one in held}


def test_a_role_writes_its_own_and_reads_what_the_app_may_read() -> None:
    mine = _may("mine")
    assert {name for name, actions in mine.items() if actions - {"find"}} == {
        *("items__mine", "items_keys__mine", "items_parts__mine")
    }
    assert set(mine) == {name for app in ("mine", "door") for name in collections_of(app)}
    assert "remove" not in mine["items__mine"], "what was said stays said"
    assert "collStats" in mine["items__mine"], "whether it is sharded already"
    assert "items__mine" in _may("kitsune")
    assert "items__kitsune" not in mine
    assert "items__mine" not in _may("door"), "who may observe may not read from the archive"
    coordinator = _may("coordinator")
    assert all(
        {"remove", "collStats"} <= actions
        for name, actions in coordinator.items()
        if name not in collections_of("coordinator")
    )
    assert all(actions == {"find"} for name, actions in _may(OPERATOR).items() if "__operator" not in name)


def test_parts_of_the_product_read_the_collections_that_they_need() -> None:
    everybody = {name: granted(name).rights for name in (*OURS, *ENFORCERS, "coordinator", "dashboard")}
    reads = {
        name: {
            one["resource"]["collection"].removeprefix("items__") for one in privileges(name, everybody, "d")
        }
        for name in everybody
    }
    assert {"firewall", "sonata_adapter", "dashboard"} <= reads["firewall"]
    assert {"p4runtime_ctrl", "firewall", "sonata_adapter"} <= reads["p4runtime_ctrl"]
    assert {"sonata_adapter", "p4runtime_ctrl", "kitsune"} <= reads["sonata_adapter"]
    assert {"nftables", "firewall"} <= reads["nftables"]
    assert set(everybody) <= reads["dashboard"] & reads["coordinator"], "pages show any key"
    assert "firewall" not in reads["kitsune"]


def test_a_server_that_takes_no_users_is_told(server: str, tmp_path: Path) -> None:
    if os.environ.get("MONGODB_URL"):
        pytest.skip("$MONGODB_URL names a server that takes users")
    with pytest.raises(RightsRefused):
        MongoRightsKeeper(server, made(tmp_path, {"mine": MINE})).apply()


def test_a_real_server_refuses_an_app_every_collection_but_its_own(tmp_path: Path) -> None:
    url = os.environ.get("MONGODB_URL")
    if not url:
        # no package of Debian 12 or PyPI has a mongod
        pytest.skip("$MONGODB_URL names no mongod with --auth (CI does without it)")
    everybody = {name: rights for name, rights in EVERYBODY.items() if name != OPERATOR}
    identities = made(tmp_path, everybody)
    keeper = MongoRightsKeeper(url, identities)
    keeper.apply()
    theirs = open_archive(apps_url(url, identities, "kitsune"))
    theirs.insert(_items("kitsune", "network.anomaly.kitsune.score", 3))
    mine = open_archive(apps_url(url, identities, "mine"))
    mine.insert(_items("mine", "network.anomaly.mine.score", 3))
    assert {item.app_id for item in mine.find({"dataKey": "network.**"})} == {"mine"}
    assert {item.app_id for item in theirs.find({"dataKey": "network.**"})} == {"mine", "kitsune"}
    with MongoClient(apps_url(url, identities, "mine").replace("app=mine", "appName=mine")) as client:
        database = client.get_default_database()
        foreign = database["items__kitsune"]
        for attempt in (
            foreign.find_one,
            lambda: foreign.insert_one({}),
            lambda: foreign.update_many({}, {"$set": {"x": 1}}),
            lambda: foreign.delete_many({}),
            foreign.drop,
            lambda: foreign.create_index("x"),
            lambda: foreign.rename("items__mine2"),
            lambda: foreign.aggregate([{"$out": "items__mine"}]),
            lambda: database["items__mine"].aggregate([{"$out": "items__kitsune"}]),
            lambda: database["items__mine"].delete_many({}),
            lambda: database.command("createUser", "x", pwd=secrets.token_hex(), roles=[]),
            lambda: database.command("usersInfo"),
            lambda: client.drop_database(database.name),
        ):
            with pytest.raises(OperationFailure, match=r"not authorized|requires authentication"):
                attempt()
    with identities.changing():
        identities.remove("mine")
    keeper.apply()
    for archive in (mine, theirs):
        archive.close()
