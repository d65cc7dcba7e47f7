"""Data Archives on a MongoDB server, through pymongo.  URL: `mongodb://host/database?collection=name`.

    <collection>         one document per frame or item: dataKey, appId, instanceId, count, and first and last
                         of timestamp, eventTime and sequence; `value` where BSON holds it exactly, else `payload`
    <collection>_keys    every dataKey, and how far apart the items of one of its documents may lie
    <collection>_parts   the rest of payloads that are larger than a document may be

`?app=NAME` gives each app collections of its own: see `mongodb_apps`.  What is sharded on a cluster, and by which key:
`mongodb_sharding`.  What is deleted when: `mongodb_retention`.

A query narrows on the server by index on key and time; `query.matches` decides item by item.
"""

import logging
import math
import os
import threading
import time
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from operator import itemgetter
from typing import Any, TypeAlias
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from bson import Int64
from bson.errors import BSONError
from pymongo import MongoClient
from pymongo.collection import Collection
from pymongo.cursor import Cursor
from pymongo.database import Database
from pymongo.errors import BulkWriteError, ConnectionFailure, ExecutionTimeout, PyMongoError
from pymongo.uri_parser import parse_uri

from due.codec import pack, unpack
from due.drivers.lasting import NOTHING, SHARE, Lasting
from due.drivers.latest_items import by_age, latest_items
from due.drivers.mongodb_latest import HEAD, batch_size, latest_to_end, named_keys
from due.drivers.mongodb_retention import MongoRetention, naming, number
from due.drivers.mongodb_sharding import SHARD_KEYS, shard
from due.drivers.query import ArchiveQuery, parse
from due.drivers.query_time import in_time, time_left
from due.drivers.query_tree import Condition
from due.errors import ArchiveUnavailable, BackendError, DecodeError, InvalidOption
from due.keys import ANY, Key
from due.messages import Item, PackedFrame

Document: TypeAlias = dict[str, Any]

log = logging.getLogger("due.archive")

_PART_BYTES = 12 << 20
_DUPLICATE = 11000
_DOCUMENT_OVERHEAD = 300
_MAX_NAMED_KEYS = 1000
_NOTE_SECONDS = 60.0
_INT64 = 2**63
_SERVER_SELECTION_MS = "3000"


