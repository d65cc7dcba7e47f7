"""A real server refuses an app everything but its own; each refusal is counted and told."""

import os
import secrets
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import redis

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options
from due.drivers.base import own_group
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_leases import lease_name
from due.drivers.redis_rights import Rights
from due.drivers.redis_streams import (
    PRODUCERS,
    announced_name,
    readers_name,
    stream_name,
    wake_name,
    work_name,
)
from due.drivers.redis_wire import Wire, client
from due.errors import UpdatesUnavailable
from sdnator.rights.granting import DANGEROUS, OPERATOR
from sdnator.rights.identities import ADMIN, FILE, Identities, made, observable
from sdnator.rights.rights_keeper import RightsKeeper
from sdnator.rights.watching_keeper import RightsRefused
from sdnator.testing.tls_redis import TlsRedis
from tests.due.conftest import wait_for
from tests.requirements import require_program

MINE = Rights(app="mine", publish=("network.anomaly.mine.**",), observe=("network.open.**",))
OWN, FOREIGN, OPEN = "network.anomaly.mine.score", "network.anomaly.kitsune.score", "network.open.door"
_PATHS = (
    *(FOREIGN, "due.assignment.firewall", "network.frames.p4runtime_ctrl.s1.all"),
    *(f"network.{family}.firewall.ipv4" for family in DANGEROUS),
)


@pytest.fixture(params=["embedded", "tls"])
def place(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[EmbeddedServer | TlsRedis, Identities]]:
    identities = made(
        tmp_path, {"mine": MINE, "kitsune": Rights(app="kitsune", publish=("network.anomaly.kitsune.*",))}
    )
    password = secrets.token_urlsafe(24)
    users, admin = partial(identities.users_file, password), (identities.prefix + ADMIN, password)
    if request.param == "tls":
        require_program("redis-server")
    kind = {"embedded": EmbeddedServer, "tls": TlsRedis}[request.param]
    with kind(tmp_path / "u", users=users, admin=admin) as server:
        yield server, identities


def _attempts(path: str) -> Iterator[tuple[str | int, ...]]:
    """Every verb of the wire format on one path that is not the app's."""
    stream = stream_name(path)
    yield ("PUBLISH", f"due:{path}", "x")
    yield ("PUBLISH", announced_name("kitsune"), path)
    yield ("XRANGE", stream, "-", "+")
    yield ("XREAD", "STREAMS", stream, "0")
    yield ("XINFO", "GROUPS", stream)
    yield ("XINFO", "STREAM", stream)
    yield ("XPENDING", stream, "kitsune")
    yield ("SADD", readers_name(path), "mine")
    yield from _as_a_writer(path)
    yield from _as_kitsune(path)


def _as_a_writer(path: str) -> Iterator[tuple[str | int, ...]]:
    """What changes a stream or whom its producers wait for."""
    stream, readers = stream_name(path), readers_name(path)
    yield ("XADD", stream, "*", "f", "x")
    yield ("XTRIM", stream, "MAXLEN", 0)
    yield ("XDEL", stream, "1-1")
    yield ("XSETID", stream, "9-9")
    yield ("DEL", stream)
    yield ("EXPIRE", stream, 1)
    yield ("SREM", readers, "kitsune")
    yield ("DEL", readers)
    yield ("EXPIRE", readers, 1)


def _on_list(name: str) -> Iterator[tuple[str | int, ...]]:
    """What acknowledges, takes or moves something of a group, or ends it."""
    yield ("XREADGROUP", "GROUP", "kitsune", "c", "STREAMS", name, ">")
    yield ("XACK", name, "kitsune", "1-1")
    yield ("XDEL", name, "1-1")
    yield ("XCLAIM", name, "kitsune", "c", 0, "1-1")
    yield ("XAUTOCLAIM", name, "kitsune", "c", 0, "0")
    yield ("XADD", name, "9-9", "i", "")
    yield ("XSETID", name, "9-9")
    yield ("DEL", name)
    for verb in ("CREATE", "SETID"):
        yield ("XGROUP", verb, name, "kitsune", "0")
    yield ("XGROUP", "DESTROY", name, "kitsune")
    yield ("XGROUP", "CREATECONSUMER", name, "kitsune", "c")
    yield ("XGROUP", "DELCONSUMER", name, "kitsune", "c")


