"""A real server refuses an app everything but its own; each refusal is counted and told."""

import os
import secrets
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import redis

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_leases import lease_name
from due.drivers.redis_rights import Rights
from due.drivers.redis_streams import PRODUCERS, announced_name, stream_name
from due.drivers.redis_wire import Wire, client
from due.errors import UpdatesUnavailable
from sdnator.rights.granting import DANGEROUS, OPERATOR
from sdnator.rights.identities import ADMIN, FILE, Identities, made, observable
from sdnator.rights.rights_keeper import RightsKeeper, RightsRefused
from sdnator.testing.tls_redis import TlsRedis
from tests.due.conftest import wait_for
from tests.requirements import require_program

MINE = Rights(app="mine", publish=("network.anomaly.mine.**",), observe=("network.open.**",))
OWN, FOREIGN = "network.anomaly.mine.score", "network.anomaly.kitsune.score"
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
    stream, lease, set_aside = stream_name(path), lease_name("kitsune", path), "due:poison:kitsune"
    yield ("PUBLISH", f"due:{path}", "x")
    yield ("PUBLISH", announced_name("kitsune"), path)
    yield ("XADD", stream, "*", "f", "x")
    yield ("XTRIM", stream, "MAXLEN", 0)
    yield ("DEL", stream)
    yield ("EXPIRE", stream, 1)
    yield ("XRANGE", stream, "-", "+")
    yield ("XREAD", "STREAMS", stream, "0")
    yield ("XREADGROUP", "GROUP", "kitsune", "c", "STREAMS", stream, ">")
    yield ("XACK", stream, "kitsune", "1-1")
    yield ("XCLAIM", stream, "kitsune", "c", 0, "1-1")
    for verb in ("CREATE", "SETID"):
        yield ("XGROUP", verb, stream, "kitsune", "0")
    yield ("XGROUP", "DESTROY", stream, "kitsune")
    yield ("XGROUP", "DELCONSUMER", stream, "kitsune", "c")
    yield ("XINFO", "GROUPS", stream)
    yield ("HSET", lease, "c", "0")
    yield ("HDEL", lease, "c")
    yield ("HGETALL", lease)
    yield ("XADD", set_aside, "*", "f", "x")
    yield ("XRANGE", set_aside, "-", "+")
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
    ("GET", "anything"),
    ("SET", "anything", "1"),
    ("PUBSUB", "CHANNELS"),
    ("PSUBSCRIBE", "*"),
    ("PSUBSCRIBE", "due:*"),
    ("PSUBSCRIBE", "due:network.*"),
    ("SUBSCRIBE", "due:network.block.firewall.ipv4"),
    ("SUBSCRIBE", "due:due.assignment.kitsune"),
)


def test_an_app_can_say_and_see_nothing_but_its_own(place):
    server, identities = place
    keeper = RightsKeeper(server.admin_url, identities)
    keeper.look()
    commands = client(identities.url(server.url, "mine"))
    tried = [attempt for path in _PATHS for attempt in _attempts(path)] + list(_SERVER)
    for attempt in tried:
        with pytest.raises(redis.exceptions.NoPermissionError):
            commands.execute_command(*attempt)
    keeper.look()
    told = keeper.told()
    assert any(f"mine was refused the channel due:{FOREIGN}" in text for text in told)
    assert keeper.refusals["mine"] >= len(tried) / 2, "the server's log has room for 128 kinds"
    for attempt in (("PUBLISH", f"due:{OWN}", "x"), ("XADD", stream_name(OWN), "*", "f", "x")):
        commands.execute_command(*attempt)
    for attempt in (("SUBSCRIBE", "due:network.open.door"), ("PSUBSCRIBE", "due:network.open.*")):
        client(identities.url(server.url, "mine")).execute_command(*attempt)
    commands.close()
    keeper.close()


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
