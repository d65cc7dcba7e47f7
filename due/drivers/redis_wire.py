"""One connection to a Redis-protocol server: commands out, replies in, no waiting in between.

redis-py opens the connection (URL, sentinels, TLS, AUTH, database); afterwards we speak RESP2 ourselves, because a
pipelined, selectable connection is what the engine needs and redis-py's pub/sub costs several times the
parsing (RESP3, its default, formats each push into a log line).
"""

import socket
import ssl
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, cast

import hiredis
import redis

from due.drivers.redis_sentinel import is_sentinel, parse_sentinel_url, primary_client, primary_pool
from due.errors import InvalidOption, UpdatesUnavailable
from due.logs import without_passwords

_READ = 1 << 18
_PARSER_KEEPS = 1 << 20
"""Spare bytes that the parser keeps between messages instead of allocating them again."""
_SEND_ROOM = 1 << 20
"""The default buffer of a Unix socket holds two frames, so a writer would wait at every third."""
_JOIN_BELOW = 1 << 14
_ANSWER_SECONDS = 5.0
_SOON_SECONDS = 2.0
"""Of a client behind sentinels: another server may answer."""
_RECORD = 1 << 14
"""Most bytes of a TLS record."""
_MOST_PARTS = 512
"""Buffers per sendmsg; Linux allows at most 1,024."""


def client(url: str) -> redis.Redis:
    """A plain redis-py client for commands off the hot path; raises `InvalidOption` for a wrong URL.

    Behind sentinels each connection that it opens goes to the primary of that moment.
    """
    limits: dict[str, Any] = {"protocol": 2, "socket_timeout": 10, "socket_connect_timeout": 5}
    if is_sentinel(url):
        return primary_client(url, **limits | {"socket_timeout": _SOON_SECONDS})
    try:
        return redis.Redis.from_url(_redis_url(url), **limits)
    except ValueError as error:
        raise InvalidOption(f"Data Updates URL {without_passwords(url)!r}: {error}") from None


def _redis_url(url: str) -> str:
    for prefix in ("redis+unix://", "unix://"):
        if url.startswith(prefix):
            return "unix://" + url.removeprefix(prefix)
    if url.startswith(("redis://", "rediss://")):
        return url
    raise InvalidOption(
        f"Data Updates URL {without_passwords(url)!r}: use redis://host:port/0, rediss://…, "
        "redis+sentinel://host:port,host:port/service or unix:///path.sock"
    )


def as_user(url: str, name: str, password: str) -> str:
    """The URL of a server with this user and password; both have URL-safe characters only."""
    cluster = url.startswith(("kafka://", "kafkas://")) or is_sentinel(url)
    scheme, _, rest = (url if cluster else _redis_url(url)).partition("://")
    head, slash, tail = rest.partition("/")
    return f"{scheme}://{name}:{password}@{head.rpartition('@')[2]}{slash}{tail}"


@contextmanager
def understood(what: str) -> Iterator[None]:
    """Turn every error in an answer into `UpdatesUnavailable`, so that the connection is reopened."""
    try:
        yield
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise UpdatesUnavailable(f"the server's answer to {what} is not understood: {error!r}") from None


