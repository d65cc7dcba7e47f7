"""The HTTP API northbound: read-only, JSON, on loopback.

    GET /apps /instances /capabilities /interests /assignments /flow /health /metrics /openapi.json
    GET /apps/{app_id}/history      what happened to one app, from the archive
    GET /get?key=…                  items from the archive
    WebSocket /observe?key=…        live items; a slow reader misses some and is told how many

Requests with the Host or Origin of another site are refused, so that web pages cannot read the API. Where there is
a token, every request but that of /metrics brings it as `Authorization: Bearer …`; an app that may read from the
archive brings its own password instead, and gets /get with its keys, and nothing else.
At most two archive queries run at a time, for at most 10 s each; an answer has at most 10,000 items or 16 MiB.
"""

import asyncio
import hmac
import logging
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, overload
from urllib.parse import urlsplit

import msgspec
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
from coordinator.readers import ArchiveReader, ArchiveReaders
from coordinator.registry import Registry
from coordinator.web_server import web_server
from due import DueError, Engine, Item
from due.drivers.query_time import time_limit
from due.errors import BackendError, InvalidQuery, Timeout
from due.logs import LogLimit

log = logging.getLogger("coordinator.api")

_MAX_ITEMS = 10_000
_DEFAULT_ITEMS = 1000
_MAX_ANSWER_BYTES = 16 << 20
_MAX_QUERY_BYTES = 32 << 10
_QUERIES = 2
"""Concurrent archive queries; the rest of the Coordinator needs CPU time, too."""
_QUERY_S = 10.0
_WAIT_S = 5.0
_MAX_OBSERVERS = 64
_MAX_MESSAGE_BYTES = 4096
"""Clients of /observe send nothing."""
_QUEUE_ITEMS = 1000
_STOP_S = 5.0
_WINDOWS_NS = (60 * 10**9, 3600 * 10**9, 86_400 * 10**9, 2**62)
_POLICY_VIOLATION = 1008
_TRY_AGAIN_LATER = 1013
_INT64_DIGITS = 20
_JSON = {True: b"true", False: b"false"}
_TYPE = "application/json"
_BEARER = b"Bearer "
_NO_TOKEN = "send the Coordinator's token: Authorization: Bearer …"  # noqa: S105 - no token
_NOT_GRANTED = "this app may not read that; grant its keys by `sdnator app enrol --read` or [[grants]]"
Refused = Callable[[str, str, str], None]
"""Is told the path, the address and why."""


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
    """The server, in a thread of its own.  Raises OSError if it cannot listen on the address."""

    def __init__(
        self,
        northbound: Northbound,
        host: str,
        port: int,
        *,
        token: str = "",
        metrics_token: str = "",
        readers: ArchiveReaders | None = None,
    ) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.create_server((host, port), family=family)
        bound = self._socket.getsockname()[1]
        place = f"{f'[{host}]' if ':' in host else host}:{bound}"
        self.url = f"http://{place}"
        self.url_with_token = f"http://viewer:{token}@{place}" if token else self.url
        self.unauthorized = 0
        """Requests without the token, or for what their app may not read, so far."""
        self._told = LogLimit(log)
        self._server = web_server(
            application(northbound, host, token, metrics_token, self._refused, readers),
            lifespan="off",
            message_bytes=_MAX_MESSAGE_BYTES,
        )
        self._thread = threading.Thread(target=self._run, name="coordinator-api", daemon=True)

    def start(self) -> None:
        """Start serving."""
        self._thread.start()

    def stop(self) -> None:
        """Close connections and stop."""
        self._server.should_exit = True
        self._server.force_exit = True
        self._thread.join(_STOP_S)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])

    def _refused(self, path: str, source: str, why: str) -> None:
        self.unauthorized += 1
        self._told.error("a request of %.200r from %s was refused: %s", path, source, why)


