"""Every Data Updates driver keeps one contract: order, acknowledgement, groups, replay, back-pressure."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from due.backends import open_updates
from due.config import Options
from due.drivers.base import Delivery, Publisher, Receiver, UpdatesDriver
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.testing.tls_redis import TlsRedis
from tests.due.conftest import wait_for
from tests.requirements import require_program

_spaces = itertools.count()
Open = Callable[..., UpdatesDriver]


@contextmanager
def empty_place(kind: str, request: pytest.FixtureRequest) -> Iterator[str]:
    """The URL of a place that nobody has used yet."""
    name, folder = f"contract{next(_spaces)}", request.getfixturevalue("tmp_path") / "updates"
    if kind == "redis":
        with EmbeddedServer(folder) as server:
            yield server.url
    elif kind == "rediss":
        require_program("redis-server")
        with TlsRedis(folder) as encrypted:
            yield encrypted.url
    elif kind == "sentinel":
        servers = request.getfixturevalue("sentinel_servers")
        servers.empty()
        yield servers.url
    elif kind == "kafka":
        yield f"{request.getfixturevalue('kafka_server').url}/{name}"
    else:
        yield f"memory://{name}"


@pytest.fixture(params=["redis", "rediss", "sentinel", "memory", "kafka"])
def open_driver(request: pytest.FixtureRequest) -> Iterator[Open]:
    """Opens drivers of one empty place."""
    opened: list[UpdatesDriver] = []
    with empty_place(request.param, request) as url:

        def make(**options: object) -> UpdatesDriver:
            opened.append(open_updates(url, Options(**options)))
            return opened[-1]

        yield make
        for driver in opened:
            driver.close()


def received(receiver: Receiver, count: int, seconds: float = 30.0) -> list[Delivery]:
    """The next `count` deliveries, not acknowledged."""
    found: list[Delivery] = []
    deadline = time.monotonic() + seconds
    while len(found) < count:
        assert time.monotonic() < deadline, f"only {len(found)} of {count} came"
        found += receiver.receive(0.1)
    return found


def numbers(deliveries: list[Delivery]) -> list[int]:
    return [int(delivery.payload) for delivery in deliveries]


def test_best_effort_reaches_all_who_subscribed_in_order(open_driver: Open) -> None:
    driver = open_driver()
    exact, wild, other = (driver.receiver(name, name) for name in ("exact", "wild", "other"))
    exact.subscribe("a.b.c")
    wild.subscribe("a.**")
    other.subscribe("x.y.z")
    publisher = driver.publisher("writer")
    publisher.publish("a.b.c", b"1", b"2")
    publisher.publish("a.b.c", b"3")
    assert numbers(received(exact, 3)) == numbers(received(wild, 3)) == [1, 2, 3]
    assert other.receive(0.05) == []
    exact.unsubscribe("a.b.c")
    publisher.publish("a.b.c", b"4")
    assert numbers(received(wild, 1)) == [4]
    assert exact.receive(0.05) == []
    for half in (exact, wild, other, publisher):
        half.close()


def test_each_group_reads_a_stream_whole_and_in_order(open_driver: Open) -> None:
    driver = open_driver()
    publisher = driver.publisher("writer")
    groups = [driver.receiver(name, f"{name}1") for name in ("one", "two")]
    for receiver in groups:
        receiver.follow("r.x.y")
    for number in range(200):
        publisher.append("r.x.y", b"%d" % number)
    publisher.settle(10)
    for receiver in groups:
        found = received(receiver, 200)
        assert numbers(found) == list(range(200))
        assert all(delivery.token and delivery.path == "r.x.y" for delivery in found)
        receiver.close()
    publisher.close()


def test_what_was_not_acknowledged_goes_to_the_next_member_first(open_driver: Open) -> None:
    driver = open_driver()
    publisher = driver.publisher("writer")
    first = driver.receiver("group", "first")
    first.follow("r.x.y")
    for number in range(6):
        publisher.append("r.x.y", b"%d" % number)
    found = received(first, 6)
    for delivery in found[:3]:
        first.acknowledge(delivery)
    first.close()
    second = driver.receiver("group", "second")
    second.follow("r.x.y")
    second.activate(True, take_over=True)
    publisher.append("r.x.y", b"6")
    again = received(second, 4)
    assert numbers(again) == [3, 4, 5, 6]
    assert [delivery.tries for delivery in again] == [2, 2, 2, 1]
    second.close()
    publisher.close()


def test_members_of_a_shared_group_divide_the_work(open_driver: Open) -> None:
    driver = open_driver()
    publisher = driver.publisher("writer")
    members = [driver.receiver("group", name, shared=True) for name in ("a", "b")]
    paths = [f"r.x.y.{number}" for number in range(16)]
    for member in members:
        member.follow("r.x.**")
    got: list[list[int]] = [[], []]
    sent = 0

    def read_on() -> bool:
        for mine, member in zip(got, members, strict=True):
            member.renew()  # as an engine does every second
            for delivery in member.receive(0.05):
                mine.append(int(delivery.payload))
                member.acknowledge(delivery)
        return sum(map(len, got)) >= sent

    while not all(got):
        for _ in range(20 * len(paths)):
            publisher.append(paths[sent % len(paths)], b"%d" % sent)
            sent += 1
        read_on()
    wait_for(read_on)
    assert sorted(got[0] + got[1]) == list(range(sent))
    for half in (*members, publisher):
        half.close()


def test_a_group_may_begin_again_with_what_is_kept(open_driver: Open) -> None:
    driver = open_driver()
    publisher = driver.publisher("writer")
    for number in range(5):
        publisher.append("r.x.y", b"%d" % number)
    publisher.settle(10)
    late = driver.receiver("late", "l1")
    late.follow("r.x.y")
    publisher.append("r.x.y", b"5")
    assert numbers(received(late, 1)) == [5]
    replay = driver.receiver("replay", "r1")
    replay.follow("r.x.y", start="0")
    assert numbers(received(replay, 6)) == [0, 1, 2, 3, 4, 5]
    for half in (late, replay, publisher):
        half.close()


def test_a_stream_that_begins_later_is_read_from_its_beginning(open_driver: Open) -> None:
    driver = open_driver()
    receiver, publisher = driver.receiver("group", "g1"), driver.publisher("writer")
    receiver.follow("r.**")
    publisher.append("r.new.path", b"1")
    publisher.append("s.other.path", b"2")
    assert numbers(received(receiver, 1)) == [1]
    for half in (receiver, publisher):
        half.close()


@pytest.mark.parametrize("met", [True, False], ids=["known", "new"])
def test_a_full_window_makes_the_producer_wait_for_its_readers(open_driver: Open, met: bool) -> None:
    """Also for one that was there first and is slow to hear of a new path."""
    driver = open_driver(window_bytes=10_000, retain_bytes=0)
    publisher, receiver = driver.publisher("writer"), driver.receiver("group", "g1")
    receiver.follow("r.**")
    if met:
        publisher.append("r.x.y", b"first")
        receiver.acknowledge(received(receiver, 1)[0])
    sent: list[int] = []

    def write() -> None:
        for number in range(40):
            publisher.append("r.x.y", b"%01000d" % number)
            sent.append(number)

    writer = threading.Thread(target=write)
    writer.start()
    wait_for(lambda: not publisher.has_room("r.x.y") or len(sent) == 40)
    assert len(sent) < 40, "it waits"
    got: list[int] = []
    while len(got) < 40:
        receiver.renew()  # as an engine does every second: producers wait for readers that live
        for delivery in receiver.receive(0.1):
            got.append(int(delivery.payload))
            receiver.acknowledge(delivery)
    writer.join(30)
    assert got == sent == list(range(40))
    for half in (receiver, publisher):
        half.close()


def test_a_member_that_rests_receives_nothing_reliable(open_driver: Open) -> None:
    driver = open_driver()
    publisher, receiver = driver.publisher("writer"), driver.receiver("group", "g1")
    receiver.follow("r.x.y")
    receiver.activate(False)
    publisher.append("r.x.y", b"1")
    publisher.settle(10)
    assert receiver.receive(0.2) == []
    receiver.activate(True)
    assert numbers(received(receiver, 1)) == [1]
    for half in (receiver, publisher):
        half.close()


def test_what_is_set_aside_can_be_listed(open_driver: Open) -> None:
    driver = open_driver()
    publisher, receiver = driver.publisher("writer"), driver.receiver("group", "g1")
    receiver.follow("r.x.y")
    publisher.append("r.x.y", b"7")
    (delivery,) = received(receiver, 1)
    receiver.set_aside(delivery, b"payload", "a callback failed")
    assert receiver.aside() == [(b"payload", "a callback failed")]
    counts = receiver.statistics()
    assert [counts[f"set_aside{kind}"] for kind in ("", "_waiting", "_lost")] == [1, 0, 0]
    for half in (receiver, publisher):
        half.close()


def test_wake_ends_a_wait(open_driver: Open) -> None:
    receiver = open_driver().receiver("group", "g1")
    receiver.subscribe("a.b.c")
    waiting = threading.Thread(target=lambda: receiver.receive(600.0))
    waiting.start()
    receiver.wake()
    waiting.join(60)
    assert not waiting.is_alive()
    receiver.close()


_PATHS = [f"r.x.y.{number}" for number in range(8)]


def _numbered(publisher: Publisher, numbers: range) -> None:
    for number in numbers:
        for path in _PATHS:
            publisher.append(path, b"%d" % number)
    publisher.settle(30)


def _sharing(driver: UpdatesDriver, publisher: Publisher) -> tuple[Receiver, Receiver, frozenset[str]]:
    """Two members that know the same shards, of which none is theirs, and five entries on each path."""
    members = driver.receiver("group", "a"), driver.receiver("group", "b")
    for member in members:
        member.share(frozenset())
        member.follow("r.x.**")
    _numbered(publisher, range(5))

    def known() -> bool:
        assert not [delivery for member in members for delivery in member.receive(0.05)]
        offered = [set(member.offered()) for member in members]
        return len(offered[0]) >= least and offered[0] == offered[1]

    # on Kafka a shard is a partition, and all of a topic are offered at once
    least = 2 if driver.url.startswith("kafka") else len(_PATHS)
    wait_for(known)
    return *members, frozenset(members[0].offered())


def _by_path(deliveries: list[Delivery]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for delivery in deliveries:
        found.setdefault(delivery.path, []).append(int(delivery.payload))
    return found


def test_each_shard_is_read_whole_and_in_order_by_the_member_that_has_it(open_driver: Open) -> None:
    driver = open_driver()
    publisher = driver.publisher("writer")
    a, b, shards = _sharing(driver, publisher)
    part = frozenset(sorted(shards)[: len(shards) // 2])
    a.share(part)
    b.share(shards - part)
    found: dict[Receiver, list[Delivery]] = {a: [], b: []}

    def read() -> bool:
        for member, deliveries in found.items():
            member.renew()
            for delivery in member.receive(0.05):
                member.acknowledge(delivery)
                deliveries.append(delivery)
        return sum(map(len, found.values())) >= 5 * len(_PATHS)

    wait_for(read)
    assert {a.shard_of(delivery) for delivery in found[a]} <= part
    assert {b.shard_of(delivery) for delivery in found[b]} <= shards - part
    together = _by_path(found[a]) | _by_path(found[b])
    assert together == {path: list(range(5)) for path in _PATHS}
    for half in (a, b, publisher):
        half.close()


@pytest.mark.parametrize("how", ["acknowledged", "abandoned"])
def test_a_shard_that_moves_waits_for_what_the_other_member_has_of_it(open_driver: Open, how: str) -> None:
    driver = open_driver()
    publisher = driver.publisher("writer")
    a, b, shards = _sharing(driver, publisher)
    a.share(shards)
    first = received(a, 5 * len(_PATHS))
    a.share(frozenset())
    b.share(shards)
    assert set(a.held()) >= {a.shard_of(delivery) for delivery in first}
    _numbered(publisher, range(5, 10))
    for _ in range(10):
        a.renew()
        b.renew()
        assert a.receive(0.02) == []
        assert b.receive(0.02) == []
    if how == "acknowledged":
        for delivery in first:
            a.acknowledge(delivery)
    else:
        for shard in shards:
            a.abandon(shard)
    later: list[Delivery] = []
    expected = range(5, 10) if how == "acknowledged" else range(10)

    def read() -> bool:
        a.renew()
        b.renew()
        assert a.receive(0.02) == []
        came = b.receive(0.05)
        for delivery in came:
            b.acknowledge(delivery)
        later.extend(came)
        return len(later) >= len(expected) * len(_PATHS)

    wait_for(read)
    assert _by_path(later) == {path: list(expected) for path in _PATHS}
    assert all((delivery.tries > 1) == (int(delivery.payload) < 5) for delivery in later)
    wait_for(lambda: not a.held())
    for half in (a, b, publisher):
        half.close()
