"""Serves the pages: which browsers are answered, and the web server around NiceGUI, in a thread of its own."""

import asyncio
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from sdnator.dashboard.page_backend import PageBackend

_HISTORY = 100
"""Messages kept for a browser whose connection breaks; the next frame makes up for the others."""
_RECONNECT_SECONDS = 30.0
"""How long a browser may be away without its page being loaded anew."""
_HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    # not "no-referrer": with that browsers send forms of our own pages without their origin
    b"referrer-policy": b"same-origin",
}


def named_well(host: str, names: Iterable[str]) -> bool:
    """Whether a Host header may be answered: a foreign name that leads to us would be another site's trick."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:  # half an IPv6 address
        return False
    if name == "localhost" or name in names:
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class Guard:
    """Refuses requests under foreign names or from pages of other sites; adds headers that browsers heed."""

    def __init__(self, app: Any, names: Iterable[str]) -> None:
        self._app = app
        self._names = frozenset(names)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """ASGI."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        host = headers.get(b"host", b"").decode("latin-1")
        origin = headers.get(b"origin", b"").decode("latin-1")
        if named_well(host, self._names) and (not origin or _of_host(origin, host)):
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            text = b"refused: this name is not among dashboard.names\n"
            await send({"type": "http.response.start", "status": 403, "headers": []})
            await send({"type": "http.response.body", "body": text})


def _of_host(origin: str, host: str) -> bool:
    try:
        return urlsplit(origin).netloc == host
    except ValueError:  # half an IPv6 address
        return False


def _with_headers(send: Any) -> Any:
    async def answer(message: Any) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS.items()]
        await send(message)

    return answer


def serve(
    service: "PageBackend", listener: socket.socket, started: Callable[[Callable[[], None]], None]
) -> None:
    """Run until stopped; `started` gets the function that stops it."""
    from fastapi import FastAPI
    from nicegui import ui
    from starlette.middleware.sessions import SessionMiddleware

    from coordinator.web_server import web_server
    from sdnator.dashboard.access_control import AccessControl
    from sdnator.dashboard.page import build

    app = FastAPI(openapi_url=None)
    app.add_middleware(AccessControl, sessions=service.sessions, noted=service.note)
    # added last, so that it reads the cookie before the gate asks for it; forgotten with the process: who was signed in
    # signs in again
    app.add_middleware(
        SessionMiddleware,
        secret_key=secrets.token_urlsafe(32),
        session_cookie="sdnator",
        same_site="strict",
        max_age=None,
    )
    ui.run_with(
        app,
        root=lambda: build(service),
        title="SDNator",
        dark=None,
        tailwind=False,
        binding_refresh_interval=None,
        message_history_length=_HISTORY,
        reconnect_timeout=_RECONNECT_SECONDS,
        show_welcome_message=False,
    )
    server = web_server(Guard(app, service.settings.names))

    def stop() -> None:
        server.should_exit = True
        server.force_exit = True

    started(stop)
    asyncio.run(server.serve(sockets=[listener]))
