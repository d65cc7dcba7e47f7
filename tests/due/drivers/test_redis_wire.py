"""Channel patterns match at least what the key does; wrong URLs and lost servers are our errors."""

import fnmatch
import socket
import ssl
import subprocess
import threading

import hiredis
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.drivers.redis_rights import channel_globs, covers
from due.drivers.redis_wire import Wire, client
from due.errors import InvalidOption, UpdatesUnavailable
from due.keys import Key
from tests.requirements import require_program

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
    """Port of a server that answers OK to every command, behind TLS."""
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
                while reader.gets() is not False:
                    connection.sendall(b"+OK\r\n")

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
