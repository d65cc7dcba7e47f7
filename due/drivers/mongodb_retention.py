"""Retention on MongoDB: documents are deleted by key and time, some at a time.

    keys ─► oldest documents of each, by index ─► their parts ─► themselves

The Coordinator calls it with its settings `retain_s` and `retain_bytes`, as on the other archives.  No TTL index does
it: that would be a second place for the same setting, on each writer's collection; it deletes by one date alone, so
neither by size, nor what belongs to a document elsewhere; and it would be one more index to write.

A deletion names key and time, so on a sharded cluster it goes to the shards that have these.
"""

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from heapq import merge
from itertools import islice
from typing import Any, TypeAlias

from pymongo.collection import Collection
from pymongo.errors import OperationFailure

from due.drivers.lasting import Lasting

Document: TypeAlias = dict[str, Any]

_EMPTY_SECONDS = 600.0
_STEP = 1000
"""Documents that are deleted at a time."""
_AHEAD = 20_000
"""Documents that are read ahead, of all keys together."""
_PASSES = 8
_LEAST_BYTES = 1 << 20
"""A pass deletes half of what is too much, or this: the server may count more bytes than a document says of itself."""
_NO_COLLECTION = 26
_FIELDS = {"dataKey": 1, "timestamp": 1, "count": 1, "bytes": 1, "parts": 1}


