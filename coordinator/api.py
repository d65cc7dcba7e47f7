"""The HTTP API northbound: read-only, JSON, on loopback.

    GET /apps /instances /capabilities /interests /assignments /flow /health /metrics /openapi.json
    GET /apps/{app_id}/history      what happened to one app, from the archive
    GET /get?key=…                  items from the archive
    WebSocket /observe?key=…        items as they come; a slow reader misses some and is told how many

Requests whose Host or Origin is another site's are refused, so that no web page reads along.
"""

import asyncio
import json
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from coordinator import views
from coordinator.metrics import render
from coordinator.openapi import document
from coordinator.registry import Registry
from due import DueError, Engine, Item
from due.errors import BackendError, InvalidQuery

_MAX_ITEMS = 10_000
_DEFAULT_ITEMS = 1000
_QUEUE_ITEMS = 1000
_STOP_S = 5.0
_WINDOWS_NS = (60 * 10**9, 3600 * 10**9, 86_400 * 10**9, 2**62)
_POLICY_VIOLATION = 1008


@dataclass(frozen=True)
class Northbound:
    """What the API shows."""

    engine: Engine
    registry: Registry
    lock: threading.Lock
    """Guards the registry."""
    health: Callable[[], dict[str, Any]]
    apps_health: Callable[[], dict[str, Any]]
    events_key: str


class Api:
    """The server, in a thread of its own.  Raises OSError where the address cannot be had."""

    def __init__(self, northbound: Northbound, host: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.create_server((host, port), family=family)
        bound = self._socket.getsockname()[1]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{bound}"
        config = uvicorn.Config(
            application(northbound, host), log_level="warning", lifespan="off", access_log=False
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="coordinator-api", daemon=True)

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def stop(self) -> None:
        """Close connections and stop."""
        self._server.should_exit = True
        self._server.force_exit = True
        self._thread.join(_STOP_S)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


def application(northbound: Northbound, host: str = "127.0.0.1") -> Starlette:
    """The ASGI application."""
    handlers = _Handlers(northbound)
    hosts = sorted({"127.0.0.1", "localhost", "[::1]", host})
    return Starlette(
        routes=handlers.routes(),
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=hosts)],
        exception_handlers={DueError: _explain, ValueError: _explain},
    )


async def _explain(_request: Request, error: Exception) -> Response:
    """What the user asked wrongly is 400, what a backend cannot do now 503."""
    status = 503 if isinstance(error, BackendError) else 400
    return JSONResponse({"error": type(error).__name__, "detail": str(error)}, status)


