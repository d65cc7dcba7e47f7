"""Where P4Runtime is served: a Unix socket that only its user can connect to, or HOST:PORT if that was asked for.

Any client that connects can become primary and set tables, so a socket file of mode 0600 in a folder of mode 0700 is
the default; a TCP port is open to everybody who reaches it, on 127.0.0.1 to every user of the machine.

DataplaneError
└── ServerError    the server cannot listen where it was told to
"""

import atexit
import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dataplane.errors import DataplaneError

UNIX = "unix:"
_LONGEST = 107
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class ServerError(DataplaneError):
    """The server cannot listen where it was told to."""


def default_address(name: str) -> str:
    """A Unix socket under $XDG_RUNTIME_DIR, or under $XDG_STATE_HOME (~/.local/state) where there is none.

    Where that path is longer than the kernel takes, the socket is in a new folder of mode 0700 under $TMPDIR,
    which goes with the process.

    name: of the socket, without its folder

    Raises ServerError.
    """
    runtime, state = os.environ.get("XDG_RUNTIME_DIR"), os.environ.get("XDG_STATE_HOME")
    try:
        base = Path(runtime) if runtime else Path(state or Path.home() / ".local" / "state")
    except RuntimeError as error:
        raise ServerError(
            "there is neither a home folder nor XDG_RUNTIME_DIR: give an address with --grpc"
        ) from error
    path = base / "sdnator" / "run" / name
    if len(os.fsencode(path)) > _LONGEST:
        folder = tempfile.mkdtemp(prefix="sdnator-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        path = Path(folder) / name
    return f"{UNIX}{path}"


def socket_path(address: str) -> Path | None:
    """The file of a `unix:` address; None where it is HOST:PORT."""
    return Path(address.removeprefix(UNIX)) if address.startswith(UNIX) else None


def is_address(text: str) -> bool:
    """Whether it looks like HOST:PORT or unix:/PATH, and not like the name of something."""
    path = socket_path(text)
    if path is not None:
        return path.is_absolute()
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdecimal()


@contextmanager
def ready_to_bind(address: str) -> Iterator[None]:
    """Within it gRPC may bind the address; tried first, since gRPC writes lines of its own about a failure.

    Raises ServerError where it cannot be bound, or where others could connect to the socket afterwards.
    """
    path = socket_path(address)
    if path is None:
        _try_port(address)
        yield
        return
    try:
        _make_room(path)
        before = os.umask(0o177)  # gRPC gives the file no mode of its own
        try:
            yield
        finally:
            os.umask(before)
        status = path.lstat()
    except OSError as error:
        raise ServerError(f"cannot listen on {address}: {error.strerror or error}") from error
    if not stat.S_ISSOCK(status.st_mode) or stat.S_IMODE(status.st_mode) & 0o177:
        raise ServerError(f"{path} is not a socket of mode 0600: others could connect to it")


def _make_room(path: Path) -> None:
    """The folder is there, and no socket that answers.  Raises ServerError, OSError."""
    if not path.is_absolute():
        raise ServerError(f"the socket {path} must be an absolute path")
    if len(os.fsencode(path)) > _LONGEST:
        raise ServerError(f"the path of the socket {path} is too long: {_LONGEST} bytes at most")
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder = path.parent.stat()
    open_to_all = folder.st_mode & _OTHERS_WRITE and not folder.st_mode & stat.S_ISVTX
    if open_to_all or folder.st_uid not in (0, os.geteuid()):
        raise ServerError(
            f"others could replace sockets in {path.parent}: use a folder of your own with mode 0700"
        )
    if not os.path.lexists(path):
        return
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise ServerError(f"cannot listen on {UNIX}{path}: there is a file that is not a socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()  # its server has died
            return
    raise ServerError(f"cannot listen on {UNIX}{path}: another switch serves there")


def _try_port(address: str) -> None:
    host, _, port = address.rpartition(":")
    try:
        family, kind, _, _, where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)[
            0
        ]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
    except (OSError, ValueError, OverflowError) as error:
        cause = getattr(error, "strerror", None) or error
        raise ServerError(
            f"cannot listen on {address}: {cause}; choose another HOST:PORT, or unix:/PATH"
        ) from error
