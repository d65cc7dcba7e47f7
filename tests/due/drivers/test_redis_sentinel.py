"""Behind sentinels every connection goes to the primary, and an entry counts once a replica has it."""

import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import hiredis
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers.redis import RedisUpdates
from due.drivers.redis_primary import PrimaryWatch
from due.drivers.redis_replicas import Confirmations
from due.drivers.redis_sentinel import parse_sentinel_url
from due.drivers.redis_streams import NOBODY, SendWindow
from due.drivers.redis_wire import Wire, as_user, client, pack
from due.errors import InvalidOption, Timeout, UpdatesUnavailable
from due.logs import without_passwords
from sdnator.cli.doctor import check_updates
from sdnator.rights.certificates import CA
from sdnator.testing.ports import free_port
from sdnator.testing.sentinel_servers import SentinelServers
from sdnator.testing.tls_redis import TlsRedis
from tests.due.conftest import wait_for
from tests.requirements import require_program


def test_a_url_says_sentinels_service_user_and_database():
    found = parse_sentinel_url("redis+sentinel://me:a%2Fb@one,[::1]:7000/lab/3?min_replicas=2")
    assert found.sentinels == (("one", 26379), ("::1", 7000))
    assert (found.service, found.min_replicas, found.tls) == ("lab", 2, None)
    assert found.login == {"username": "me", "password": "a/b", "db": 3}
    secured = parse_sentinel_url("rediss+sentinel://h:1/lab?ssl_ca_certs=/ca.pem")
    assert (secured.tls, secured.login, secured.min_replicas) == ({"ssl_ca_certs": "/ca.pem"}, {}, 1)


@pytest.mark.parametrize(
    "url",
    [
        "redis+sentinel://",
        "redis+sentinel://h:1",
        "redis+sentinel://h:1/",
        "redis+sentinel:///lab",
        "redis+sentinel://h:0/lab",
        "redis+sentinel://h:x/lab",
        "redis+sentinel://h:1,/lab",
        "redis+sentinel://h:1/la b",
        "redis+sentinel://h:1/lab/x",
        "redis+sentinel://h:1/lab?min_replicas=-1",
        "redis+sentinel://h:1/lab?min_replicas=17",
        "redis+sentinel://h:1/lab?min_replicas",
        "redis+sentinel://h:1/lab?ssl_ca_certs=x",
        "rediss+sentinel://h:1/lab?colour=x",
        "redis+sentinel://:secret@h:1/lab?colour=x",
    ],
)
def test_a_wrong_url_says_what_is_wrong_and_no_password(url):
    for use in (client, Wire, RedisUpdates):
        with pytest.raises(InvalidOption, match="Data Updates URL") as caught:
            use(url)
        assert "secret" not in str(caught.value)


@given(st.text(max_size=40))
def test_whatever_follows_the_scheme_is_read_or_refused(rest):
    try:
        parse_sentinel_url(f"redis+sentinel://{rest}")
    except InvalidOption:
        return


def test_users_are_put_into_a_url_and_left_out_of_logs():
    url = as_user("rediss+sentinel://old:word@h:1,g:2/lab/0?ssl_ca_certs=/x", "me", "pass")
    assert url == "rediss+sentinel://me:pass@h:1,g:2/lab/0?ssl_ca_certs=/x"
    assert without_passwords(f"at {url}:") == "at rediss+sentinel://…@h:1,g:2/lab/0?ssl_ca_certs=/x:"


def test_connections_go_to_the_primary(sentinel_servers):
    wire, commands = Wire(sentinel_servers.url), client(sentinel_servers.url)
    assert wire.primary == f"127.0.0.1:{sentinel_servers.port(sentinel_servers.primary)}"
    assert wire.call("SET", "t.sentinel", "1") == b"OK"
    assert commands.get("t.sentinel") == b"1"
    assert PrimaryWatch(sentinel_servers.url).successor([wire.primary]) == ""
    assert PrimaryWatch(sentinel_servers.url).successor(["127.0.0.1:1"]) == wire.primary
    commands.close()
    wire.close()


