"""A reader's place is held by its lease, and the lease ends with the reader."""

import select
import time

import pytest
import redis

from due.drivers.base import Delivery
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_leases import lease_name
from due.drivers.redis_reader import StreamReader
from due.drivers.redis_streams import stream_name, work_name
from due.drivers.redis_wire import client
from due.drivers.redis_work import COUNT, WorkLists
from tests.due.conftest import wait_for

PATH = "r.lease"


def test_a_lease_is_not_renewed_after_it_was_given_up(server):
    """The keeper's thread renews leases, and ends after the reader."""
    commands = client(server.url)
    for give_up in (StreamReader.close, lambda reader: reader.leave(lambda _path: False)):
        reader = StreamReader(server.url, commands, "group", "one", shared=False)
        reader.add(PATH, "0")
        assert commands.hgetall(lease_name("group", PATH))[b"one"] != b"0"
        give_up(reader)
        reader.renew()
        assert commands.hgetall(lease_name("group", PATH)) == {b"one": b"0"}
    commands.close()


@pytest.mark.parametrize("quiet", [True, False])
def test_what_was_acknowledged_is_pending_no_more(server, quiet):
    """Whether or not the server can keep its replies to acknowledgements for itself."""
    path, commands = f"r.quiet.{quiet}", client(server.url)
    reader = StreamReader(server.url, commands, "group", "one", shared=False)
    reader.add(path, "0")
    reader.care()
    assert reader._quiet
    reader._quiet = quiet
    for number in range(3):
        commands.xadd(stream_name(path), {"f": str(number)})
        for delivery in _read(reader):
            assert delivery.payload == str(number).encode()
            reader.acknowledge(delivery)
    assert commands.xpending(work_name("group", path), "group")["pending"] == 1, (
        "it goes with the next request"
    )
    reader.close()
    assert commands.xpending(work_name("group", path), "group")["pending"] == 0
    commands.close()


def _read(reader: StreamReader) -> list[Delivery]:
    """The next deliveries."""
    found: list[Delivery] = []
    while not found:
        reader.care()
        ready, _, _ = select.select([reader.fileno()], [], [], 30)
        found = reader.read(set(ready))
    return found


def _what_came(reader: StreamReader) -> list[Delivery]:
    """Deliveries of one wait, where the connection may be away."""
    reader.care()
    if reader.fileno() < 0:
        return []
    ready, _, _ = select.select([reader.fileno()], [], [], 0.05)
    return reader.read(set(ready))


class _NoLists:
    """A client whose connection is cut whenever it makes a list."""

    def __init__(self, commands):
        self._commands = commands
        self.cut = True

    def __getattr__(self, name):
        return getattr(self._commands, name)

    def pipeline(self, *details, **more):
        if self.cut:
            raise redis.ConnectionError("cut")
        return self._commands.pipeline(*details, **more)


@pytest.mark.parametrize(("start", "found"), [("0", [b"early", b"late"]), ("$", [b"late"])])
def test_a_list_that_could_not_be_made_is_made_later(server, start, found):
    """And nothing is lost from the moment it was asked for."""
    path, commands = f"r.unmade.{len(found)}", client(server.url)
    commands.xadd(stream_name(path), {"f": "early"})
    early_ms = int(commands.xinfo_stream(stream_name(path))["last-generated-id"].split(b"-")[0])
    wait_for(lambda: time.time() * 1000 > early_ms + 3)
    listless = _NoLists(commands)
    reader = StreamReader(server.url, listless, "group", "one", shared=False)
    reader.add(path, start)
    commands.xadd(stream_name(path), {"f": "late"})
    reader.care()
    listless.cut = False
    reader._look_at = 0.0
    assert [delivery.payload for delivery in _read(reader)] == found
    reader.close()
    commands.close()


def test_what_is_long_on_its_way_is_sent_once(server, monkeypatch):
    """On a slow link: what was read ahead is used however late it comes, if it still comes next."""
    monkeypatch.setattr("due.drivers.redis_work.FRESH_SECONDS", 0.0)
    path, commands, size, batches = "r.slow", client(server.url), 10_000, 6
    for _ in range(batches * COUNT):
        commands.xadd(stream_name(path), {"f": b"." * size})
    reader = StreamReader(server.url, commands, "slow", "one", shared=False)
    reader.add(path, "0")
    before = commands.info("stats")["total_net_output_bytes"]
    found: list[Delivery] = []
    while len(found) < batches * COUNT:
        reader._at.clear()  # as when it looks after the dead
        found += _read(reader)
    sent = commands.info("stats")["total_net_output_bytes"] - before
    assert len({delivery.token for delivery in found}) == len(found)
    assert sent < 1.1 * size * len(found)
    reader.close()
    commands.close()


