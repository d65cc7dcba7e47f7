"""Questions of others: archive queries, the Coordinator's HTTP API, query texts and keys, bytes of frames."""

import asyncio
import json
import threading
from collections.abc import Callable
from functools import cache
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np

from apps.packets import PACKET_COLUMNS, read_columns, read_frames
from apps.sonata_adapter.errors import InvalidRequest, QueryTextError
from apps.sonata_adapter.host.payload import FrameBytes
from apps.sonata_adapter.keys import CAPTURE_PREFIX, QUERY_PREFIX, canonical_key, request_of
from apps.sonata_adapter.query.catalogue import CATALOGUE
from apps.sonata_adapter.query.dataflow import compile_query
from apps.sonata_adapter.query.language import text_lines
from apps.sonata_adapter.query.text import parse_queries
from benchmarks.hostile_messages import frames
from benchmarks.hostile_mutation import mutate_json, mutate_text
from benchmarks.hostile_target import DecoderTarget
from coordinator.api import Northbound, application
from coordinator.registry import Registry
from due import Item
from due.drivers.memory_archive import MemoryArchive
from due.drivers.query import parse
from due.errors import DueError, InvalidKey, InvalidQuery
from due.keys import Key

_WIDTH = 256
_ITEMS = tuple(
    Item(
        f"network.packets.p4runtime_ctrl.s{n % 3}", {"a": n, "text": "x" * n, "list": [n]}, n, n, "p", "i", n
    )
    for n in range(1, 20)
)
_QUERIES: tuple[Any, ...] = (
    {"dataKey": "network.*.p4runtime_ctrl.s1", "timestamp": {"$gte": 5, "$lt": 2**62}},
    {"$or": [{"value.a": {"$in": [1, 2, None]}}, {"$nor": [{"appId": "p"}, {"sequence": {"$ne": 3}}]}]},
    {"value.text": {"$regex": "^x+(x|y)*$", "$options": "i"}, "value.list": {"$size": 1, "$exists": True}},
    {"value": {"$not": {"$gt": 1.5}}, "$and": [{"instanceId": {"$nin": ["i", "j"]}}]},
)


@cache
def _archive() -> MemoryArchive:
    archive = MemoryArchive("memory://hostile")
    archive.insert(_ITEMS)
    return archive


def _query(data: bytes) -> object:
    query = parse(msgspec.json.decode(data))
    query.to_mongo(lambda _: [], {"timestamp": 5, "eventTime": 5})
    query.to_sql(lambda _: [], {"timestamp": 5, "eventTime": 5})
    return [query.matches(item) for item in _ITEMS]


class _Engine:
    """What the API asks of an engine."""

    def get(self, query: Any, *, limit: int | None = None) -> list[Item]:
        return _archive().find(query, limit=limit)

    def observe(self, key: str) -> Any:
        """Raises InvalidKey."""
        Key.parse(key)
        return self

    def subscribe(self, callback: Callable[[Item], None]) -> Any:
        """All there is comes at once."""
        for item in _ITEMS:
            callback(item)
        return self

    def dispose(self) -> None:
        """Nothing is held."""


class _Health(dict[str, Any]):
    """A Coordinator's, all of whose counters stand at 0."""

    def __missing__(self, _name: str) -> int:
        return 0


@cache
def _application() -> tuple[Callable[..., Any], asyncio.AbstractEventLoop]:
    north = Northbound(
        _Engine(),  # type: ignore[arg-type]
        Registry("c"),
        threading.Lock(),
        _Health,
        dict,
        "due.event.coordinator",
    )
    return application(north), asyncio.new_event_loop()


def coordinator_application() -> Callable[..., Any]:
    """The Coordinator's API around an archive in memory."""
    return _application()[0]


class _ServerError(Exception):
    """The API answered with 500."""


async def _answer(path: bytes, question: bytes) -> None:
    application, _ = _application()
    told: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        told.append(message)

    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET", "scheme": "http",
        "path": path.decode("latin-1"), "raw_path": path, "query_string": question, "root_path": "",
        "headers": [(b"host", b"127.0.0.1")], "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2),
    }  # fmt: skip
    await application(scope, receive, send)
    if told[0]["status"] == 500:
        raise _ServerError(str(told))


