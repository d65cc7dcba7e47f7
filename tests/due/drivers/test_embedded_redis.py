"""The embedded server comes up on a private socket, is joined by the second user, and leaves nothing behind."""

import stat
from contextlib import suppress
from pathlib import Path

from due.drivers.embedded_redis import EmbeddedServer, shared_server
from due.drivers.redis_wire import Wire


def _ping(url: str) -> bytes:
    wire = Wire(url)
    answer: bytes = wire.call("PING")
    wire.close()
    return answer


def _open_files(pid: int) -> set[str]:
    found = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # of a client that has just left
            found.add(str(descriptor.readlink()))
    return found


def test_it_listens_on_a_private_socket_only(tmp_path):
    with EmbeddedServer(tmp_path) as server:
        assert _ping(server.url) == b"PONG"
        assert stat.S_IMODE(server.socket.stat().st_mode) == 0o700
        listening = [
            line.split() for line in Path(f"/proc/{server.pid}/net/tcp").read_text().splitlines()[1:]
        ]
        inodes = _open_files(server.pid)
        assert not [row for row in listening if f"socket:[{row[9]}]" in inodes]
        pid = server.pid
    assert not server.socket.exists()
    assert not Path(f"/proc/{pid}").exists()


def test_a_directory_of_its_own_is_removed():
    server = EmbeddedServer().start()
    folder = server.socket.parent
    server.stop()
    assert not folder.exists()


def test_a_long_path_is_no_obstacle(tmp_path):
    with EmbeddedServer(tmp_path / ("x" * 120)) as server:
        assert _ping(server.url) == b"PONG"


def test_tcp_means_loopback(tmp_path):
    with EmbeddedServer(tmp_path, tcp=True) as server:
        assert _ping(server.tcp_url) == b"PONG"


def test_the_second_user_of_a_folder_joins_the_first(tmp_path):
    url, mine = shared_server(tmp_path)
    same, none = shared_server(tmp_path)
    assert (same, none) == (url, None)
    assert mine is not None
    mine.stop()
    _, again = shared_server(tmp_path)
    assert again is not None
    again.stop()


def test_a_durable_server_remembers(tmp_path):
    with EmbeddedServer(tmp_path, durable=True) as server:
        wire = Wire(server.url)
        wire.call("SET", "kept", "yes")
        wire.close()
        server.kill()
        server.start()
        wire = Wire(server.url)
        assert wire.call("GET", "kept") == b"yes"
        wire.close()