class MongoArchive:
    """`ArchiveDriver` over one collection; connects at the first call.  Raises InvalidOption for a wrong URL.

    Args:
        url: of server, database and collection.
        ending: of the names of the collection and its two companions.
    """

    def __init__(self, url: str, *, ending: str = "") -> None:
        self._ending = ending
        parts = urlsplit(url)
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        self._collection = options.pop("collection", "items")
        self._database = parts.path.strip("/") or "due"
        options.setdefault("serverSelectionTimeoutMS", _SERVER_SELECTION_MS)
        self._url = urlunsplit(parts._replace(query=urlencode(options), path="/" + parts.path.strip("/")))
        self.shown = f"{parts.scheme}://{parts.hostname}/{self._database}"
        if parts.scheme not in ("mongodb", "mongodb+srv") or not parts.netloc or "/" in self._database:
            raise InvalidOption(f"archive URL {self.shown!r}: write mongodb://host:port/database")
        if parts.scheme == "mongodb":
            _check_options(self._url, self.shown)
        self._lock = threading.Lock()
        self._client: MongoClient[Document] | None = None
        self._pid = 0
        self._closed = False
        self._spans: dict[str, tuple[int, int]] = {}
        self._noted_at = 0.0
        self._retention = MongoRetention(self._table)
        self.damaged = 0
        """Documents that could not be decoded and are missing from results."""

    def insert(self, items: Sequence[Item]) -> None:
        """Store items, one document each."""
        with self.errors():
            self._insert([_item_document(item) for item in items], [])

    def insert_frames(self, frames: Sequence[PackedFrame]) -> None:
        """Store frames unchanged; item by item if an index is wanted or a frame is stored partly."""
        documents = []
        for frame in frames:
            if frame.index:
                documents += [_item_document(item) for item in unpack(frame)]
            else:
                documents.append(_frame_document(frame))
        with self.errors():
            self._insert(documents, frames)

    def find(self, query: Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Items that match, oldest first (timestamp, then sequence); of more than `limit` the latest."""
        parsed = parse(query)
        with self.errors():
            criteria, span = self._criteria(parsed)
            if limit is not None:
                with closing(self._latest_to_end(criteria, span, limit)) as heads:
                    return latest_items(heads, lambda some: self._read(naming(some), parsed), limit)
            items = list(self._read(criteria, parsed))
        items.sort(key=by_age)
        return items

    def prune(
        self, *, before: int | None = None, max_bytes: int | None = None, lasting: Lasting = NOTHING
    ) -> int:
        """Delete documents that are wholly older than `before`, then the oldest down to `max_bytes`."""
        with self.errors():
            deleted = self._retention.older(before, lasting)
            if max_bytes is not None:
                deleted += self._retention.larger(max_bytes, lasting, max_bytes // SHARE)
            self._retention.forget_keys()
            return deleted

    def tend(self) -> None:
        """Nothing to do: the client looks after its connections."""

    def close(self) -> None:
        """Close connections; further calls raise BackendError."""
        self._closed = True
        with self._lock:
            if self._client is not None and self._pid == os.getpid():
                self._client.close()
            self._client = None

    # --- connection ----------------------------------------------------------------------------

    def _table(self, companion: str = "") -> Collection[Document]:
        return self._named(self._name(companion))

    def _name(self, companion: str = "") -> str:
        return "_".join(filter(None, (self._collection, companion))) + self._ending

    def _named(self, name: str) -> Collection[Document]:
        if self._closed:
            raise BackendError(f"archive {self.shown} is closed")
        with self._lock:
            if self._client is None or self._pid != os.getpid():
                self._client, self._pid, self._spans = client_of(self._url), os.getpid(), {}
                try:
                    self._prepare(self._client[self._database])
                except PyMongoError:
                    self._client = None
                    raise
            return self._client[self._database][name]

    def _prepare(self, database: Database[Document]) -> None:
        """Make indexes, and shard the collections on a cluster."""
        table = database[self._name()]
        table.create_index(list(SHARD_KEYS[""].items()))
        table.create_index([("dataKey", 1), ("eventTime", 1)])
        table.create_index([("instanceId", 1), ("dataKey", 1), ("lastSequence", 1)])
        shard(database, {self._name(companion): key for companion, key in SHARD_KEYS.items()})

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn errors of the client library into ours."""
        try:
            yield
        except (ConnectionFailure, ExecutionTimeout) as error:
            raise ArchiveUnavailable(f"archive {self.shown}: {_short(error)}") from error
        except (PyMongoError, BSONError, OverflowError, UnicodeEncodeError) as error:
            raise BackendError(f"archive {self.shown}: {_short(error)}") from error

    # --- writing -------------------------------------------------------------------------------

    def _insert(self, documents: Sequence[Document], frames: Sequence[PackedFrame]) -> None:
        table = self._table()
        by_name = {(frame.instance_id, frame.key, frame.sequence): frame for frame in frames}
        fresh: dict[str, Document] = {}
        for (instance, key), group in _streams(documents).items():
            there = self._stored(table, instance, key, group)
            for document in group:
                overlap = [
                    r for r in there if r[0] <= document["lastSequence"] and r[1] >= document["sequence"]
                ]
                if not overlap:
                    fresh.setdefault(document["_id"], document)
                elif document["count"] > 1 and overlap != [(document["sequence"], document["lastSequence"])]:
                    items = unpack(by_name[instance, key, document["sequence"]])
                    missing = (i for i in items if not any(a <= i.sequence <= b for a, b in overlap))
                    fresh |= {one["_id"]: one for one in map(_item_document, missing)}
        self._note_keys(fresh.values())
        self._store(table, list(fresh.values()))

    def _stored(
        self, table: Collection[Document], instance: str, key: str, group: Sequence[Document]
    ) -> list[tuple[int, int]]:
        """Stored ranges of sequence numbers of this stream that may overlap."""
        low = min(document["sequence"] for document in group)
        high = max(document["lastSequence"] for document in group)
        found = table.find(
            {"instanceId": {"$eq": instance}, "dataKey": {"$eq": key}, "lastSequence": {"$gte": low}},
            {"sequence": 1, "lastSequence": 1},
        )
        return [(int(d["sequence"]), int(d["lastSequence"])) for d in found if d["sequence"] <= high]

    def _store(self, table: Collection[Document], documents: Sequence[Document]) -> None:
        large = [document for document in documents if len(document.get("payload", b"")) > _PART_BYTES]
        parts = [part for document in large for part in _split(document)]
        for one in parts:
            self._table("parts").replace_one({"_id": {"$eq": one["_id"]}}, one, upsert=True)
        if not documents:
            return
        try:
            table.insert_many(documents, ordered=False)
        except BulkWriteError as error:
            faults = [fault for fault in error.details.get("writeErrors", ()) if fault["code"] != _DUPLICATE]
            if faults or error.details.get("writeConcernErrors"):
                raise

    def _note_keys(self, documents: Iterable[Document]) -> None:
        """Record the keys, and the largest span of the items in one document."""
        if time.monotonic() - self._noted_at > _NOTE_SECONDS:  # a key may have been pruned
            self._noted_at = time.monotonic()
            self._spans = {}
        widest: dict[str, tuple[int, int]] = {}
        for document in documents:
            span, event = widest.get(document["dataKey"], (0, 0))
            widest[document["dataKey"]] = (
                max(span, document["lastTimestamp"] - document["timestamp"]),
                max(event, document["lastEventTime"] - document["eventTime"]),
            )
        for key, (span, event) in widest.items():
            known = self._spans.get(key)
            if known is not None and span <= known[0] and event <= known[1]:
                continue
            spans = (2 * span, 2 * event)
            change = {"$max": {"timeSpan": Int64(spans[0]), "eventSpan": Int64(spans[1])}}
            self._table("keys").update_one({"_id": {"$eq": key}}, change, upsert=True)
            self._spans[key] = (max(spans[0], known[0]), max(spans[1], known[1])) if known else spans

    # --- reading -------------------------------------------------------------------------------

    def _read(self, criteria: Mapping[str, Any], query: ArchiveQuery) -> Iterator[Item]:
        for document in in_time(self._find(criteria)):
            try:
                yield from _items(self._joined(document), query)
            except (DecodeError, KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
                self.damaged += 1
                if self.damaged == 1:
                    log.error(  # noqa: TRY400 - no trace needed
                        "archive %s: a document is damaged and left out: %r; further ones are only counted",
                        self.shown,
                        error,
                    )

    def _find(self, criteria: Mapping[str, Any], fields: Document | None = None) -> Cursor[Document]:
        left = time_left()
        found = self._table().find(criteria, fields)
        return found if left is None else found.max_time_ms(math.ceil(1000 * left))

    def _latest_to_end(
        self, criteria: Mapping[str, Any], span: int, limit: int
    ) -> Generator[tuple[int, Document], None, None]:
        """Documents that meet the criteria with the time of their last item, the greatest first."""
        keys = named_keys(criteria)
        if keys is None:
            found = [(number(one, "lastTimestamp"), one) for one in in_time(self._find(criteria, HEAD))]
            yield from sorted(found, key=itemgetter(0), reverse=True)
            return
        batch = batch_size(limit, len(keys))

        def read(key: str) -> Generator[Document, None, None]:
            of_key = {**criteria, "dataKey": {"$eq": key}}
            with closing(self._find(of_key, HEAD).sort("timestamp", -1).batch_size(batch)) as documents:
                yield from in_time(documents)

        yield from latest_to_end(keys, read, span)

    def _criteria(self, query: ArchiveQuery) -> tuple[dict[str, Any], int]:
        """What the server is asked for, and the most nanoseconds between the items of one document."""
        named = list(query.conditions("dataKey"))
        keys = list(self._table("keys").find(_key_range(named)))

        def lookup(condition: Condition) -> list[str]:
            matches = ArchiveQuery(condition).matches
            return [d["_id"] for d in keys if matches(Item(d["_id"], None, 0, 0, "", "", 0))]

        spans = {
            "timestamp": max((int(d.get("timeSpan", 0)) for d in keys), default=0),
            "eventTime": max((int(d.get("eventSpan", 0)) for d in keys), default=0),
        }
        criteria = query.to_mongo(lookup, spans)
        if not named and len(criteria) and len(keys) <= _MAX_NAMED_KEYS and "dataKey" not in criteria:
            # without a key no index would be used
            criteria = {"dataKey": {"$in": [d["_id"] for d in keys]}} | criteria
        return criteria, spans["timestamp"]

    def _joined(self, document: Document) -> Document:
        count = document.get("parts", 0)
        if not count:
            return document
        names = [f"{document['_id']}#{n}" for n in range(count)]
        parts = {d["_id"]: d["payload"] for d in self._table("parts").find({"_id": {"$in": names}})}
        return document | {"payload": b"".join(parts[name] for name in names if name in parts)}


def _check_options(url: str, shown: str) -> None:
    """Refuse unknown options, for which pymongo would only warn."""
    try:
        parse_uri(url, warn=False)
    except (PyMongoError, ValueError, TypeError) as error:
        raise InvalidOption(f"archive URL {shown!r}: {_short(error)}") from error


def _streams(documents: Sequence[Document]) -> dict[tuple[str, str], list[Document]]:
    streams: dict[tuple[str, str], list[Document]] = defaultdict(list)
    for document in documents:
        streams[document["instanceId"], document["dataKey"]].append(document)
    return streams


def _item_document(item: Item) -> Document:
    document = _frame_document(pack([item]))
    if _is_exact(item.value):
        del document["payload"]
        document["value"] = item.value
    return document


def _frame_document(frame: PackedFrame) -> Document:
    return {
        "_id": f"{frame.sequence}|{frame.key}|{frame.instance_id}",
        "dataKey": frame.key,
        "appId": frame.app_id,
        "instanceId": frame.instance_id,
        "count": frame.count,
        "sequence": Int64(frame.sequence),
        "lastSequence": Int64(frame.sequence + frame.count - 1),
        "timestamp": Int64(frame.first_timestamp),
        "lastTimestamp": Int64(frame.last_timestamp),
        "eventTime": Int64(frame.first_event_time),
        "lastEventTime": Int64(frame.last_event_time),
        "bytes": len(frame.payload) + _DOCUMENT_OVERHEAD,
        "payload": frame.payload,
    }


def _split(document: Document) -> Iterator[Document]:
    """Move a large payload out of its document."""
    payload, document["payload"] = document["payload"], b""
    starts = range(0, len(payload), _PART_BYTES)
    document["parts"] = len(starts)
    for part, start in enumerate(starts):
        yield {"_id": f"{document['_id']}#{part}", "payload": payload[start : start + _PART_BYTES]}


def _items(document: Document, query: ArchiveQuery) -> Iterator[Item]:
    if "payload" in document:
        yield from filter(query.matches, unpack(document["payload"]))
        return
    item = Item(
        key=document["dataKey"],
        value=_plain(document.get("value")),
        timestamp=int(document["timestamp"]),
        event_time=int(document["eventTime"]),
        app_id=document["appId"],
        instance_id=document["instanceId"],
        sequence=int(document["sequence"]),
    )
    if query.matches(item):
        yield item


def _is_exact(value: Any, depth: int = 0) -> bool:
    """Whether BSON, and every server that supports it, returns the value unchanged."""
    kind = type(value)
    if value is None or kind in (bool, bytes):
        return True
    if kind is int:
        return bool(-_INT64 <= value < _INT64)
    if kind is float:
        return math.isfinite(value)
    if kind is str:
        return "\x00" not in value
    if depth > 50:
        return False
    if kind is list:
        # FerretDB takes no list in a list
        return all(type(element) is not list and _is_exact(element, depth + 1) for element in value)
    if kind is not dict:
        return False
    return all(_is_field(name) and _is_exact(element, depth + 1) for name, element in value.items())


def _is_field(name: Any) -> bool:
    return isinstance(name, str) and name != "" and not name.startswith("$") and not set(name) & {".", "\x00"}


def _plain(value: Any) -> Any:
    """A BSON value without BSON's own types."""
    if isinstance(value, Int64):
        return int(value)
    if isinstance(value, list):
        return [_plain(element) for element in value]
    if isinstance(value, dict):
        return {name: _plain(element) for name, element in value.items()}
    return value


def _key_range(named: Sequence[Condition]) -> Document:
    """Filter on the table of keys: no key that meets the first condition lies outside."""
    first = next((c for c in named if c.operator == "eq" and not c.negated), None)
    if first is None:
        return {}
    pattern: Key = first.operand
    prefix = pattern.path.partition(ANY)[0].removesuffix(".")
    # '~' sorts after every character that a key may contain
    return {"_id": {"$gte": prefix, "$lt": prefix + "~"}} if prefix else {}


def _short(error: Exception) -> str:
    text = str(error)
    return text if len(text) <= 200 else text[:200] + " …"


def client_of(url: str) -> MongoClient[Document]:
    """A client whose writes are acknowledged by a majority of a replica set, unless the URL says another `w`.

    What a producer was told is stored then survives the primary's death; a single server is its own majority.

    Args:
        url: with the options of MongoDB's connection strings.
    """
    says_so = any(name.lower() == "w" for name, _ in parse_qsl(urlsplit(url).query))
    return MongoClient(url) if says_so else MongoClient(url, w="majority")