def test_what_is_on_its_way_while_it_looks_after_the_dead_is_used(server):
    """On a slow link an answer may take longer than until the next look: it would never get further."""
    path, commands, size, batches = "r.looks", client(server.url), 10_000, 6
    for _ in range(batches * COUNT):
        commands.xadd(stream_name(path), {"f": b"." * size})
    reader = StreamReader(server.url, commands, "looks", "one", shared=True)  # which never reads ahead
    reader.add(path, "0")
    before = commands.info("stats")["total_net_output_bytes"]
    found: list[Delivery] = []
    while len(found) < batches * COUNT:
        reader.care()
        if ("new", "", "") in reader._expected:
            reader._look_at = 0.0
            reader.care()
        ready, _, _ = select.select([reader.fileno()], [], [], 30)
        found += reader.read(set(ready))
        sent = commands.info("stats")["total_net_output_bytes"] - before
        assert sent < 1.1 * size * batches * COUNT, "nothing was thrown away"
    assert len({delivery.token for delivery in found}) == len(found)
    reader.close()
    commands.close()


def test_alone_in_a_group_it_looks_after_the_dead_more_rarely(server):
    commands = client(server.url)
    reader = StreamReader(server.url, commands, "alone", "one", shared=False)
    reader.add("r.alone", "0")
    reader.care()
    assert reader._alone
    commands.xadd(work_name("alone", "r.alone"), {"i": ""})
    commands.xreadgroup("alone", "other", {work_name("alone", "r.alone"): ">"})
    reader._look_at = 0.0
    reader.care()
    assert not reader._alone
    reader.close()
    commands.close()


@pytest.mark.parametrize("fresh", [0.0, 600.0])
def test_a_list_that_another_member_moves_is_read_from_there(server, monkeypatch, fresh):
    """Also by a member that has read ahead, however long its callbacks take."""
    monkeypatch.setattr("due.drivers.redis_work.FRESH_SECONDS", fresh)
    path, commands = f"r.moved.{int(fresh)}", client(server.url)
    reader = StreamReader(server.url, commands, "group", "one", shared=False)
    reader.add(path, "0")
    wanted = [b"%d" % number for number in range(3 * COUNT)]
    for payload in wanted:
        commands.xadd(stream_name(path), {"f": payload})
    first = _read(reader)
    while first[-1].payload != wanted[-1]:
        first += _read(reader)
    assert [delivery.payload for delivery in first] == wanted
    for delivery in first:
        reader.acknowledge(delivery)
    WorkLists(commands, "group").make(path, "0", reset=True)
    again: list[bytes] = []
    while not again or again[-1] != wanted[-1]:
        again += [delivery.payload for delivery in _read(reader)]
    assert again == wanted
    reader.close()
    commands.close()


def test_an_acknowledgement_is_for_the_life_of_the_server_that_it_is_of(tmp_path):
    """Where the clock was put back, another entry may have the same id after a restart."""
    with EmbeddedServer(tmp_path / "u") as server:
        commands = client(server.url)
        reader = StreamReader(server.url, commands, "group", "one", shared=False)
        reader.add("r.lives", "0")
        entry = commands.xadd(stream_name("r.lives"), {"f": "early"})
        (early,) = _read(reader)
        server.kill()
        server.start()
        again = client(server.url)
        again.xadd(stream_name("r.lives"), {"f": "late"}, id=entry)
        found: list[Delivery] = []
        wait_for(lambda: found.extend(_what_came(reader)) or found)
        assert [delivery.payload for delivery in found] == [b"late"]
        reader.acknowledge(early)
        reader.close()
        assert again.xpending(work_name("group", "r.lives"), "group")["pending"] == 1
        for each in (commands, again):
            each.close()


def test_one_that_rested_while_the_server_lost_everything_reads_from_the_beginning(tmp_path):
    """It has never had a connection for reading, on which an answer would have told it."""
    with EmbeddedServer(tmp_path / "u") as server:
        commands = client(server.url)
        reader = StreamReader(server.url, commands, "group", "one", shared=False)
        reader.activate(False, take_over=False)
        commands.xadd(stream_name("r.rested"), {"f": "lost"})
        reader.add("r.rested", "$")
        server.kill()
        server.start()
        again = client(server.url)
        again.xadd(stream_name("r.rested"), {"f": "new"})
        reader.activate(True, take_over=False)
        found: list[Delivery] = []
        wait_for(lambda: found.extend(_what_came(reader)) or found)
        assert [delivery.payload for delivery in found] == [b"new"]
        reader.close()
        for each in (commands, again):
            each.close()
