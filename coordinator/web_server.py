"""The web server of the HTTP API and of the dashboard: nobody can keep all connections, neither with silence nor with half
a request, nor by reading nothing."""

import asyncio
import os
import resource
import socket
from typing import Any, Final, Literal, cast

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

WAIT_SECONDS = 10.0
"""Within this time after connecting, or after the last answer, a request has come completely; a client may
leave an answer unread for as long."""
MOST_CONNECTIONS = 256
"""Open at once, WebSockets among them, if so many descriptors are allowed."""
_SHARE = 4
"""Part of the descriptors that connections may take; files, the archive and Data Updates need the others."""
_ACCEPTED_AT_ONCE: Final = 32
_UNREAD_MS: Final = 30_000
"""After this time the kernel gives up a client that reads nothing, also when the connection is closed already."""


def web_server(
    app: Any, *, lifespan: Literal["on", "off"] = "on", message_bytes: int = 16 << 20
) -> uvicorn.Server:
    """A server that is about to be run with a socket that listens.

    Args:
        app: ASGI.
        lifespan: whether the app is told when the server starts and stops.
        message_bytes: most bytes of a message of a WebSocket.
    """
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=BrowserConnection,
            log_level="warning",
            access_log=False,
            lifespan=lifespan,
            ws_max_size=message_bytes,
            backlog=_ACCEPTED_AT_ONCE,
            # every local user could give any address; who runs a proxy says so
            proxy_headers="FORWARDED_ALLOW_IPS" in os.environ,
        )
    )


class BrowserConnection(H11Protocol):
    """HTTP up to a WebSocket, which is another protocol's; h11, because it limits the size of what comes before a body.

    made ──► waiting ──request complete──► answering ──answer complete, or not read──► waiting ──WAIT_SECONDS──► closed
    """

    _deadline: asyncio.TimerHandle | None = None
    """None: not waiting."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Make room for it."""
        room = _room(self.connections)
        super().connection_made(cast("asyncio.Transport", transport))
        connection: socket.socket = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNREAD_MS)
        if room:
            self._watch()
        else:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is to come."""
        self._wait(on=False)
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """After bytes came."""
        super().handle_events()
        self._watch()

    def on_response_complete(self) -> None:
        """After an answer."""
        super().on_response_complete()
        self._watch()

    def pause_writing(self) -> None:
        """When an answer waits to be read."""
        super().pause_writing()
        self._watch()

    def resume_writing(self) -> None:
        """When it is read."""
        super().resume_writing()
        self._watch()

    def _watch(self) -> None:
        coming = self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
        answered = self.cycle is None or self.cycle.response_complete
        upgraded = self.transport.get_protocol() is not self
        self._wait(on=not upgraded and (coming or answered or self.flow.write_paused))

    def _wait(self, *, on: bool) -> None:
        if on and self._deadline is None:
            self._deadline = self.loop.call_later(WAIT_SECONDS, self.transport.abort)
        elif not on and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    @property
    def waiting_until(self) -> float:
        """On the loop's clock; infinite while a request is answered."""
        return self._deadline.when() if self._deadline is not None else float("inf")

    def give_way(self) -> None:
        """Close it for another one."""
        self.connections.discard(self)
        self.transport.abort()


def _room(connections: set[Any]) -> bool:
    """Whether there is room for one more, for which the one that has waited longest is closed: a browser that has
    just connected sends its request at once."""
    if len(connections) < min(MOST_CONNECTIONS, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // _SHARE):
        return True
    idle = [
        one for one in connections if isinstance(one, BrowserConnection) and one.waiting_until < float("inf")
    ]
    if idle:
        min(idle, key=lambda one: one.waiting_until).give_way()
    return bool(idle)
