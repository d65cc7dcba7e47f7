"""A relay passes bytes on until it is cut, and takes connections again when it is mended."""

import socket
import threading

import pytest

from benchmarks.chaos_links import UnixLink


@pytest.fixture
def echo(tmp_path):
    """A server that sends back what it gets."""
    path = tmp_path / "server.sock"
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()

    def answer(opened):
        with opened:
            while data := opened.recv(4096):
                opened.sendall(data)

    def serve():
        while True:
            try:
                opened, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=answer, args=(opened,), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    yield path
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()


def connected(link):
    opened = socket.socket(socket.AF_UNIX)
    opened.settimeout(30)
    opened.connect(link.url.removeprefix("unix://"))
    return opened


def test_a_cut_ends_connections_and_a_mended_link_takes_new_ones(tmp_path, echo):
    """What a part sees of a server that is away for a while."""
    link = UnixLink(tmp_path / "link.sock", echo)
    with connected(link) as first:
        first.sendall(b"ping")
        assert first.recv(4) == b"ping"
        link.cut()
        assert first.recv(4) == b""
    with connected(link) as second:
        second.sendall(b"pong")
        second.settimeout(0.2)
        with pytest.raises(TimeoutError):
            second.recv(4)
        link.mend()
        second.settimeout(30)
        assert second.recv(4) == b"pong"
    link.close()


def test_a_slow_link_passes_everything_on(tmp_path, echo):
    """Slow is not lossy."""
    link = UnixLink(tmp_path / "link.sock", echo)
    link.slow()
    with connected(link) as opened:
        opened.sendall(b"x" * 5_000)
        came = b""
        while len(came) < 5_000:
            came += opened.recv(4096)
    assert came == b"x" * 5_000
    link.close()


def test_what_is_sent_into_a_held_link_arrives_when_it_is_mended(tmp_path, echo):
    """A cable that is pulled without anybody's notice."""
    link = UnixLink(tmp_path / "link.sock", echo)
    with connected(link) as opened:
        link.hold()
        opened.sendall(b"ping")
        opened.settimeout(0.2)
        with pytest.raises(TimeoutError):
            opened.recv(4)
        link.mend()
        opened.settimeout(30)
        assert opened.recv(4) == b"ping"
    link.close()
