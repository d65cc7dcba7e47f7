"""The live page of a run: a Gantt chart of the fleet, drawn by the browser from the run's state."""

import asyncio
import socket
import threading
from collections.abc import Callable
from importlib.resources import files
from typing import Any, Final, Self

import orjson
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

_STOP_S: Final = 10.0
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
_FILES: Final = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}


class GanttPage:
    """Serves the page; a context manager.

    Args:
        state: what it shows, see `Watcher.state`.
        host: address to listen on; the page has no sign-in, so keep it on loopback.
        port: 0 takes a free one.
    """

    def __init__(self, state: Callable[[], dict[str, Any]], host: str = "127.0.0.1", port: int = 0) -> None:
        self._state = state
        self._socket = socket.create_server((host, port))
        self.url = f"http://{host}:{self._socket.getsockname()[1]}/"
        routes = [Route(path, self._file) for path in _FILES] + [Route("/state", self._tell)]
        config = uvicorn.Config(
            Starlette(routes=routes), log_config=None, access_log=False, lifespan="off", ws="none",
            limit_concurrency=100, server_header=False, timeout_graceful_shutdown=2,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=asyncio.run, args=(self._server.serve([self._socket]),), name="page", daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join(_STOP_S)

    async def _file(self, request: Request) -> Response:
        name, kind = _FILES[request.url.path]
        body = files("manufacturing.running").joinpath(name).read_bytes()
        return Response(body, media_type=kind, headers=_HEADERS)

    async def _tell(self, _request: Request) -> Response:
        return Response(orjson.dumps(self._state()), media_type="application/json", headers=_HEADERS)