class Wire:
    """A connected socket with a reply parser.  Every failure is an `UpdatesUnavailable`.

    Behind sentinels it is connected to the primary, and gives up a server that is silent for 5 s while an answer is
    awaited: another one may be the primary by now.
    """

    def __init__(self, url: str) -> None:
        self.primary = ""
        """HOST:PORT to which the sentinels of the URL led; empty for a URL without."""
        self.replicas = 0
        """How many it had when the connection was opened; 0 for a URL without."""
        self._longest: float | None = None
        self._history = b""
        try:
            self._connection = self._connect(url)
        except (redis.RedisError, OSError, UnicodeError) as error:
            raise UpdatesUnavailable(
                f"Data Updates at {without_passwords(url)} cannot be reached: {error}"
            ) from None
        # redis-py has no public way to wait on several connections
        self._socket: socket.socket = self._connection._sock  # noqa: SLF001
        self._socket.settimeout(None)  # the time-out was for opening the connection
        self._reader = cast("Any", hiredis.Reader())  # its stub knows no buffer but bytes
        self._reader.setmaxbuf(_PARSER_KEEPS)
        # reused: the allocator would map and unmap a new one for each read
        self._buffer = bytearray(_READ)
        if self.primary:
            self._check_role()

    def _connect(self, url: str) -> Any:
        """An open connection of redis-py; raises redis.RedisError, OSError."""
        limits: dict[str, Any] = {
            "protocol": 2,
            "socket_timeout": _ANSWER_SECONDS,
            "socket_connect_timeout": _ANSWER_SECONDS,
            "retry": None,
        }
        if is_sentinel(url):
            pool, self.primary = primary_pool(parse_sentinel_url(url), **limits)
        else:
            pool = redis.ConnectionPool.from_url(_redis_url(url), **limits)
        connection = cast("Any", pool.make_connection())
        connection.connect()
        return connection

    def _check_role(self) -> None:
        """A sentinel may be behind the others: raises `UpdatesUnavailable` for a server that is no primary."""
        self._longest = _ANSWER_SECONDS
        limit = struct.pack("ll", int(_ANSWER_SECONDS), 0)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        try:
            told = _lines(self.call("INFO", "replication"))
        except UpdatesUnavailable:
            self.close()
            raise
        if b"role:master" not in told:
            self.close()
            raise UpdatesUnavailable(f"{self.primary}, to which the sentinels lead, is not the primary")
        self._history = _starting(told, b"master_replid:")
        found = _starting(told, b"connected_slaves:").partition(b":")[2]
        self.replicas = int(found) if found.isdigit() else 0

    def life(self) -> bytes:
        """Names the server and its present life: with another name its data may be older, and ids mean others.

        A server that was a replica in between has the same process, but another replication id.
        """
        return _starting(_lines(self.call("INFO", "server")), b"run_id:") + self._history

    def interrupt(self) -> None:
        """Make every other thread that waits here fail; the connection is lost."""
        with suppress(OSError):
            socket.socket.shutdown(self._socket, socket.SHUT_RDWR)

    def make_room(self) -> None:
        """Enlarge the socket's send buffer; only for senders that are throttled otherwise.

        An unthrottled sender would fill the server, which drops readers that are too slow.
        """
        if self._socket.family == socket.AF_UNIX:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_ROOM)

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def send(self, *arguments: bytes | str | int) -> None:
        """Send one command; a big last argument is not copied."""
        self.send_all([arguments])

    def send_all(self, commands: Sequence[tuple[bytes | str | int, ...]]) -> None:
        """Send commands with one system call if they are few; big last arguments are not copied."""
        parts = [part for arguments in commands for part in _parts(arguments)]
        if len(parts) == 1:
            self.send_packed(parts[0])
            return
        for first in range(0, len(parts), _MOST_PARTS):
            self._send_parts(parts[first : first + _MOST_PARTS])

    def send_packed(self, data: bytes) -> None:
        """Send packed commands."""
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise UpdatesUnavailable(f"connection lost while sending: {error}") from None

    def _send_parts(self, parts: list[bytes]) -> None:
        try:
            sent = self._socket.sendmsg(parts)
            total = sum(map(len, parts))
            if sent < total:
                self._send_rest(parts, sent)
        except NotImplementedError:  # TLS sockets cannot gather
            self.send_packed(b"".join(parts))
        except OSError as error:
            raise UpdatesUnavailable(f"connection lost while sending: {error}") from None

    def _send_rest(self, parts: list[bytes], sent: int) -> None:
        for part in parts:
            if sent < len(part):
                self._socket.sendall(memoryview(part)[sent:])
            sent = max(0, sent - len(part))

    def replies(self) -> Iterator[Any]:
        """Replies that have arrived; does not wait.  Error replies come as `hiredis.ReplyError`s."""
        try:
            size = self._receive_now()
        except (BlockingIOError, ssl.SSLWantReadError):
            return
        except OSError as error:
            raise UpdatesUnavailable(f"connection lost: {error}") from None
        yield from self._parsed(size)

    def wait(self, timeout: float | None = None) -> Iterator[Any]:
        """Like `replies`, but waits for the first bytes, at most `timeout` seconds."""
        try:
            self._socket.settimeout(self._longest if timeout is None else timeout)
            size = self._socket.recv_into(self._buffer)
        except TimeoutError:
            if timeout is not None:
                return
            raise UpdatesUnavailable(f"no answer within {self._longest} s") from None
        except OSError as error:
            raise UpdatesUnavailable(f"connection lost: {error}") from None
        finally:
            if self._socket.fileno() >= 0:
                self._socket.settimeout(None)
        yield from self._parsed(size)

    def call(self, *arguments: bytes | str | int) -> Any:
        """Send one command and wait for its reply, at most 5 s; only while nothing else is outstanding."""
        self.send(*arguments)
        deadline = time.monotonic() + _ANSWER_SECONDS
        while (left := deadline - time.monotonic()) > 0:
            for reply in self.wait(left):
                return reply
        raise UpdatesUnavailable(f"the server did not answer within {_ANSWER_SECONDS:g} s")

    def close(self) -> None:
        """Close the socket."""
        self._connection.disconnect()

    def _parsed(self, size: int) -> Iterator[Any]:
        """Replies that are complete with the first `size` bytes of the buffer."""
        if not size:
            raise UpdatesUnavailable("connection closed by the server")
        self._reader.feed(self._buffer, 0, size)
        while (reply := self._next()) is not False:
            yield reply

    def _next(self) -> Any:
        try:
            return self._reader.gets()
        except hiredis.ProtocolError as error:
            raise UpdatesUnavailable(f"the server does not speak the Redis protocol: {error}") from None

    def _receive_now(self) -> int:
        if not isinstance(self._socket, ssl.SSLSocket):
            return self._socket.recv_into(self._buffer, 0, socket.MSG_DONTWAIT)
        self._socket.settimeout(0.0)  # TLS sockets take no flags
        try:
            return self._receive_records(self._socket)
        finally:
            self._socket.settimeout(None)

    def _receive_records(self, tls: ssl.SSLSocket) -> int:
        """As many TLS records as are there: each read gives one at most, and a round for each is too slow.

        Whole ones only: of the rest of a record, which OpenSSL has taken from the socket already, `select` knows nothing.
        """
        size = 0
        with memoryview(self._buffer) as room:
            while size <= len(room) - _RECORD:
                try:
                    found = tls.recv_into(room[size:])
                except OSError:
                    if size:  # the next read says it again
                        break
                    raise
                if not found:
                    break
                size += found
        return size


def _lines(answer: Any) -> list[bytes]:
    return answer.splitlines() if isinstance(answer, bytes) else []


def _starting(lines: list[bytes], name: bytes) -> bytes:
    return next((line for line in lines if line.startswith(name)), name + b"unknown")


def _parts(arguments: tuple[bytes | str | int, ...]) -> list[bytes]:
    last = arguments[-1]
    if not isinstance(last, bytes) or len(last) < _JOIN_BELOW:
        return [pack(arguments)]
    head = pack((*arguments[:-1], b""))
    return [head[:-5] + b"%d\r\n" % len(last), last, b"\r\n"]


def pack(arguments: tuple[bytes | str | int, ...]) -> bytes:
    """One command as bytes."""
    return cast("bytes", hiredis.pack_command(cast("Any", arguments)))  # its stub lacks the dots
