"""Channel patterns match at least what the key does; wrong URLs and lost servers are our errors."""

import array
import fcntl
import fnmatch
import select
import socket
import ssl
import subprocess
import termios
import threading

import hiredis
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers import redis_wire
from due.drivers.redis_rights import channel_globs, covers
from due.drivers.redis_wire import Wire, client
from due.errors import InvalidOption, UpdatesUnavailable
from due.keys import Key
from tests.due.conftest import wait_for
from tests.requirements import require_program

_BIG = b"$20990\r\n" + bytes(20_990) + b"\r\n"
_PIECE = 1500
"""Bytes of a TLS record of the server."""

paths = st.lists(st.sampled_from(["a", "b-c", "d_"]), min_size=1, max_size=4).map(".".join)
patterns = st.lists(st.sampled_from(["a", "b-c", "*"]), min_size=1, max_size=3).flatmap(
    lambda parts: st.sampled_from([".".join(parts), ".".join([*parts, "**"])])
)


@given(patterns, paths)
def test_a_channel_pattern_misses_nothing(pattern, path):
    if Key(pattern).matches_path(path):
        assert any(fnmatch.fnmatchcase(path, glob) for glob in channel_globs(pattern))


@given(patterns, patterns, paths)
def test_what_covers_a_pattern_has_all_of_its_paths(wide, narrow, path):
    if covers(wide, narrow) and Key(narrow).matches_path(path):
        assert Key(wide).matches_path(path)


def test_big_and_small_commands_survive(server):
    wire = Wire(server.url)
    for size in (0, 1, 16383, 16384, 3_000_000):
        assert wire.call("SET", "t.wire", bytes(size)) == b"OK"
        assert len(wire.call("GET", "t.wire")) == size
    wire.close()


@pytest.mark.parametrize("url", ["http://x", "mongodb://x", "", "redis://host:port/0"])
def test_a_wrong_url_is_an_invalid_option(url):
    with pytest.raises(InvalidOption, match="Data Updates URL"):
        client(url)


def test_a_missing_server_is_unavailable(tmp_path):
    with pytest.raises(UpdatesUnavailable, match="cannot be reached"):
        Wire(f"unix://{tmp_path / 'none.sock'}")


@pytest.fixture
def tls_server(tmp_path):
    """Port of a server behind TLS that answers GET with 14 records and every other command with OK."""
    certificate, secret = tmp_path / "certificate.pem", tmp_path / "key.pem"
    make = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost", "-days", "1"]
    openssl = require_program("openssl")
    subprocess.run([openssl, *make, "-out", certificate, "-keyout", secret], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, secret)

    def serve() -> None:
        with context.wrap_socket(listener.accept()[0], server_side=True) as connection:
            reader = hiredis.Reader()
            while data := connection.recv(65536):
                reader.feed(data)
                while (command := reader.gets()) is not False:
                    answer = _BIG if command[0] == b"GET" else b"+OK\r\n"
                    for start in range(0, len(answer), _PIECE):
                        connection.sendall(answer[start : start + _PIECE])

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        thread.join(10)


def test_over_tls_silence_is_no_lost_connection(tls_server):
    wire = Wire(f"rediss://127.0.0.1:{tls_server}/0?ssl_cert_reqs=none")
    assert list(wire.replies()) == []
    assert wire.call("SET", "t.wire", bytes(100_000)) == b"OK"
    assert list(wire.replies()) == []
    wire.close()


@pytest.fixture
def answered(tls_server):
    """A connection in whose socket the whole answer to a GET waits."""
    wire = Wire(f"rediss://127.0.0.1:{tls_server}/0?ssl_cert_reqs=none")
    wire.send("GET", "t.wire")
    arrived = array.array("i", [0])

    def there() -> bool:
        fcntl.ioctl(wire.fileno(), termios.FIONREAD, arrived)
        return arrived[0] > len(_BIG) + 14 * 16

    wait_for(there)
    yield wire
    wire.close()


def test_over_tls_one_read_takes_all_records_that_are_there(answered):
    """A round for each of them made subscribers so slow that redis-server cut them off."""
    assert [len(reply) for reply in answered.replies()] == [20_990]


@pytest.mark.parametrize("room", [16_384, 16_999, 20_000])
def test_over_tls_nothing_is_left_where_select_does_not_see_it(room, tls_server, monkeypatch, request):
    """A record that does not fit any more is not begun: its rest would wait until the server sends something else."""
    monkeypatch.setattr(redis_wire, "_READ", room)
    wire = request.getfixturevalue("answered")
    found: list[bytes] = []
    while not found:
        assert select.select([wire], [], [], 30)[0]
        found = list(wire.replies())
    assert len(found[0]) == 20_990
