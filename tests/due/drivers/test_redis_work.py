"""A group's work list says how far it is with a stream: nothing is left out, and nobody else's word counts."""

import pytest

from due import PUB_ONLY, Capability
from due.drivers.redis_streams import readers_name, stream_name, work_name
from due.drivers.redis_wire import client
from due.drivers.redis_work import WorkLists
from tests.due.conftest import wait_for


@pytest.fixture
def commands(server):
    made = client(server.url)
    yield made
    made.close()


def _stream(commands, path: str, count: int) -> list[bytes]:
    return [commands.xadd(stream_name(path), {"f": str(number)}) for number in range(count)]


def _begins_behind(commands, path: str) -> bytes:
    found: bytes = commands.xinfo_stream(work_name("group", path))["last-generated-id"]
    return found


def test_a_list_begins_where_it_is_told_to(commands):
    ids = _stream(commands, "w.begin", 3)
    lists = WorkLists(commands, "group")
    for start, place in (
        ("$", ids[2]),
        ("0", b"0-0"),
        (ids[1].decode(), ids[1]),
        ("99999999999999-0", ids[2]),
    ):
        lists.make("w.begin", start, reset=True)
        assert _begins_behind(commands, "w.begin") == place
    lists.make("w.begin", "0", reset=False)
    assert _begins_behind(commands, "w.begin") == ids[2], "a list that is there stays"
    lists.make("w.nothing", "$", reset=False)
    assert _begins_behind(commands, "w.nothing") == b"0-0"


def test_what_members_have_not_acknowledged_stays_when_a_list_is_moved(commands):
    path, name = "w.moved", work_name("group", "w.moved")
    ids = _stream(commands, path, 4)
    lists = WorkLists(commands, "group")
    lists.make(path, "0", reset=False)
    for token in ids[:2]:
        commands.xadd(name, {"i": ""}, id=token)
    commands.xreadgroup("group", "one", {name: ">"})
    commands.xack(name, "group", ids[0])
    lists.make(path, "$", reset=True)
    ((_, entries),) = commands.xreadgroup("group", "two", {name: ">"})
    assert [token for token, _ in entries] == [ids[1]]
    assert _begins_behind(commands, path) == ids[3]


def test_a_group_of_an_earlier_version_goes_on_where_it_was(commands):
    """There a group's place was on the stream itself."""
    for path, done in (("w.done", 3), ("w.open", 1)):
        ids = _stream(commands, path, 5)
        commands.xgroup_create(stream_name(path), "group", "0")
        commands.xreadgroup("group", "one", {stream_name(path): ">"}, count=3)
        commands.xack(stream_name(path), "group", *ids[:done])
        WorkLists(commands, "group").make(path, "$", reset=False)
        begin = _begins_behind(commands, path)
        assert ids[done - 1] <= begin < ids[done]


def test_whoever_claims_work_whose_payload_is_gone_is_told_so(commands):
    path, name = "w.gone", work_name("group", "w.gone")
    ids = _stream(commands, path, 2)
    lists = WorkLists(commands, "group")
    lists.make(path, "0", reset=False)
    for token in ids:
        commands.xadd(name, {"i": ""}, id=token)
    commands.xreadgroup("group", "dead", {name: ">"})
    commands.xtrim(stream_name(path), minid=ids[1], approximate=False)
    found = lists.take(path, "one", dict.fromkeys(ids, 2))
    assert found == [(ids[0].decode(), None), (ids[1].decode(), b"1")]


def test_a_crowd_of_made_up_readers_hides_no_real_one(make_engine, commands, monkeypatch):
    monkeypatch.setattr("due.drivers.redis_publisher.CARE_SECONDS", 0.2)
    init = {"capabilities": [Capability("w.crowd", delivery="reliable")]}
    names = [f"nobody{number}" for number in range(3000)]
    commands.sadd(readers_name("w.crowd"), *names)
    producer, consumer = make_engine("producer", init=init, window_bytes=10_000), make_engine("consumer")
    got = []
    consumer.observe("w.crowd").subscribe(lambda item: got.append(item.value))
    sent = 0

    def only_real_ones() -> bool:
        nonlocal sent
        for _ in range(50):
            producer.write("w.crowd", sent, [PUB_ONLY])
            sent += 1
        producer.flush()
        return commands.smembers(readers_name("w.crowd")) - {b"consumer"} == set() and len(got) > 0

    wait_for(only_real_ones)
    wait_for(lambda: len(got) >= sent)
    assert got == list(range(sent))