class MongoRetention:
    """Deletes from an archive's collections.

    Args:
        table: the collection, or its companion of this name.
    """

    def __init__(self, table: Callable[[str], Collection[Document]]) -> None:
        self._table = table
        self._empty: dict[str, float] = {}
        """Keys without a document, and since when that is known (s, monotonic)."""

    def older(self, before: int | None, lasting: Lasting) -> int:
        """Delete documents that are wholly older; the number of items.

        Args:
            before: ns since the epoch; None: all are young enough.
            lasting: for these its own moment counts.
        """
        lasts, others = self._divided(lasting)
        of_each = ((others, before), (lasts, lasting.before))
        return sum(
            self._older_of(key, moment) for keys, moment in of_each if moment is not None for key in keys
        )

    def larger(self, max_bytes: int, lasting: Lasting, room: int) -> int:
        """Delete the oldest documents until the rest is small enough; the number of items.

        Args:
            max_bytes: of all documents.
            lasting: these go only as far as they exceed their room.
            room: bytes.
        """
        if self.size() <= max_bytes:
            return 0
        lasts, others = self._divided(lasting)
        deleted = self._passes(lasts, lambda: min(self.size() - max_bytes, self.size_of(lasts) - room))
        return deleted + self._passes(others, lambda: self.size() - max_bytes)

    def _passes(self, keys: Sequence[str], excess: Callable[[], int]) -> int:
        deleted = 0
        for _ in range(_PASSES):
            too_much = excess()
            step = self._oldest_of(keys, _part(too_much)) if too_much > 0 else 0
            if not step:
                break
            deleted += step
        return deleted

    def size_of(self, keys: Sequence[str]) -> int:
        """Bytes of these keys' documents, as each says of itself.

        Args:
            keys: concrete ones.
        """
        return sum(
            number(one, "bytes")
            for key in keys
            for one in self._table("").find({"dataKey": {"$eq": key}}, {"bytes": 1})
        )

    def lasting_size(self, lasting: Lasting) -> int:
        """Bytes of the documents that last.

        Args:
            lasting: which do.
        """
        return self.size_of(self._divided(lasting)[0])

    def size(self) -> int:
        """Bytes of all documents: as the server counts them, without reading them, where it may be asked."""
        try:
            return sum(self._stored_bytes(companion) for companion in ("", "parts"))
        except OperationFailure:
            return sum(number(one, "bytes") for one in self._table("").find({}, {"bytes": 1}))

    def forget_keys(self) -> None:
        """Remove keys that have had no document for a while; writers record theirs again each minute."""
        now, keys, empty = time.monotonic(), self._table("keys"), dict[str, float]()
        for entry in list(keys.find({})):
            name = {"dataKey": {"$eq": entry["_id"]}}
            if self._table("").find_one(name, {"_id": 1}) is not None:
                continue
            since = empty[entry["_id"]] = self._empty.get(entry["_id"], now)
            if now - since < _EMPTY_SECONDS:
                continue
            keys.delete_one({"_id": {"$eq": entry["_id"]}})
            if self._table("").find_one(name, {"_id": 1}) is not None:  # written meanwhile
                keys.replace_one({"_id": {"$eq": entry["_id"]}}, entry, upsert=True)
        self._empty = empty

    def _divided(self, lasting: Lasting) -> tuple[list[str], list[str]]:
        """Keys whose documents last, and the others."""
        keys = [entry["_id"] for entry in self._table("keys").find({}, {"_id": 1})]
        lasts = dict.fromkeys(lasting.among(keys))
        return list(lasts), [key for key in keys if key not in lasts]

    def _stored_bytes(self, companion: str) -> int:
        table = self._table(companion)
        try:
            return int(table.database.command("collStats", table.name).get("size", 0))
        except OperationFailure as error:
            if error.code == _NO_COLLECTION:
                return 0
            raise

    def _older_of(self, key: str, before: int) -> int:
        old = {"dataKey": {"$eq": key}, "timestamp": {"$lt": before}, "lastTimestamp": {"$lt": before}}
        deleted = 0
        while found := list(self._table("").find(old, _FIELDS).sort("timestamp", 1).limit(_STEP)):
            deleted += self._delete(found)
            if len(found) < _STEP:
                break
        return deleted

    def _oldest_of(self, keys: Sequence[str], size: int) -> int:
        """Delete the oldest documents that hold so many bytes together; the number of items."""
        ahead = max(2, min(_STEP, _AHEAD // max(1, len(keys))))
        each = [self._by_time(key, ahead) for key in keys]
        deleted = 0
        try:
            oldest = _up_to(size, merge(*each, key=lambda document: number(document, "timestamp")))
            while some := list(islice(oldest, _STEP)):
                deleted += self._delete(some)
        finally:
            for documents in each:
                documents.close()
        return deleted

    def _by_time(self, key: str, ahead: int) -> Generator[Document, None, None]:
        found = self._table("").find({"dataKey": {"$eq": key}}, _FIELDS).sort("timestamp", 1)
        with closing(found.batch_size(ahead)):
            yield from found

    def _delete(self, documents: Sequence[Document]) -> int:
        """Parts first: a document whose deletion is interrupted is found again, a part alone would not be."""
        parts = [f"{one['_id']}#{part}" for one in documents for part in range(number(one, "parts"))]
        for start in range(0, len(parts), _STEP):
            self._table("parts").delete_many({"_id": {"$in": parts[start : start + _STEP]}})
        if documents:
            self._table("").delete_many(naming(documents))
        return sum(number(document, "count") for document in documents)


def naming(documents: Sequence[Mapping[str, Any]]) -> Document:
    """A filter for these documents that tells mongos, too, where they are.

    Args:
        documents: with `_id`, and dataKey and timestamp unless damaged.
    """
    criteria: Document = {"_id": {"$in": [one["_id"] for one in documents]}}
    keys = [one.get("dataKey") for one in documents]
    times = [moment for one in documents if isinstance(moment := one.get("timestamp"), int)]
    if all(isinstance(key, str) for key in keys):
        criteria["dataKey"] = {"$in": sorted(set(keys))}
    if times and len(times) == len(documents):
        criteria["timestamp"] = {"$gte": min(times), "$lte": max(times)}
    return criteria


def number(document: Mapping[str, Any], name: str) -> int:
    """A number of a document; 0 if it is damaged.

    Args:
        document: of the archive.
        name: of the field.
    """
    found = document.get(name)
    return int(found) if isinstance(found, int) else 0


def _part(excess: int) -> int:
    """How much of what is too much a pass deletes; see `_LEAST_BYTES`."""
    return max(excess // 2, min(excess, _LEAST_BYTES))


def _up_to(total: int, documents: Iterable[Document]) -> Iterator[Document]:
    """The first documents that hold so many bytes together."""
    for document in documents:
        if total <= 0:
            return
        total -= number(document, "bytes")
        yield document
