"""Lost connections come back by themselves, and what was lost meanwhile is counted, never silent."""

import os
import signal
from typing import Any

import pytest

from due import PUB_ONLY, Capability
from due.drivers.base import Delivery
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis import RedisUpdates
from due.drivers.redis_streams import work_name
from due.drivers.redis_wire import Wire, client
from due.errors import Timeout
from tests.due.conftest import wait_for


def _kill_all(url: str, kind: str) -> None:
    wire = Wire(url)
    wire.call("CLIENT", "KILL", "TYPE", kind, "SKIPME", "yes")
    wire.close()


def test_killed_connections_of_a_reliable_stream_lose_nothing(make_engine, tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        init = {"capabilities": [Capability("r.kill", delivery="reliable")]}
        producer = make_engine("producer", url=server.url, init=init)
        consumer = make_engine("consumer", url=server.url)
        got: list[Any] = []
        consumer.observe("r.kill").subscribe(lambda item: got.append(item.value))
        for round_ in range(5):
            for number in range(2000):
                producer.write("r.kill", round_ * 2000 + number, [PUB_ONLY])
            _kill_all(server.url, "normal")
        producer.flush()
        wait_for(lambda: len(got) >= 10_000)
        assert got == list(range(10_000))
        assert producer.health()["updates"]["reconnects"] > 0
        producer.close()
        consumer.close()


def test_gaps_of_a_best_effort_key_are_counted(make_engine, tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        producer, consumer = make_engine("producer", url=server.url), make_engine("consumer", url=server.url)
        got: list[Any] = []
        consumer.observe("b.kill").subscribe(lambda item: got.append(item.value))
        producer.write("b.kill", 0, [PUB_ONLY])
        wait_for(lambda: got)
        reconnects = consumer.health()["receiving"]["reconnects"]
        _kill_all(server.url, "pubsub")
        wait_for(lambda: consumer.health()["receiving"]["reconnects"] > reconnects)
        number = 0
        while len(got) < 2:
            number += 1
            producer.write("b.kill", number, [PUB_ONLY])
            producer.flush()
        assert consumer.health()["receiving"]["gaps"] == got[1] - 1
        producer.close()
        consumer.close()


def _expire_all(commands: Any) -> None:
    """As a clock does that jumps by more than a day."""
    for name in commands.scan_iter():
        if commands.ttl(name) >= 0:
            commands.expire(name, 0)


@pytest.mark.parametrize("later", [2100, 2000], ids=["written-on", "idle"])
@pytest.mark.parametrize(
    "lose", [_expire_all, lambda commands: commands.flushall()], ids=["expired", "flushed"]
)
def test_what_a_server_loses_without_a_restart_is_sent_again(tmp_path, monkeypatch, lose, later):
    monkeypatch.setattr("due.drivers.redis_publisher.CARE_SECONDS", 0.2)
    with EmbeddedServer(tmp_path / "u") as server:
        updates, commands = RedisUpdates(server.url), client(server.url)
        publisher, receiver = updates.publisher("producer"), updates.receiver("group", "one")
        found: set[int] = set()

        def read_to(count: int) -> bool:
            publisher.poll()
            receiver.renew()
            for delivery in receiver.receive(0.05):
                found.add(int(delivery.payload))
                receiver.acknowledge(delivery)
            return len(found) >= count

        receiver.follow("r.lost")
        receiver.subscribe("r.lost")
        publisher.append("r.lost", b"0")
        wait_for(lambda: read_to(1))
        for number in range(1, 2000):
            publisher.append("r.lost", b"%d" % number)
        publisher.settle(10)
        wait_for(lambda: read_to(100))
        lose(commands)
        for number in range(2000, later):
            publisher.append("r.lost", b"%d" % number)
        wait_for(lambda: read_to(later))
        assert found == set(range(later))
        publisher.close()
        receiver.close()
        commands.close()


@pytest.mark.parametrize("ends", [False, True], ids=["goes-on", "ends"])
def test_what_is_set_aside_during_an_outage_is_stored_afterwards(tmp_path, ends):
    """It is acknowledged: nobody would ever see it again."""
    with EmbeddedServer(tmp_path / "u", durable=True) as server:
        updates = RedisUpdates(server.url)
        publisher, receiver = updates.publisher("producer"), updates.receiver("group", "one")
        receiver.follow("r.outage")
        for number in range(3):
            publisher.append("r.outage", b"%d" % number)
        publisher.settle(10)
        found: list[Delivery] = []
        wait_for(lambda: found.extend(receiver.receive(0.05)) or len(found) == 3)
        server.kill()
        for delivery in found:
            receiver.set_aside(delivery, delivery.payload, "what it needs is away")
            receiver.acknowledge(delivery)
        counts = receiver.statistics()
        assert (counts["set_aside"], counts["set_aside_waiting"], counts["set_aside_lost"]) == (0, 3, 0)
        server.start()
        if not ends:
            wait_for(lambda: (receiver.receive(0.05), receiver.statistics()["set_aside"] == 3)[1])
        receiver.close()
        assert receiver.statistics()["set_aside_waiting"] == 0
        other = updates.receiver("group", "two")
        assert other.aside() == [(b"%d" % number, "what it needs is away") for number in range(3)]
        for half in (other, publisher):
            half.close()


def test_foreign_and_newer_payloads_are_counted_and_skipped(make_engine, server, caplog):
    engine = make_engine("tolerant")
    got: list[Any] = []
    engine.observe("b.garbage").subscribe(lambda item: got.append(item.value))
    wire = Wire(server.url)
    for payload in (b"garbage", b"DUE\x01garbage", b"DUE\x02later", b"", b"DUE\x02later"):
        wire.call("PUBLISH", "due:b.garbage", payload)
    wire.close()
    engine.write("b.garbage", "fine", [PUB_ONLY])
    wait_for(lambda: got == ["fine"])
    counts = engine.health()["receiving"]
    assert (counts["undecodable"], counts["newer_version"]) == (3, 2)
    assert caplog.text.count("refused a frame") == 2


def test_instances_of_a_shared_app_divide_a_stream(make_engine, monkeypatch):
    # or one that gets no core for seconds is taken for dead, and its part given to the other too
    monkeypatch.setattr("due.drivers.redis_dead_members.SILENT_SECONDS", 600.0)
    init = {"capabilities": [Capability("r.shared", delivery="reliable")]}
    producer = make_engine("divider", init=init, frame_bytes=50)
    got: dict[str, list[Any]] = {name: [] for name in "ab"}
    for name in "ab":
        worker = make_engine("worker", init={"instances": "shared"})
        worker.observe("r.shared").subscribe(lambda item, name=name: got[name].append(item.value))
    number = 0
    while not all(got.values()):
        for _ in range(200):
            producer.write("r.shared", number, [PUB_ONLY])
            number += 1
        producer.flush()
    wait_for(lambda: sum(map(len, got.values())) == number)
    assert sorted(got["a"] + got["b"]) == list(range(number))


def test_a_withdrawn_interest_leaves_no_list_behind(make_engine, tmp_path, monkeypatch):
    monkeypatch.setattr("due.drivers.redis_upkeep._WITHDRAWN_SECONDS", 0.1)
    with EmbeddedServer(tmp_path / "u") as server:
        init = {"capabilities": [Capability("r.gone", delivery="reliable")]}
        producer = make_engine("producer", url=server.url, init=init)
        consumers = [make_engine("consumer", url=server.url) for _ in range(2)]
        got: list[Any] = []
        subscriptions = [
            c.observe("r.gone").subscribe(lambda item: got.append(item.value)) for c in consumers
        ]
        producer.write("r.gone", 1, [PUB_ONLY])
        wait_for(lambda: got == [1])
        subscriptions[0].dispose()
        consumers[0].close()
        assert _lists(server.url) == 1, "the other instance still reads"
        subscriptions[1].dispose()
        wait_for(lambda: _lists(server.url) == 0)
        producer.write("r.gone", 2, [PUB_ONLY])
        producer.flush()
        consumers[1].observe("r.gone").subscribe(lambda item: got.append(item.value))
        producer.write("r.gone", 3, [PUB_ONLY])
        wait_for(lambda: 3 in got)
        assert got == [1, 3], "nothing of the time in between"
        for engine in (producer, *consumers):
            engine.close()


def _lists(url: str) -> int:
    wire = Wire(url)
    lists = wire.call("EXISTS", work_name("consumer", "r.gone"))
    wire.close()
    return int(lists)


def test_flush_ends_in_time_on_a_server_that_hangs(tmp_path):
    """Its connection is open, and nothing comes."""
    with EmbeddedServer(tmp_path / "u") as server:
        publisher = RedisUpdates(server.url).publisher("writer")
        os.kill(server.pid, signal.SIGSTOP)
        publisher.append("r.hung", b"1")
        with pytest.raises(Timeout, match="did not acknowledge within"):
            publisher.settle(0.2)
        os.kill(server.pid, signal.SIGCONT)
        publisher.settle(60)
        publisher.close()