def _as_kitsune(path: str) -> Iterator[tuple[str | int, ...]]:
    """What acknowledges, reads, lives or says something in another app's name."""
    set_aside, lease = "due:poison:kitsune", lease_name("kitsune", path)
    yield from _on_list(stream_name(path))
    yield from _on_list(work_name("kitsune", path))
    yield ("XPENDING", work_name("kitsune", path), "kitsune")
    yield ("XINFO", "CONSUMERS", work_name("kitsune", path), "kitsune")
    yield ("HSET", lease, "c", "0")
    yield ("HDEL", lease, "c")
    yield ("HGETALL", lease)
    yield ("XADD", set_aside, "*", "f", "x")
    yield ("XRANGE", set_aside, "-", "+")
    yield ("XADD", wake_name("kitsune"), "*", "i", "x")
    yield ("XREAD", "STREAMS", wake_name("kitsune"), "0")
    one = own_group("kitsune", "i1")
    yield ("XADD", wake_name(one), "*", "i", "x")
    yield ("XADD", work_name(one, path), "9-9", "i", "")
    yield ("HSET", lease_name(one, path), "c", "0")
    yield ("ZADD", announced_name("kitsune"), 1, path)
    yield ("ZREM", announced_name("kitsune"), path)
    yield ("SREM", PRODUCERS, "kitsune")


_SERVER = (
    ("CONFIG", "GET", "*"),
    ("CONFIG", "SET", "maxmemory", "1"),
    ("ACL", "LIST"),
    ("ACL", "SETUSER", "mine", "+@all"),
    ("EVAL", "return 1", 0),
    ("FUNCTION", "LIST"),
    ("KEYS", "*"),
    ("SCAN", 0),
    ("FLUSHALL",),
    ("SHUTDOWN",),
    ("MONITOR",),
    ("CLIENT", "LIST"),
    ("CLIENT", "KILL", "TYPE", "normal"),
    ("CLIENT", "UNBLOCK", 1),
    ("GET", "anything"),
    ("SET", "anything", "1"),
    ("PUBSUB", "CHANNELS"),
    ("PSUBSCRIBE", "*"),
    ("PSUBSCRIBE", "due:*"),
    ("PSUBSCRIBE", "due:network.*"),
    ("SUBSCRIBE", "due:network.block.firewall.ipv4"),
    ("SUBSCRIBE", "due:due.assignment.kitsune"),
)


def _refused(keeper: RightsKeeper, url: str) -> int:
    """How many attempts of an app on what is not its own were refused: all."""
    keeper.look()
    commands = client(url)
    tried = [attempt for path in _PATHS for attempt in _attempts(path)] + list(_SERVER)
    tried += [*_as_a_writer(OPEN), *_as_kitsune(OPEN), *_on_list(work_name("kitsune", OWN))]
    for attempt in tried:
        with pytest.raises(redis.exceptions.NoPermissionError):
            commands.execute_command(*attempt)
    keeper.look()
    commands.close()
    return len(tried)


def test_a_given_server_refuses_an_app_the_same(tmp_path):
    """A Valkey that others have started, whose administrator's credential we are given."""
    identities = made(tmp_path, {"mine": MINE, "kitsune": Rights(app="kitsune")})
    with EmbeddedServer(tmp_path / "u") as server:
        keeper = RightsKeeper(server.url, identities)
        keeper.apply()
        tried = _refused(keeper, identities.url(server.url, "mine"))
        assert keeper.refusals["mine"] == tried, "each is counted"
        keeper.close()


def test_an_app_can_say_and_see_nothing_but_its_own(place):
    server, identities = place
    keeper = RightsKeeper(server.admin_url, identities)
    tried = _refused(keeper, identities.url(server.url, "mine"))
    commands = client(identities.url(server.url, "mine"))
    told = keeper.told()
    assert len([text for text in told if "mine was refused the" in text]) > len(_PATHS)
    assert keeper.refusals["mine"] == tried, "each is counted"
    for attempt in (("PUBLISH", f"due:{OWN}", "x"), ("XADD", stream_name(OWN), "*", "f", "x")):
        commands.execute_command(*attempt)
    for attempt in (("SUBSCRIBE", "due:network.open.door"), ("PSUBSCRIBE", "due:network.open.*")):
        client(identities.url(server.url, "mine")).execute_command(*attempt)
    commands.close()
    keeper.close()


@pytest.mark.parametrize("group", ["mine", own_group("mine", "i1")])
def test_who_may_read_a_stream_leaves_every_other_group_where_it_is(place, group):
    """The only writes of a reader are on keys of its own, and its name among the readers."""
    server, identities = place
    url, work = identities.url(server.url, "mine"), work_name(group, OPEN)
    commands, admin = client(url), client(server.admin_url)
    admin.xadd(stream_name(OPEN), {"f": "x"})
    for attempt in (
        ("XREAD", "STREAMS", stream_name(OPEN), wake_name(group), "0", "0"),
        ("SADD", readers_name(OPEN), group),
        ("XGROUP", "CREATE", work, group, "0", "MKSTREAM"),
        ("XADD", work, "9-9", "i", ""),
        ("XREADGROUP", "GROUP", group, "c", "STREAMS", work, ">"),
        ("XACK", work, group, "9-9"),
        ("XADD", wake_name(group), "*", "i", "x"),
        ("HSET", lease_name(group, OPEN), "c", "1"),
    ):
        commands.execute_command(*attempt)
    assert admin.xlen(stream_name(OPEN)) == 1
    assert admin.xinfo_groups(stream_name(OPEN)) == []
    admin.close()
    commands.close()


