"""The embedded Data Updates server as a part: answers to PING are its heartbeats."""

import os
import signal
import socket
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from due.drivers.embedded_redis import EmbeddedServer
from due.errors import UpdatesUnavailable
from sdnator.errors import PipelineError
from sdnator.supervisor.child import how_ended, last_words, suspended

_PING, _PONG = b"PING\r\n", b"+PONG"
_PING_SECONDS = 1.0


class PingProbe:
    """Sends PING to a server on a Unix socket every second; never blocks."""

    def __init__(self, path: Path) -> None:
        self._path = str(path)
        self._socket: socket.socket | None = None
        self._asked = float("-inf")

    def answered(self, now: float) -> bool:
        """Whether an answer has come since the last call; `now` in seconds."""
        try:
            return self._exchange(now)
        except BlockingIOError:
            return False
        except OSError:
            self.close()
            return False

    def _exchange(self, now: float) -> bool:
        if self._socket is None:
            self._socket = socket.socket(socket.AF_UNIX)
            self._socket.setblocking(False)
            self._socket.connect(self._path)
        heard = self._heard(self._socket)
        if now - self._asked >= _PING_SECONDS:
            self._asked = now
            self._socket.send(_PING)
            heard = self._heard(self._socket) or heard
        return heard

    def _heard(self, opened: socket.socket) -> bool:
        with suppress(BlockingIOError):
            read = opened.recv(4096)
            if not read:
                raise ConnectionResetError
            return _PONG in read
        return False

    def close(self) -> None:
        """Drop the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._asked = float("-inf")


class UpdatesProcess:
    """A started embedded server.  `server` is the same one from start to start, and so is its URL.

    Raises:
        PipelineError: there is no program for it.
    """

    def __init__(self, server: EmbeddedServer) -> None:
        self._server = server
        try:
            server.begin()
        except UpdatesUnavailable as error:
            raise PipelineError(str(error)) from None
        self.log = server.log
        self.out_of_range = 0
        """A server runs no program of a switch."""
        self.pid = server.pid
        self._probe = PingProbe(server.socket)
        self._ready = False

    def ready(self) -> Mapping[str, Any] | None:
        """Its URL; None while it does not answer."""
        if not self._ready:
            # asked without waiting first: one that hangs would keep us
            self._ready = self._probe.answered(time.monotonic()) and self._server.answers()
        return {"updates": self._server.url} if self._ready else None

    def ended(self) -> str | None:
        """How it ended, with the end of its log; None while it runs."""
        code = self._server.exit_code()
        if code is None:
            return None
        return f"updates {how_ended(code)}{last_words(self.log)}"

    def beaten(self) -> bool:
        """Whether it has answered since the last call."""
        return self._probe.answered(time.monotonic())

    def suspended(self) -> bool:
        """Whether a signal such as SIGSTOP keeps it from running."""
        return suspended(self.pid)

    def files(self) -> Sequence[int]:
        """None: it is looked at often enough."""
        return ()

    def ask_to_end(self) -> None:
        """SIGTERM, also to a stopped one."""
        self._server.terminate()

    def kill(self) -> None:
        """SIGKILL."""
        if self._server.exit_code() is None:
            os.kill(self.pid, signal.SIGKILL)

    def close(self) -> None:
        """End it; its folder stays, for the next start."""
        self._probe.close()
        self._server.kill()
