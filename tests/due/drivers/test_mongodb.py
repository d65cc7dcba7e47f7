"""The MongoDB archive over a real connection: outages, large payloads, plain documents for other readers."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from pymongo import MongoClient
from pymongo.monitoring import (
    CommandFailedEvent,
    CommandListener,
    CommandStartedEvent,
    CommandSucceededEvent,
)

from due.codec import pack
from due.drivers import mongodb, mongodb_retention
from due.drivers.mongodb import MongoArchive
from due.errors import ArchiveUnavailable, BackendError, InvalidOption
from due.messages import Item, PackedFrame
from tests.due.conftest import wait_for
from tests.due.drivers.mongo_server import PATIENT, mongo_server, nx_server

T0 = 1_700_000_000_000_000_000


def items(count: int, *, key: str = "a.b", start: int = 1) -> list[Item]:
    return [Item(key, {"n": n}, T0 + n, T0 + n, "app", "i", n) for n in range(start, start + count)]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with mongo_server(tmp_path_factory.mktemp("mongo")) as url:
        yield url


@pytest.fixture
def url(server: str, request: pytest.FixtureRequest) -> str:
    return f"{server}?{PATIENT}&collection={request.node.name.partition('[')[0]}"


@pytest.fixture
def archive(url: str) -> Iterator[MongoArchive]:
    archive = MongoArchive(url)
    yield archive
    archive.prune(max_bytes=0)
    archive.close()


@pytest.mark.parametrize(
    "url",
    [
        "mongodb://",
        "mongodb:///db",
        "sqlite:///x",
        "mongodb://host/a/b",
        "mongodb://host/?authMechanism=nonsense",
    ],
)
def test_wrong_urls_are_refused(url: str) -> None:
    with pytest.raises(InvalidOption, match="mongodb"):
        MongoArchive(url)


def test_a_password_is_not_shown() -> None:
    archive = MongoArchive("mongodb://user:secret@127.0.0.1:1/db?serverSelectionTimeoutMS=50")
    with pytest.raises(ArchiveUnavailable) as raised:
        archive.find({})
    assert "secret" not in str(raised.value)
    archive.close()


def test_a_server_that_is_away_is_unavailable_and_then_takes_all(tmp_path: Path) -> None:
    frames = [pack(items(10, start=start)) for start in (1, 11)]
    with nx_server(tmp_path, db=str(tmp_path / "nx.db")) as url:
        archive = MongoArchive(url + "?serverSelectionTimeoutMS=300")
        wait_for(lambda: _taken(archive, frames[:1]))
    with pytest.raises(ArchiveUnavailable):
        archive.insert_frames(frames)
    port = int(url.rpartition(":")[2].partition("/")[0])
    with nx_server(tmp_path, db=str(tmp_path / "nx.db"), port=port):
        wait_for(lambda: _taken(archive, frames))
        assert [item.sequence for item in archive.find({"dataKey": "a.b"})] == list(range(1, 21))
        archive.close()


def _taken(archive: MongoArchive, frames: list[PackedFrame]) -> bool:
    """Whether it takes them now; a server that comes up may be too slow for one try."""
    try:
        archive.insert_frames(frames)
    except ArchiveUnavailable:
        return False
    return True


def test_payloads_beyond_a_documents_size_are_stored_in_parts(
    archive: MongoArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mongodb, "_PART_BYTES", 1000)
    value = bytes(range(256)) * 20
    large = Item("a.large", value, T0, T0, "app", "i", 1)
    archive.insert_frames([pack([large])])
    archive.insert_frames([pack([large])])
    (found,) = archive.find({"dataKey": "a.large"})
    assert found == large
    assert archive.prune(before=T0 + 1) == 1
    assert archive.find({}) == []


def test_many_old_documents_are_deleted_some_at_a_time(
    archive: MongoArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mongodb_retention, "_STEP", 7)
    for key in ("a.b", "a.c"):
        archive.insert(items(30, key=key))
    assert archive.prune(before=T0 + 22) == 2 * 21
    assert [item.sequence for item in archive.find({"dataKey": "a.b"})] == list(range(22, 31))
    assert archive.prune(max_bytes=0) == 2 * 9


def test_of_a_large_document_whose_deletion_is_interrupted_nothing_stays(
    archive: MongoArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mongodb, "_PART_BYTES", 1000)
    archive.insert([Item("a.large", bytes(5000), T0, T0, "app", "i", 1)])
    with monkeypatch.context() as broken:
        broken.setattr(mongodb_retention, "naming", _interrupted)
        with pytest.raises(BackendError):
            archive.prune(before=T0 + 1)
    assert archive.prune(before=T0 + 1) == 1
    for companion in ("", "parts"):
        assert list(archive._table(companion).find({})) == []


class Delivered(CommandListener):
    """Counts the documents that a server sends in answers to queries."""

    def __init__(self) -> None:
        self.documents = 0

    def started(self, _event: CommandStartedEvent) -> None:
        """Nothing to count yet."""

    def failed(self, _event: CommandFailedEvent) -> None:
        """Nothing was sent."""

    def succeeded(self, event: CommandSucceededEvent) -> None:
        """An answer."""
        cursor = event.reply.get("cursor", {})
        self.documents += len(cursor.get("firstBatch", ())) + len(cursor.get("nextBatch", ()))


@pytest.mark.parametrize(
    "query",
    [
        {"dataKey": "a.b"},
        {"dataKey": "a.*"},
        {"dataKey": "a.*", "timestamp": {"$lt": T0 + 2000}, "appId": "app"},
    ],
)
def test_of_a_large_collection_no_more_documents_are_read_than_a_limit_needs(
    url: str, archive: MongoArchive, query: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    for key in ("a.b", "a.c"):
        archive.insert(items(2000, key=key))
    delivered = Delivered()
    monkeypatch.setattr(
        mongodb, "client_of", lambda url: MongoClient(url, w="majority", event_listeners=[delivered])
    )
    counted = MongoArchive(url)
    found = counted.find(query, limit=10)
    counted.close()
    assert found == archive.find(query)[-10:]
    assert delivered.documents <= 2 * 100 + 3 * 16 + 10


def _interrupted(_: object) -> None:
    raise BackendError("interrupted")


def test_other_clients_read_plain_documents(archive: MongoArchive, url: str) -> None:
    archive.insert_frames([pack(items(2), index=True)])
    client: MongoClient[dict[str, object]] = MongoClient(url.partition("?")[0])
    collection = client.get_default_database()["test_other_clients_read_plain_documents"]
    document = collection.find_one({"dataKey": {"$eq": "a.b"}, "value.n": {"$eq": 2}})
    client.close()
    assert document is not None
    shown = {
        name: document[name]
        for name in ("value", "timestamp", "eventTime", "appId", "instanceId", "sequence")
    }
    assert shown == {
        "value": {"n": 2},
        "timestamp": T0 + 2,
        "eventTime": T0 + 2,
        "appId": "app",
        "instanceId": "i",
        "sequence": 2,
    }


def test_wide_frames_are_found_by_another_reader(archive: MongoArchive, url: str) -> None:
    wide = [Item("a.wide", n, T0 + n * 10**9, T0 + n, "app", "i", n) for n in range(1, 11)]
    archive.insert_frames([pack(wide)])
    reader = MongoArchive(url)
    assert [i.value for i in reader.find({"dataKey": "a.*", "timestamp": {"$gte": T0 + 9 * 10**9}})] == [
        9,
        10,
    ]
    reader.close()


def test_names_that_bson_does_not_take_are_still_found(archive: MongoArchive) -> None:
    value = {"a.b": 1, "$c": 2, "": 3, "big": 2**63 - 1}
    archive.insert([Item("a", value, T0, T0, "app", "i", 1)])
    (found,) = archive.find({"value.$c": 2})
    assert found.value == value
    assert len(archive.find({"value.big": {"$gt": 2**62}})) == 1


def test_a_damaged_document_costs_that_document_only(archive: MongoArchive) -> None:
    archive.insert([Item("a.b", n, n, n, "app", "i", n) for n in range(1, 7)])
    table = archive._table()
    table.update_one({"sequence": {"$eq": 5}}, {"$set": {"payload": 7}})
    table.update_one({"sequence": {"$eq": 2}}, {"$set": {"payload": b"no frame"}})
    table.update_one({"sequence": {"$eq": 3}}, {"$unset": {"instanceId": ""}})
    table.update_one({"sequence": {"$eq": 4}}, {"$set": {"parts": "many"}})
    assert [item.value for item in archive.find({"dataKey": "a.b"})] == [1, 6]
    assert [item.value for item in archive.find({"dataKey": "a.b"}, limit=1)] == [6]


def test_keys_go_a_while_after_their_last_document_and_come_back(
    archive: MongoArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive.insert(items(3, key="gone"))
    archive.insert([Item("stays", 1, 2 * T0, 2 * T0, "app", "i", 1)])
    keys = archive._table("keys")
    assert archive.prune(before=T0 + 100) == 3
    assert {key["_id"] for key in keys.find({})} == {"gone", "stays"}, "not at once"
    monkeypatch.setattr(mongodb_retention, "_EMPTY_SECONDS", 0.0)
    monkeypatch.setattr(mongodb, "_NOTE_SECONDS", 0.0)
    archive.prune(before=T0 + 100)
    assert {key["_id"] for key in keys.find({})} == {"stays"}
    archive.insert(items(3, key="gone", start=10))
    assert len(archive.find({"dataKey": "gone"})) == 3


@pytest.mark.parametrize(
    ("options", "concern"),
    [("", {"w": "majority"}), ("?w=1", {"w": 1}), ("?replicaSet=r&W=2&journal=true", {"w": 2, "j": True})],
)
def test_writes_wait_for_a_majority_unless_the_url_says_otherwise(
    options: str, concern: dict[str, object]
) -> None:
    with mongodb.client_of(f"mongodb://127.0.0.1:1/due{options}") as client:
        assert client.write_concern.document == concern
