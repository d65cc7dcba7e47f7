"""Whatever else is put on the server, readers and producers go on, and nothing there grows without bound."""

from typing import Any

import pytest

from due import PUB_ONLY, Capability
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_aside import _MOST_BYTES, Aside, aside_name
from due.drivers.redis_leases import lease_name
from due.drivers.redis_streams import PRODUCERS, announced_name, readers_name, stream_name, work_name
from due.drivers.redis_wire import client
from tests.due.conftest import wait_for

RELIABLE = {"capabilities": [Capability("r.hostile", delivery="reliable")]}
NAMES = [b"\xff\xfe", b"", b"no slash", b"consumer/\xc3\x28", b"a/b/c", b"consumer/"]


def test_garbage_leases_announcements_entries_and_consumers_stop_nobody(make_engine, tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        commands = client(server.url)
        for name in (*NAMES, b"r.hostile.*", b"r..x", "r.\u00e4".encode(), b"r.x:y"):
            commands.sadd(PRODUCERS, name)
            commands.zadd(announced_name("producer"), {name: 2e9})
        producer = make_engine("producer", url=server.url, init=RELIABLE)
        consumer = make_engine("consumer", url=server.url)
        got: list[Any] = []
        consumer.observe("r.**").subscribe(lambda item: got.append(item.value))
        producer.write("r.hostile", 0, [PUB_ONLY])
        wait_for(lambda: got == [0])
        for name in NAMES:
            commands.hset(lease_name("consumer", "r.hostile"), name, "no number")
            commands.publish(announced_name("producer"), name)
            commands.xgroup_createconsumer(work_name("consumer", "r.hostile"), "consumer", name)
            commands.sadd(readers_name("r.hostile"), name)
        for fields in ({"f": "garbage"}, {"x": "y"}, {b"\xff": b"\xff", "f": b""}):
            commands.xadd(stream_name("r.hostile"), fields)
        commands.xadd(stream_name("r.hostile"), {"x": "pending of the dead"})
        for number in range(1, 200):
            producer.write("r.hostile", number, [PUB_ONLY])
        producer.flush()
        wait_for(lambda: got == list(range(200)))
        assert consumer.health()["receiving"]["undecodable"] >= 3
        for engine in (producer, consumer):
            engine.close()
        commands.close()


def test_foreign_entries_that_a_dead_member_left_stop_nobody(make_engine, tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        commands, name = client(server.url), stream_name("r.hostile")
        commands.sadd(PRODUCERS, "producer")
        commands.zadd(announced_name("producer"), {"r.hostile": 2e9})
        work = work_name("consumer", "r.hostile")
        commands.xgroup_create(work, "consumer", "0", mkstream=True)
        commands.xadd(work, {"i": ""}, id=commands.xadd(name, {"x": "y"}))
        commands.xreadgroup("consumer", b"\xff dead", {work: ">"})
        producer = make_engine("producer", url=server.url, init=RELIABLE)
        consumer = make_engine("consumer", url=server.url)
        got: list[Any] = []
        consumer.observe("r.hostile").subscribe(lambda item: got.append(item.value))
        producer.write("r.hostile", 1, [PUB_ONLY])
        wait_for(lambda: got == [1])
        assert consumer.health()["receiving"]["claimed"] == 1
        for engine in (producer, consumer):
            engine.close()
        commands.close()


def test_what_is_set_aside_is_bounded_in_bytes(server):
    commands = client(server.url)
    aside = Aside(commands, "bounded")
    for number in range(30):
        aside.put("a.b", b"%03d" % number + bytes(1 << 20), "failed")
        assert commands.memory_usage(aside_name("bounded"), samples=0) <= _MOST_BYTES
    assert aside.all()[-1][0].startswith(b"029"), "the latest stay"
    aside.put("a.b", bytes(5 << 20), "failed")
    assert aside.counts == {
        "set_aside": 31,
        "set_aside_cut": 1,
        "set_aside_waiting": 0,
        "set_aside_lost": 0,
    }
    assert all(len(payload) < 5 << 20 for payload, _ in aside.all()), "what was cut cannot be read"
    assert commands.ttl(aside_name("bounded")) > 0
    commands.close()


def test_a_reason_that_is_no_text_is_kept_as_far_as_it_is(server):
    """An error may quote a file's name, which is any bytes; nothing may end the thread of the callbacks."""
    commands = client(server.url)
    aside = Aside(commands, "quoting")
    aside.put("a.b", b"1", "OSError: \udcff.txt")
    assert aside.all() == [(b"1", "OSError: ?.txt")]
    commands.close()


@pytest.mark.parametrize("path", ["a.b", "r.hostile"])
def test_a_reader_has_a_limit_of_paths(make_engine, tmp_path, monkeypatch, caplog, path):
    monkeypatch.setattr("due.drivers.redis_reader._MOST_PATHS", 5)
    with EmbeddedServer(tmp_path / "u") as server:
        commands = client(server.url)
        commands.sadd(PRODUCERS, "producer")
        commands.zadd(announced_name("producer"), {f"{path}.p{n}": 2e9 for n in range(20)})
        consumer = make_engine("consumer", url=server.url)
        consumer.observe(f"{path}.**").subscribe(print)
        counts = consumer.health()["receiving"]
        assert (counts["read_paths"], counts["paths_refused"]) == (5, 15)
        assert caplog.text.count("reads at most 5 reliable paths") == 1
        consumer.close()
        commands.close()


def test_a_server_out_of_memory_holds_the_writer_back_and_loses_nothing(make_engine, tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        commands = client(server.url)
        producer = make_engine("producer", url=server.url, init=RELIABLE)
        consumer = make_engine("consumer", url=server.url)
        got: list[Any] = []
        consumer.observe("r.hostile").subscribe(lambda item: got.append(item.value))
        producer.write("r.hostile", 0, [PUB_ONLY])
        wait_for(lambda: got == [0])
        commands.config_set("maxmemory", 1)
        for number in range(1, 500):
            producer.write("r.hostile", number, [PUB_ONLY])
        wait_for(lambda: producer.health()["updates"]["refused"] > 0)
        commands.config_set("maxmemory", 0)
        producer.flush()
        wait_for(lambda: len(got) >= 500)
        assert got == list(range(500))
        for engine in (producer, consumer):
            engine.close()
        commands.close()


def test_streams_leases_and_places_expire_a_day_after_their_last_use(make_engine, tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        commands = client(server.url)
        producer = make_engine("producer", url=server.url, init=RELIABLE)
        producer.write("r.hostile", 0, [PUB_ONLY])
        producer.flush()
        wait_for(lambda: 0 < commands.ttl(stream_name("r.hostile")) <= 86_400)
        consumer = make_engine("consumer", url=server.url)
        consumer.observe("r.hostile").subscribe(print)
        wait_for(lambda: commands.ttl(lease_name("consumer", "r.hostile")) > 1000)
        wait_for(lambda: commands.ttl(announced_name("producer")) > 1000)
        assert producer.health()["updates"]["streams"] == 1
        for engine in (producer, consumer):
            engine.close()
        commands.close()
