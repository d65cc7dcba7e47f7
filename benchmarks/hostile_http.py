"""Requests of browsers, scrapers and programs: the Coordinator's API, the pages' guard, an app's metrics."""

import asyncio
import atexit
import io
import random
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from benchmarks.hostile_messages import ALERT, CONFIRMATION, DECISION, INCIDENT, STATE
from benchmarks.hostile_mutation import mutate_text, mutate_value
from benchmarks.hostile_queries import coordinator_application
from benchmarks.hostile_target import DecoderTarget
from due import Item
from due.codec import decode_value, encode_value
from due.errors import DecodeError, DueError
from due.status_server import StatusServer
from sdnator.dashboard.server import Guard
from sdnator.dashboard.service import DashboardService
from sdnator.dashboard.settings import Settings

_FEW = 64


class UnexpectedAnswer(Exception):
    """Answered with 500: an error that nobody expected."""


def _lines(data: bytes) -> tuple[list[bytes], list[tuple[bytes, bytes]], bytes]:
    """The parts of the first line, headers, body; as a server takes them off the wire, whatever they are."""
    head, _, body = data.partition(b"\n\n")
    first, *rest = head.split(b"\n")
    headers = [
        (name.strip().lower(), value.strip())
        for name, _, value in (line.partition(b":") for line in rest[:_FEW])
    ]
    return [*first.split(b" ", 2), b"", b"", b""][:3], headers, body


@cache
def _loop() -> asyncio.AbstractEventLoop:
    made = asyncio.new_event_loop()
    atexit.register(made.close)
    return made


def _asked(application: Callable[..., Any], scope: dict[str, Any], messages: list[dict[str, Any]]) -> None:
    """Raises UnexpectedAnswer where the answer is one."""
    told: list[dict[str, Any]] = []
    waiting = iter(messages)

    async def receive() -> dict[str, Any]:
        return next(waiting, {"type": scope["type"] + ".disconnect", "code": 1000})

    async def send(message: dict[str, Any]) -> None:
        told.append(message)

    _loop().run_until_complete(application(scope, receive, send))
    for each in told:
        if each.get("status") == 500:
            raise UnexpectedAnswer(str(told)[:2000])


def _scope(kind: str, path: bytes, question: bytes, headers: list[tuple[bytes, bytes]]) -> dict[str, Any]:
    return {
        "type": kind, "asgi": {"version": "3.0"}, "http_version": "1.1", "scheme": kind.replace("socket", ""),
        "path": path.decode("latin-1"), "raw_path": path, "query_string": question, "root_path": "",
        "headers": headers, "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2), "subprotocols": [],
    }  # fmt: skip