@pytest.mark.parametrize("place", ["127.0.0.1:1", "127.0.0.1:1,127.0.0.1:2"])
def test_sentinels_that_do_not_answer_are_unavailable_data_updates(place):
    with pytest.raises(UpdatesUnavailable, match="no sentinel that answers knows a primary of 'lab'"):
        Wire(f"redis+sentinel://:secret@{place}/lab")


def test_an_unknown_service_is_told(sentinel_servers):
    with pytest.raises(UpdatesUnavailable, match="knows a primary of 'other'"):
        Wire(sentinel_servers.url.replace("/due", "/other"))


@contextmanager
def _sentinel_that_says(answer: bytes) -> Iterator[str]:
    """HOST:PORT of a server that gives this answer to every question about primaries."""
    open_now: list[socket.socket] = []

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            open_now.append(connection)
            threading.Thread(target=_answer, args=(connection, answer), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
    for connection in open_now:
        connection.close()


def _answer(connection: socket.socket, answer: bytes) -> None:
    reader = hiredis.Reader()
    try:
        while data := connection.recv(65536):
            reader.feed(data)
            while (command := reader.gets()) is not False:
                connection.sendall(answer if command[0] == b"SENTINEL" else b"+OK\r\n")
    except OSError:
        return


def _primaries(**told: object) -> bytes:
    """What `SENTINEL MASTERS` answers."""
    fields = {"name": "lab", "flags": "master", "ip": "127.0.0.1", "num-other-sentinels": 0, **told}
    pairs = [str(part) for name, value in fields.items() for part in (name.replace("_", "-"), value)]
    return b"*1\r\n" + pack(tuple(pairs))


def test_a_sentinel_that_is_behind_leads_nobody_to_a_replica(sentinel_servers):
    replica = sentinel_servers.port(sentinel_servers.replicas[0])
    with _sentinel_that_says(_primaries(port=replica)) as place:
        with pytest.raises(UpdatesUnavailable, match="is not the primary"):
            Wire(f"redis+sentinel://{place}/lab")
        assert PrimaryWatch(f"redis+sentinel://{place}/lab").successor(["127.0.0.1:1"]) == ""


@pytest.mark.parametrize(
    "answer",
    [
        b"*1\r\n*0\r\n",
        b"*1\r\n$1\r\nx\r\n",
        b"$3\r\nlab\r\n",
        b":7\r\n",
        b"-ERR unknown command 'SENTINEL'\r\n",
        _primaries(port="x"),
        _primaries(),
        _primaries(port=99999999),
    ],
)
def test_whatever_a_sentinel_answers_is_unavailable_data_updates(answer):
    with _sentinel_that_says(answer) as place, pytest.raises(UpdatesUnavailable):
        Wire(f"redis+sentinel://{place}/lab")


def test_an_entry_counts_once_enough_replicas_have_it():
    replicas = Confirmations(2, "here")
    assert replicas.question() is None, "nothing was sent"
    first = replicas.number()
    asked = replicas.question()
    assert asked is not None
    assert replicas.question() is None, "one question at a time"
    second = replicas.number()
    replicas.answered(asked, 1)
    assert (replicas.confirmed, replicas.missing) == (0, 2)
    again = replicas.question()
    assert again is not None
    replicas.answered(asked, 2)
    assert (replicas.confirmed, replicas.missing) == (first, 1), (
        "what was sent after the question does not count"
    )
    replicas.answered(again, 3)
    assert (replicas.confirmed, replicas.missing) == (second, 0)
    with pytest.raises(UpdatesUnavailable):
        replicas.answered(again, "UNBLOCKED")


def test_a_lost_connection_is_asked_again():
    replicas = Confirmations(1, "here")
    replicas.number()
    assert replicas.question() is not None
    replicas.lost()
    assert replicas.question() is not None


def test_what_no_replica_has_stays_kept():
    window, replicas = SendWindow("a.b", 5000, 5000, 30.0), Confirmations(1, "here")
    for number in range(1, 4):
        entry = window.add(b"x")
        entry.id, entry.number = (number, 0), replicas.number()
    window.acknowledged(NOBODY, 2)
    assert [entry.id for entry in window.kept] == [(3, 0)]
    window.acknowledged(NOBODY, 3)
    assert not window.kept


def test_flush_tells_that_no_replica_confirms(tmp_path, caplog):
    """The entry is kept, and confirmed as soon as a replica is back."""
    with SentinelServers(tmp_path / "s", replicas=1, sentinels=1) as servers:
        publisher = RedisUpdates(servers.url).publisher("writer")
        publisher.append("r.x.y", b"1")
        publisher.settle(30)
        servers.freeze([1])
        publisher.append("r.x.y", b"2")
        with pytest.raises(Timeout, match="min_replicas=1"):
            publisher.settle(0.5)
        assert publisher.statistics()["unconfirmed"] == 1
        servers.freeze([1], frozen=False)
        publisher.settle(60)
        assert publisher.statistics()["unconfirmed"] == 0
        publisher.close()
        assert check_updates(servers.url).state == "ok"
        greedy = check_updates(f"{servers.url}?min_replicas=2")
        assert (greedy.state, "min_replicas=2, but 1 are connected" in greedy.found) == ("missing", True)
        carefree = RedisUpdates(f"{servers.url}?min_replicas=0").publisher("writer")
        servers.kill(1)
        carefree.append("r.x.y", b"3")
        carefree.settle(30)
        carefree.close()


def test_everything_moves_away_from_a_primary_that_hangs(tmp_path):
    """Its connections are open, and nobody answers on them."""
    with SentinelServers(tmp_path / "s") as servers:
        driver = RedisUpdates(servers.url)
        publisher, receiver = driver.publisher("writer"), driver.receiver("group", "one")
        receiver.follow("r.x.y")
        receiver.subscribe("b.x.y")
        got: list[bytes] = []

        def works(payload: bytes) -> bool:
            publisher.poll()
            receiver.renew()
            for delivery in receiver.receive(0.05):
                got.append(delivery.payload)
                if delivery.token:
                    receiver.acknowledge(delivery)
            return payload in got

        publisher.append("r.x.y", b"1")
        wait_for(lambda: works(b"1"))
        hung = servers.primary
        servers.freeze([hung])
        publisher.append("r.x.y", b"2")
        wait_for(lambda: works(b"2"))
        assert servers.primary != hung

        def hears() -> bool:
            publisher.publish("b.x.y", b"3")
            return works(b"3")

        wait_for(hears)
        for half in (publisher, receiver):
            half.close()


@contextmanager
def _tls_sentinel(folder: Path, server: TlsRedis) -> Iterator[str]:
    """The URL of a sentinel that speaks TLS only, and watches this server."""
    port, files = free_port(), folder / "updates" / "certificates"
    watched, query = urlsplit(server.url).port, urlsplit(server.url).query
    settings = [
        *("port 0", f"tls-port {port}", "bind 127.0.0.1", f"dir {folder}", "tls-replication yes"),
        *(f"tls-cert-file {files}/server.pem", f"tls-key-file {files}/server.key"),
        *(f"tls-client-cert-file {files}/client.pem", f"tls-client-key-file {files}/client.key"),
        *(f"tls-ca-cert-file {files}/{CA}.pem", "sentinel resolve-hostnames yes"),
        *("sentinel announce-hostnames yes", f"sentinel monitor due localhost {watched} 1"),
    ]
    path = folder / "sentinel.conf"
    path.write_text("\n".join(settings) + "\n")
    command = [require_program("redis-server"), str(path), "--sentinel"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as sentinel:
        try:
            yield f"rediss+sentinel://localhost:{port}/due?min_replicas=0&{query}"
        finally:
            sentinel.kill()


def test_tls_is_for_sentinels_and_servers(tmp_path):
    require_program("redis-server")
    with TlsRedis(tmp_path / "updates") as server, _tls_sentinel(tmp_path, server) as url:

        def answers() -> bool:
            try:
                wire = Wire(url)
            except UpdatesUnavailable:
                return False
            answer: bytes = wire.call("PING")
            wire.close()
            return answer == b"PONG"

        wait_for(answers)
        commands = client(url)
        assert commands.ping()
        commands.close()
        with pytest.raises(UpdatesUnavailable):
            Wire(url.partition("&")[0])