def test_a_crowd_of_made_up_producers_is_removed(place):
    server, identities = place
    commands, keeper = client(identities.url(server.url, "mine")), RightsKeeper(server.admin_url, identities)
    commands.sadd(PRODUCERS, "mine", *(f"nobody{number}" for number in range(2000)))
    keeper.look()
    assert commands.smembers(PRODUCERS) == {b"mine"}
    assert any("2000 unknown producer names" in text for text in keeper.told())
    keeper.close()
    commands.close()


def test_without_a_credential_there_is_nothing_but_an_answer_to_ping(place, tmp_path):
    server, identities = place
    commands = client(server.url)
    assert commands.ping()
    for attempt in (*_attempts(OWN), *_SERVER):
        with pytest.raises(redis.exceptions.NoPermissionError):
            commands.execute_command(*attempt)
    commands.close()
    for path in (tmp_path / "u" / "users.acl", identities.path):
        assert path.stat().st_mode & 0o777 == 0o600


def _engine(url: str, folder: Path, app: str, rights: Rights | None = None) -> Engine:
    engine = Engine(
        Options(
            updates=url,
            archive=f"sqlite://{folder}/{app}.db",
            directory=str(folder / app),
            coordinated=False,
            **({k: tuple(v) for k, v in observable(rights).items()} if rights else {}),
        )
    )
    told = [Capability(key, delivery="reliable") for key in (OWN, FOREIGN)]
    engine.init(app, PRODUCER | CONSUMER, capabilities=told)
    return engine


def test_an_engine_goes_on_with_what_it_may_and_tells_of_the_rest(place, tmp_path, caplog):
    server, identities = place
    mine = _engine(identities.url(server.url, "mine"), tmp_path, "mine", MINE)
    operator = _engine(identities.url(server.url, OPERATOR), tmp_path, "operator")
    heard, seen = [], []
    operator.observe("network.anomaly.**").subscribe(lambda item: heard.append(item.value))
    mine.observe("network.open.door").subscribe(lambda item: seen.append(item.value))
    mine.observe("network.open.*").subscribe(lambda item: seen.append(item.value))
    mine.observe("network.**").subscribe(lambda item: seen.append(item.value))
    for number in range(3):
        mine.write(FOREIGN, -1, [PUB_ONLY])
        mine.write("network.block.firewall.ipv4", -1, [PUB_ONLY])
        mine.write(OWN, number, [PUB_ONLY])
    mine.flush()
    operator.write("network.anomaly.kitsune.other", "secret", [PUB_ONLY])
    operator.write("network.open.door", "open", [PUB_ONLY])
    operator.flush()
    wait_for(lambda: [v for v in heard if v != "secret"] == [0, 1, 2] and seen.count("open") == 3)
    assert "secret" not in seen
    assert mine.health()["updates"]["denied"] >= 2
    assert "mine has no right to an entry of network.anomaly.kitsune.score" in caplog.text
    assert "under [[grants]] in sdnator.toml" in caplog.text
    mine.close()
    operator.close()


def test_a_given_server_gets_its_users_again_when_it_lost_them(tmp_path):
    """A server without an ACL file forgets them when it is restarted."""
    identities = made(tmp_path, {"mine": MINE})
    with EmbeddedServer(tmp_path / "u") as server:
        keeper = RightsKeeper(server.url, identities)
        keeper.apply()
        keeper.start()
        server.kill()
        server.start()
        url = identities.url(server.url, "mine")

        def back() -> bool:
            try:
                return client(url).execute_command("PUBLISH", f"due:{OWN}", "x") == 0
            except redis.RedisError:
                return False

        wait_for(back)
        with identities.changing():
            identities.put("guest", Rights(app="guest", publish=("a.b",)), enrolled=True)
            identities.remove("mine")
        wait_for(lambda: not back())
        with pytest.raises(RightsRefused):
            RightsKeeper(identities.url(server.url, "guest"), identities).apply()
        keeper.stop()


def test_a_damaged_file_of_identities_is_made_anew(tmp_path):
    first = made(tmp_path, {"mine": MINE})
    assert made(tmp_path, {"mine": MINE}).all == first.all, "passwords stay"
    (tmp_path / FILE).write_bytes(os.urandom(100))
    again = made(tmp_path, {"mine": MINE})
    assert again.all["mine"].password != first.all["mine"].password


def test_over_tls_a_client_without_a_certificate_is_not_heard(tmp_path):
    require_program("redis-server")
    with TlsRedis(tmp_path / "u") as server:
        assert client(server.url).ping()
        with pytest.raises((redis.ConnectionError, redis.TimeoutError)):
            client(server.url_without_certificate).ping()
        with pytest.raises(UpdatesUnavailable, match=r"cannot be reached|connection"):
            Wire(server.url_without_certificate).call("PING")