def _http(data: bytes) -> None:
    """A path, a blank and a query string, as a server takes them off the wire."""
    path, _, question = data.partition(b" ")
    _application()[1].run_until_complete(_answer(b"/" + path.lstrip(b"/"), question))


_HTTP = (
    b"/get key=network.packets.p4runtime_ctrl.s1&limit=3&since=0&until=99",
    b"/get query=" + quote(json.dumps(_QUERIES[1])).encode(),
    b"/get query=" + quote(json.dumps(_QUERIES[2])).encode() + b"&limit=-1",
    b"/apps/app/history limit=5",
    b"/apps ",
    b"/instances ",
    b"/health ",
    b"/metrics ",
    b"/flow ",
)


def _texts() -> tuple[bytes, ...]:
    """The catalogue's queries, as the language writes them."""
    made = []
    for template in CATALOGUE.values():
        query = template.query({each.name: each.default for each in template.parameters})
        body = "\n".join(text_lines(query.steps))
        made.append(f"query mine(window=3s, threshold=40):\n{body}\n".encode())
    return tuple(made)


def _text(data: bytes) -> object:
    found = parse_queries(data.decode("utf-8", "replace"))
    queries = [one.query({each.name: each.default for each in one.parameters}) for one in found]
    return [compile_query(query) for query in queries]


def _key(data: bytes) -> object:
    request = request_of(data.decode("utf-8", "surrogateescape"), CATALOGUE)
    return request and text_lines(request.query.steps)


_KEYS = (
    *(canonical_key(template).encode() for template in CATALOGUE.values()),
    f"{CAPTURE_PREFIX}.tcp:flag=syn,dst=10.0.0.0/8,dport=80,sport=1".encode(),
    f"{CAPTURE_PREFIX}.dns:src=fe80%3A%3A1/64".encode(),
    f"{QUERY_PREFIX}.new_tcp:window=3000ms,threshold=7".encode(),
)


def _frame_rows(data: bytes) -> object:
    """The same frame, whole and cut, beside a genuine one: columns, DNS fields, patterns."""
    rows = [data, data[: len(data) // 2], frames(1)[0]]
    count = len(rows)
    numbers = range(count)
    batch = read_frames(
        rows,
        lengths=[len(row) for row in rows],
        times_us=numbers,
        ports=[1] * count,
        sequence=numbers,
        arrival=numbers,
    )
    read_columns(batch, PACKET_COLUMNS, "frames")
    cut = [row[:_WIDTH] for row in rows]
    seen = FrameBytes(np.array(cut, dtype=f"V{_WIDTH}"), np.array([len(row) for row in cut], np.uint16))
    return seen.dns(), seen.payload_contains(b"zorro")


def _dns() -> bytes:
    """A question for a name over UDP and IPv4."""
    name = b"\x07example\x03com\x00\x00\xff\x00\x01"
    question = b"\x12\x34\x01\x00\x00\x01" + bytes(6) + name
    udp = (
        (1234).to_bytes(2, "big")
        + (53).to_bytes(2, "big")
        + (8 + len(question)).to_bytes(2, "big")
        + bytes(2)
    )
    total = (20 + len(udp) + len(question)).to_bytes(2, "big")
    ipv4 = b"\x45\x00" + total + bytes(5) + b"\x11" + bytes(2) + bytes((10, 0, 0, 1, 10, 0, 0, 2))
    return bytes(12) + b"\x08\x00" + ipv4 + udp + question


TARGETS = (
    DecoderTarget(
        "archive query",
        _query,
        (InvalidQuery, InvalidKey, msgspec.DecodeError, UnicodeDecodeError, RecursionError),
        tuple(json.dumps(query).encode() for query in _QUERIES),
        mutate_json,
    ),
    DecoderTarget("coordinator http", _http, (DueError,), _HTTP, mutate_text),
    DecoderTarget("query text", _text, (QueryTextError, InvalidRequest), _texts(), mutate_text),
    DecoderTarget("query key", _key, (InvalidRequest, InvalidKey), _KEYS, mutate_text),
    DecoderTarget("packet headers", _frame_rows, (), (*frames(), _dns())),
)