def _request(data: bytes) -> None:
    """METHOD PATH QUERY, headers, a body."""
    (method, path, question), headers, body = _lines(data)
    scope = _scope("http", b"/" + path.lstrip(b"/"), question, headers)
    scope["method"] = method.decode("latin-1")
    halves = [body[: len(body) // 2], body[len(body) // 2 :]]
    messages = [
        {"type": "http.request", "body": half, "more_body": not number} for number, half in enumerate(halves)
    ]
    _asked(coordinator_application(), scope, messages)


def _observe(data: bytes) -> None:
    """A query string, headers, messages to a socket that only speaks."""
    (question, _, _), headers, body = _lines(data)
    messages: list[dict[str, Any]] = [{"type": "websocket.connect"}]
    messages += [{"type": "websocket.receive", "bytes": line} for line in body.split(b"\n")[:4]]
    _asked(coordinator_application(), _scope("websocket", b"/observe", question, headers), messages)


async def _page(_scope: Any, _receive: Any, send: Any) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": []})


def _guarded(data: bytes) -> None:
    """Headers of a browser; its first line says whether it wants a socket."""
    (kind, path, question), headers, _ = _lines(data)
    name = "websocket" if kind.startswith(b"W") else "http"
    _asked(Guard(_page, ["box.example"]), _scope(name, path, question, headers), [])


class _Wire:
    """A connection on which a whole request has come."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.sent = 0

    def makefile(self, *_: Any) -> io.BytesIO:
        return io.BytesIO(self._data)

    def settimeout(self, _: float) -> None:
        pass

    def sendall(self, data: bytes) -> None:
        self.sent += len(data)


@cache
def _status() -> StatusServer:
    made = StatusServer("127.0.0.1:0")
    atexit.register(made.close)
    made.report("# TYPE a counter\na 1\n", {"status": "ok"})
    return made


def _scraped(data: bytes) -> None:
    server = _status()._server
    server.RequestHandlerClass(_Wire(data), ("127.0.0.1", 1), server)


class _Handlers:
    """What an engine is told to call, by key."""

    def __init__(self) -> None:
        self.by_key: dict[str, Callable[[Item], None]] = {}
        self._key = ""

    def observe(self, key: str) -> "_Handlers":
        self._key = key
        return self

    def subscribe(self, handler: Callable[[Item], None]) -> None:
        self.by_key[self._key] = handler


@cache
def _dashboard() -> tuple[DashboardService, list[tuple[str, Callable[[Item], None]]]]:
    handlers = _Handlers()
    made = DashboardService(handlers, Settings())  # type: ignore[arg-type]
    made._subscribe()
    return made, sorted(handlers.by_key.items())


def _shown(data: bytes) -> None:
    """The first byte says under which key the value comes; pages ask the board for what it made of it."""
    value = decode_value(data[1:])
    dashboard, handlers = _dashboard()
    key, handle = handlers[data[0] % len(handlers)]
    handle(Item(key.replace("*", "s1"), value, _NOW, _NOW, key.split(".")[2], "i1", 1))
    board = dashboard.board
    board.standing(), board.present(), board.rates_by_key(), board.open_incidents(), board.scores.rate(1.0)


def _mutate_shown(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    seed = chance.choice(seeds)
    return seed[:1] + mutate_value(chance, (seed[1:],))


def _shown_seeds() -> tuple[bytes, ...]:
    """Each genuine message under its key, and under that of another."""
    values: dict[str, Any] = {
        "network.anomaly.kitsune.score": {"count": 3, "over": 1, "max": 2.5, "score": np.ones(3)},
        "network.anomaly.kitsune.alert": ALERT.to_value(),
        "network.block.firewall.*": DECISION.to_value(),
        "network.confirmation.*.*": CONFIRMATION.to_value(),
        "network.switch.p4runtime_ctrl.*": STATE,
        "network.answer.firewall.dashboard": {"id": "i1", "done": True, "text": "x"},
        "due.health.*": {"engine": {"written": 5, "keys": {"a.b": 3}}, "state": "ok"},
        "network.incident.firewall.*": INCIDENT,
    }
    _, handlers = _dashboard()
    numbers = {key: number for number, (key, _) in enumerate(handlers)}
    return tuple(bytes((numbers[key],)) + encode_value(value) for key, value in values.items())


_NOW = 1_700_000_000_000_000_000
_HOST = b"\nhost: 127.0.0.1\n"
_REQUESTS = (
    b"GET /get key=a.b&limit=3&since=-1&until=99" + _HOST,
    b'POST /get query={"dataKey":"a.*"}'
    + _HOST
    + b'content-length: 12\ncontent-type: text/json\n\n{"a": [1, 2]}',
    b"GET /apps/app/history limit=5" + _HOST + b"origin: http://127.0.0.1\n",
    b"HEAD /metrics " + _HOST + b"accept: text/plain\naccept-encoding: gzip\n",
    b"OPTIONS /openapi.json " + _HOST + b"cookie: a=b; c=d\nrange: bytes=0-5\n",
)
_OBSERVED = (
    b"key=network.*.a:x=1|2" + _HOST + b"origin: http://127.0.0.1\n\nhello",
    b"key=%2A%2A" + b"\nhost: [::1]:5\norigin: http://[::1]:5\n",
)
_BROWSERS = (
    b"GET / a=b\nhost: box.example:80\norigin: http://box.example:80\n",
    b"WS /_nicegui_ws/socket.io a\nhost: [::1]:8080\norigin: http://[::1]:8080\n",
    b"POST / \nhost: 10.0.0.1\norigin: https://evil.example/x\n",
)
_SCRAPES = (
    b"GET /metrics?a=b HTTP/1.1\r\nHost: 127.0.0.1:9\r\nAccept: */*\r\nConnection: close\r\n\r\n",
    b"GET /healthz HTTP/1.0\r\nHost: [::1]:9\r\nExpect: 100-continue\r\n\r\n",
    b"POST /healthz HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nabcde",
    b"GET /healthz\r\n",
)

TARGETS = (
    DecoderTarget("dashboard message", _shown, (DecodeError,), _shown_seeds(), _mutate_shown),
    DecoderTarget("coordinator request", _request, (DueError,), _REQUESTS, mutate_text),
    DecoderTarget("coordinator observe", _observe, (), _OBSERVED, mutate_text),
    DecoderTarget("dashboard guard", _guarded, (), _BROWSERS, mutate_text),
    DecoderTarget("app metrics http", _scraped, (), _SCRAPES, mutate_text),
)