class _Handlers:
    def __init__(self, northbound: Northbound) -> None:
        self._north = northbound

    def routes(self) -> list[BaseRoute]:
        shown = [Route(path, self._show(view), methods=["GET"]) for path, view in views.VIEWS.items()]
        return [
            *shown,
            Route("/apps/{app_id}/history", self.history, methods=["GET"]),
            Route("/health", self.health, methods=["GET"]),
            Route("/get", self.get, methods=["GET"]),
            Route("/metrics", self.metrics, methods=["GET"]),
            Route("/openapi.json", self.openapi, methods=["GET"]),
            WebSocketRoute("/observe", self.observe),
        ]

    def _show(self, view: Callable[[Registry, float], Any]) -> Callable[[Request], Response]:
        def handler(_request: Request) -> Response:
            with self._north.lock:
                shown = view(self._north.registry, time.monotonic())
            return JSONResponse(shown)

        return handler

    def health(self, _request: Request) -> Response:
        """Of the Coordinator, and what every app last said of itself."""
        shown = self._north.health() | {"apps": views.value(self._north.apps_health())}
        return JSONResponse(shown)

    def history(self, request: Request) -> Response:
        """Joining, leaving, activation and incompatible wishes of one app."""
        query = {"dataKey": self._north.events_key, "value.app_id": request.path_params["app_id"]}
        return self._answer(query, request)

    def get(self, request: Request) -> Response:
        """Items of a key, or of a query in the MongoDB dialect."""
        query: dict[str, Any] = {}
        if "query" in request.query_params:
            query = json.loads(request.query_params["query"])
            if not isinstance(query, dict):
                raise InvalidQuery("query is a JSON object in the MongoDB dialect")
        if "key" in request.query_params:
            query = {"$and": [query, {"dataKey": request.query_params["key"]}]} if query else _of_key(request)
        if not query:
            raise InvalidQuery("name a key (?key=…) or a query (?query={…})")
        return self._answer(query, request)

    def metrics(self, _request: Request) -> Response:
        """For Prometheus."""
        health = self._north.health()
        with self._north.lock:
            text, kind = render(self._north.registry, health, time.monotonic())
        return Response(text, media_type=kind)

    def openapi(self, _request: Request) -> Response:
        """This API, described."""
        return JSONResponse(document())

    async def observe(self, socket: WebSocket) -> None:
        """Items of a key as they come."""
        if not _same_site(socket):
            await socket.close(_POLICY_VIOLATION, "requests from other sites are refused")
            return
        await socket.accept()
        feed = _Feed(asyncio.get_running_loop())
        try:
            observation = self._north.engine.observe(socket.query_params.get("key", ""))
            subscription = await run_in_threadpool(observation.subscribe, feed.put)
        except DueError as error:
            await socket.send_json({"error": type(error).__name__, "detail": str(error)})
            await socket.close(_POLICY_VIOLATION)
            return
        try:
            await _until_closed(socket, feed)
        finally:
            await run_in_threadpool(subscription.dispose)

    def _answer(self, query: dict[str, Any], request: Request) -> Response:
        """The youngest `limit` items, oldest first; `since` and `until` are ns.

        Looks at the last minute first and farther back while there is too little: the archive may be large.
        """
        since = int(request.query_params.get("since", 0))
        until = int(request.query_params.get("until", time.time_ns() + 1))
        limit = min(max(int(request.query_params.get("limit", _DEFAULT_ITEMS)), 1), _MAX_ITEMS)
        found: list[Item] = []
        start = until
        for window in _WINDOWS_NS:
            start = max(since, until - window)
            bounds = {"timestamp": {"$gte": start, "$lt": until}}
            found = self._north.engine.get({"$and": [query, bounds]}, limit=limit + 1)
            if len(found) >= limit or start == since:
                break
        shown = [views.item(one) for one in found[-limit:]]
        return JSONResponse({"items": shown, "more": len(found) > limit or start > since})


class _Feed:
    """From the engine's thread to the event loop; bounded, the oldest items give way."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._items: deque[Item] = deque()
        self._missed = 0
        self._lock = threading.Lock()
        self._ready = asyncio.Event()

    def put(self, item: Item) -> None:
        with self._lock:
            if len(self._items) >= _QUEUE_ITEMS:
                self._items.popleft()
                self._missed += 1
            self._items.append(item)
            wake = len(self._items) == 1
        if wake:
            with suppress(RuntimeError):  # the loop has ended: nobody reads any more
                self._loop.call_soon_threadsafe(self._ready.set)

    async def take(self) -> tuple[list[Item], int]:
        """What has come, and how many items were missed since the last call."""
        await self._ready.wait()
        self._ready.clear()
        with self._lock:
            items, missed = list(self._items), self._missed
            self._items.clear()
            self._missed = 0
        return items, missed


async def _until_closed(socket: WebSocket, feed: _Feed) -> None:
    sending = asyncio.ensure_future(_send(socket, feed))
    closing = asyncio.ensure_future(_wait_for_close(socket))
    _, pending = await asyncio.wait((sending, closing), return_when=asyncio.FIRST_COMPLETED)
    for task in pending:
        task.cancel()
    await asyncio.gather(sending, closing, return_exceptions=True)


async def _send(socket: WebSocket, feed: _Feed) -> None:
    while True:
        items, missed = await feed.take()
        if missed:
            await socket.send_json({"missed": missed})
        for one in items:
            await socket.send_json(views.item(one))


async def _wait_for_close(socket: WebSocket) -> None:
    with suppress(WebSocketDisconnect):
        while True:
            await socket.receive_text()


def _of_key(request: Request) -> dict[str, Any]:
    return {"dataKey": request.query_params["key"]}


def _same_site(socket: WebSocket) -> bool:
    """Browsers name the page's origin; programs name none."""
    origin = socket.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == socket.headers.get("host")