class TokenGate:
    """ASGI: refuses whoever does not bring the token; metrics have one of their own, or are free for those who reach the
    port, and apps that may read from the archive reach /get with their password."""

    def __init__(
        self,
        app: Any,
        token: str,
        metrics_token: str = "",
        refused: Refused | None = None,
        readers: ArchiveReaders | None = None,
    ) -> None:
        self._app = app
        self._refused = refused
        self._readers = readers or ArchiveReaders(None)
        self._wanted = _BEARER + token.encode() if token else b""
        self._metrics = _BEARER + metrics_token.encode() if metrics_token else b""

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """ASGI."""
        if scope["type"] not in ("http", "websocket") or self._admits(scope):
            await self._app(scope, receive, send)
            return
        given = _given(scope)
        reader = self._readers.of(given.removeprefix(_BEARER)) if given.startswith(_BEARER) else None
        if reader is not None and (scope["type"], scope["path"]) == ("http", "/get"):
            scope.setdefault("state", {})["reader"] = reader
            await self._app(scope, receive, send)
            return
        why = "it had no token, or a wrong one" if reader is None else _only_get(reader[0])
        if self._refused is not None:
            self._refused(scope["path"], _source(scope), why)
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": _NO_TOKEN})
        elif reader is not None:
            await JSONResponse({"error": "Forbidden", "detail": _NOT_GRANTED}, 403)(scope, receive, send)
        else:
            answer = JSONResponse(
                {"error": "Unauthorized", "detail": _NO_TOKEN}, 401, {"WWW-Authenticate": "Bearer"}
            )
            await answer(scope, receive, send)

    def _admits(self, scope: Any) -> bool:
        given = _given(scope)
        if scope["path"] == "/metrics" and (not self._metrics or hmac.compare_digest(given, self._metrics)):
            return True
        if not self._wanted:
            return bool(scope["path"] != "/metrics")
        return hmac.compare_digest(given, self._wanted)


def _given(scope: Any) -> bytes:
    found: bytes = next((value for name, value in scope["headers"] if name == b"authorization"), b"")
    return found


def _source(scope: Any) -> str:
    return str((scope.get("client") or ("an unknown place",))[0])


def _only_get(app: str) -> str:
    return f"{app} may read some keys from the archive by /get, and nothing else"


def application(
    northbound: Northbound,
    host: str = "127.0.0.1",
    token: str = "",
    metrics_token: str = "",
    refused: Refused | None = None,
    readers: ArchiveReaders | None = None,
) -> Starlette:
    """The ASGI application; an empty token lets everybody read."""
    handlers = _Handlers(northbound, refused)
    hosts = sorted({"127.0.0.1", "localhost", "[::1]", host})
    gates = [Middleware(TrustedHostMiddleware, allowed_hosts=hosts)]
    return Starlette(
        routes=handlers.routes(),
        middleware=[
            *gates,
            Middleware(TokenGate, token=token, metrics_token=metrics_token, refused=refused, readers=readers),
        ]
        if token or metrics_token
        else gates,
        exception_handlers={DueError: _explain, ValueError: _explain},
    )


async def _explain(_request: Request, error: Exception) -> Response:
    """A wrong request gets 400, an unavailable backend 503."""
    status = 503 if isinstance(error, BackendError) else 400
    return JSONResponse({"error": type(error).__name__, "detail": str(error)}, status)


