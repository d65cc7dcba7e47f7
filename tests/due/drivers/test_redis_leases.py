"""A lease is judged by how long its watcher saw it unchanged: no clock of another machine counts."""

import time

import pytest

from due.drivers import redis_upkeep
from due.drivers.redis_leases import LeaseValue, LeaseWatch, lease_name
from due.drivers.redis_streams import LIFETIME_S, work_name
from due.drivers.redis_upkeep import _FORGET_SECONDS, Upkeep
from due.drivers.redis_wire import client
from due.drivers.redis_work import ServerTime

FIELD = b"group/one"


def _watch(*looks: tuple[float, bytes], keep: float = 30.0) -> LeaseWatch:
    watch = LeaseWatch(keep)
    for at, value in looks:
        watch.look({FIELD: value} if value else {}, at, at)
    return watch


@pytest.mark.parametrize("value", [b"1", b"99999999999999999999", b"-3", b"no number", b"\xff"])
def test_what_a_lease_says_does_not_count(value):
    assert _watch((0.0, value)).silent(FIELD) == 0.0
    assert _watch((0.0, value), (1.0, value), (2.0, value)).silent(FIELD) == 2.0
    assert _watch((0.0, b"7"), (1.0, b"7"), (2.0, value)).silent(FIELD) == 0.0


def test_a_lease_that_was_given_up_is_gone_at_once():
    assert _watch((0.0, b"7"), (0.1, b"0")).silent(FIELD) == float("inf")


def test_a_watcher_or_server_that_was_stopped_gives_everybody_his_time():
    assert _watch((0.0, b"7"), (3600.0, b"7")).silent(FIELD) == 1.0
    late = LeaseWatch(30.0)
    late.look({FIELD: b"7"}, 0.0, 0.0)
    late.look({FIELD: b"7"}, 0.2, 3600.0)
    late.look({FIELD: b"7"}, 3600.1, 3600.1)
    assert late.silent(FIELD) == pytest.approx(0.3)


def test_a_lease_that_the_server_lost_counts_for_a_while():
    looks = [(float(at), b"") for at in range(1, 30)]
    assert _watch((0.0, b"7"), *looks[:10]).living(30.0) == {FIELD}
    assert _watch((0.0, b"7"), *looks, keep=5.0).fields() == []


def test_values_never_repeat_when_the_clock_stands_or_goes_back(monkeypatch):
    times = iter([100.0, 100.0, 40.0, 3700.0, 100.0])
    monkeypatch.setattr("due.drivers.redis_leases.time.time", lambda: next(times))
    lease = LeaseValue()
    values = [int(lease.next()) for _ in range(5)]
    assert values == sorted(set(values))


def test_what_is_left_behind_is_forgotten_and_what_lives_is_not(server):
    commands, path = client(server.url), "r.upkeep.lives"
    leases = lease_name("group", path)
    commands.xgroup_create(work_name("group", path), "group", "$", mkstream=True)
    for consumer in ("one", "dead", "busy"):
        commands.hset(leases, consumer, "7")
    commands.xadd(work_name("group", path), {"f": "1"})
    commands.xreadgroup("group", "busy", {work_name("group", path): ">"})
    commands.xgroup_createconsumer(work_name("group", path), "group", "dead")
    upkeep, lease = Upkeep(commands, "group", "one"), LeaseValue()
    for minute in range(60):
        commands.hset(leases, "one", lease.next())
        upkeep.tick([path], 60.0 * minute)
        _grow_older(upkeep)
    assert set(commands.hkeys(leases)) == {b"one"}
    names = {one["name"] for one in commands.xinfo_consumers(work_name("group", path), "group")}
    assert names == {b"busy"}, "its entry is not lost"
    assert 0 < commands.ttl(leases) <= LIFETIME_S
    assert upkeep.counts["forgotten_leases"] == 2
    commands.close()


def _grow_older(upkeep: Upkeep) -> None:
    """As if the last look were a while ago."""
    for watch in upkeep._watches.values():
        assert watch._looked is not None
        watch._looked -= _FORGET_SECONDS / 3


def test_a_group_goes_when_the_others_of_it_are_gone_and_stays_while_one_lives(server, monkeypatch):
    monkeypatch.setattr(redis_upkeep, "_WITHDRAWN_SECONDS", 0.0)
    monkeypatch.setattr(redis_upkeep, "_GONE_SECONDS", 3.0)
    commands, lease = client(server.url), LeaseValue()
    paths = {"r.left": b"0", "r.crashed": b"7", "r.alive": b"7"}
    for path, value in paths.items():
        commands.xgroup_create(work_name("group", path), "group", "$", mkstream=True)
        commands.hset(lease_name("group", path), "other", value)
    upkeep = Upkeep(commands, "group", "one")
    upkeep.withdrawn(list(paths), 0.0)
    groups: list[set[str]] = []
    for second in range(1, 9):
        commands.hset(lease_name("group", "r.alive"), "other", lease.next())
        upkeep.tick([], float(second))
        groups.append({path for path in paths if commands.exists(work_name("group", path))})
        for _, watch in upkeep._withdrawn.values():
            assert watch._looked is not None
            watch._looked -= 1.0
    assert groups[0] == {"r.crashed", "r.alive"}, "what was left goes at once"
    assert groups[-1] == {"r.alive"}
    commands.close()


def test_where_a_stream_was_is_told_by_the_servers_clock_whichever_way_it_jumped():
    class Server:
        now = 5000.0

        def time(self) -> tuple[int, int]:
            return int(self.now), 0

    server = Server()
    clock = ServerTime(server)
    since = time.monotonic()
    assert 4_998_000 <= int(clock.start(since)) < 5_000_000
    clock.note(5000.0)
    for server.now in (5000.0, 8600.0):
        assert 4_998_000 <= int(clock.start(since)) < 5_001_000, "nothing that came before the jump is missed"
    server.now = 1400.0
    assert int(clock.start(since)) < 1_400_000