class _Handlers:
    def __init__(self, northbound: Northbound, refused: Refused | None) -> None:
        self._north = northbound
        self._refused = refused
        self._queries = asyncio.Semaphore(_QUERIES)
        self._observers = 0

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
        """Health of the Coordinator, and the last health report of every app."""
        shown = self._north.health() | {"apps": views.value(self._north.apps_health())}
        return JSONResponse(shown)

    async def history(self, request: Request) -> Response:
        """Events of one app: joining, leaving, activation and incompatible interests."""
        query = {"dataKey": self._north.events_key, "value.app_id": request.path_params["app_id"]}
        async with self._turn():
            return await run_in_threadpool(self._answer, query, request)

    async def get(self, request: Request) -> Response:
        """Items of a key, or of a query in the MongoDB dialect."""
        query = _query(request.query_params.get("query"))
        if "key" in request.query_params:
            of_key: dict[str, Any] = {"dataKey": request.query_params["key"]}
            query = {"$and": [query, of_key]} if query else of_key
        if not query:
            raise InvalidQuery("name a key (?key=…) or a query (?query={…})")
        reader: tuple[str, ArchiveReader] | None = getattr(request.state, "reader", None)
        if reader is not None:
            name, rights = reader
            if not all(map(rights.may_read, request.query_params.getlist("key"))):
                if self._refused is not None:
                    self._refused(str(request.url), _source(request.scope), f"{name} may not read that key")
                return JSONResponse({"error": "Forbidden", "detail": _NOT_GRANTED}, 403)
            query = rights.narrowed(query)
        async with self._turn():
            return await run_in_threadpool(self._answer, query, request)

    @asynccontextmanager
    async def _turn(self) -> AsyncIterator[None]:
        """Keep the event loop and the threads of other answers from waiting for the archive."""
        try:
            await asyncio.wait_for(self._queries.acquire(), _WAIT_S)
        except TimeoutError:
            raise Timeout(f"{_QUERIES} archive queries are running: try again later") from None
        try:
            yield
        finally:
            self._queries.release()

    def metrics(self, _request: Request) -> Response:
        """Metrics for Prometheus."""
        health = self._north.health()
        with self._north.lock:
            text, kind = render(self._north.registry, health, time.monotonic())
        return Response(text, media_type=kind)

    def openapi(self, _request: Request) -> Response:
        """The OpenAPI document."""
        return JSONResponse(document())

    async def observe(self, socket: WebSocket) -> None:
        """Live items of a key."""
        if not _same_site(socket):
            await socket.close(_POLICY_VIOLATION, "requests from other sites are refused")
            return
        if self._observers >= _MAX_OBSERVERS:
            await socket.close(_TRY_AGAIN_LATER, f"{_MAX_OBSERVERS} observers are connected already")
            return
        self._observers += 1
        try:
            await self._observe(socket)
        finally:
            self._observers -= 1

    async def _observe(self, socket: WebSocket) -> None:
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
        """The latest `limit` items, oldest first; `since` and `until` are ns.

        Searches the last minute first and goes back until there are enough: the archive may be large.
        """
        since = _number(request, "since", 0)
        until = _number(request, "until", None)
        limit = min(max(_number(request, "limit", _DEFAULT_ITEMS), 1), _MAX_ITEMS)
        with time_limit(_QUERY_S):
            found, start = self._found(query, since, until, limit)
        shown = list(_shown(found[-limit:]))
        more = len(found) > len(shown) or start > since
        return Response(
            b'{"items":[%b],"more":%b}' % (b",".join(reversed(shown)), _JSON[more]), media_type=_TYPE
        )

    def _found(
        self, query: dict[str, Any], since: int, until: int | None, limit: int
    ) -> tuple[list[Item], int]:
        """Items, and the time from which on all were searched.

        Without `until` there is no upper bound, because a host's clock may be ahead of ours.
        """
        found: list[Item] = []
        start = end = time.time_ns() + 1 if until is None else until
        for window in _WINDOWS_NS:
            start = max(since, end - window)
            bounds = {"$gte": start} if until is None else {"$gte": start, "$lt": until}
            found = self._north.engine.get({"$and": [query, {"timestamp": bounds}]}, limit=limit + 1)
            if len(found) >= limit or start == since:
                break
        return found, start


def _shown(items: Sequence[Item]) -> Iterator[bytes]:
    """Items as JSON, newest first, as many as fit into an answer."""
    size = 0
    for item in reversed(items):
        text = JSONResponse(views.item(item)).body
        size += len(text)
        if size > _MAX_ANSWER_BYTES:
            return
        yield bytes(text)


def _query(text: str | None) -> dict[str, Any]:
    if text is None:
        return {}
    if len(text) > _MAX_QUERY_BYTES:
        raise InvalidQuery(f"the query has {len(text)} characters: at most {_MAX_QUERY_BYTES}")
    try:
        query = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InvalidQuery(f"query is not valid JSON: {error}") from None
    if not isinstance(query, dict):
        raise InvalidQuery("query is a JSON object in the MongoDB dialect")
    return query


@overload
def _number(request: Request, name: str, default: int) -> int: ...
@overload
def _number(request: Request, name: str, default: None) -> int | None: ...
def _number(request: Request, name: str, default: int | None) -> int | None:
    text = request.query_params.get(name)
    if text is None:
        return default
    if not (text.removeprefix("-").isdecimal() and len(text) < _INT64_DIGITS):
        raise InvalidQuery(f"{name} is a whole number, not {text[:40]!r}")
    return int(text)


class _Feed:
    """Queue from the engine's thread to the event loop; bounded, the oldest items are dropped."""

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
            with suppress(RuntimeError):  # the event loop has ended: there is no reader any more
                self._loop.call_soon_threadsafe(self._ready.set)

    async def take(self) -> tuple[list[Item], int]:
        """Received items, and how many were missed since the last call."""
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


def _same_site(socket: WebSocket) -> bool:
    """Whether the Origin is ours: browsers send the page's origin, programs send none."""
    origin = socket.headers.get("origin")
    try:
        return origin is None or urlsplit(origin).netloc == socket.headers.get("host")
    except ValueError:  # half an IPv6 address
        return False
