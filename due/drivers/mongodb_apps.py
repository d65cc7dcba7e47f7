"""Data Archives on MongoDB with collections for each app: rights are given by collection.

    <collection>__<app>, <collection>_keys__<app>, <collection>_parts__<app>     written by this app alone
    <collection>__<other app>, …                                                read, as far as this user may

URL: `mongodb://USER:PASSWORD@host/database?app=NAME&collection=items`.
"""

import re
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from pymongo.collection import Collection
from pymongo.errors import OperationFailure

from due.drivers.lasting import NOTHING, SHARE, Lasting
from due.drivers.latest_items import by_age
from due.drivers.mongodb import Document, MongoArchive
from due.drivers.mongodb_sharding import SHARD_KEYS, ShardKey
from due.errors import ArchiveUnavailable, BackendError, InvalidOption
from due.messages import Item, PackedFrame

COLLECTION = "items"
_COMPANIONS = ("", "keys", "parts")
_JOINT = "__"
_APP = re.compile(r"[A-Za-z0-9_-]{1,64}")
_LOOK_SECONDS = 5.0
_MOST = 1024
_UNAUTHORIZED = 13


def collections_of(app: str) -> tuple[str, ...]:
    """Names of an app's collections; an empty id: of those that apps shared before each had its own."""
    ending = _JOINT + app if app else ""
    return tuple("_".join(filter(None, (COLLECTION, companion))) + ending for companion in _COMPANIONS)


def shard_keys_of(app: str) -> dict[str, ShardKey]:
    """How an app's collections are sharded: shard key by name.

    Args:
        app: its id.
    """
    companions = zip(collections_of(app), _COMPANIONS, strict=True)
    return {name: SHARD_KEYS[companion] for name, companion in companions if companion in SHARD_KEYS}


def has_app(url: str) -> bool:
    """Whether an archive's URL names an app."""
    return "app" in dict(parse_qsl(urlsplit(url).query, keep_blank_values=True))


def of_app(url: str, app: str) -> str:
    """The archive's URL for an app."""
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query, keep_blank_values=True)) | {"app": app}
    return urlunsplit(parts._replace(query=urlencode(options)))


class MongoAppsArchive:
    """`ArchiveDriver` for one app; see the module.  Raises InvalidOption for a wrong URL."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        app = options.pop("app", "")
        if not _APP.fullmatch(app):
            raise InvalidOption(
                f"archive URL: app={app} has to be an app id: 1 to 64 letters, digits, _ and -"
            )
        self._base = options.get("collection", COLLECTION)
        self._own = _OwnCollection(urlunsplit(parts._replace(query=urlencode(options))), ending=_JOINT + app)
        self._others: dict[str, _OtherCollection] = {}
        self._looked_at = -_LOOK_SECONDS

    @property
    def damaged(self) -> int:
        """See `ArchiveDriver.damaged`."""
        return self._own.damaged + sum(one.damaged for one in self._others.values())

    def insert(self, items: Sequence[Item]) -> None:
        """See `ArchiveDriver.insert`."""
        self._own.insert(items)

    def insert_frames(self, frames: Sequence[PackedFrame]) -> None:
        """See `ArchiveDriver.insert_frames`."""
        self._own.insert_frames(frames)

    def find(self, query: Mapping[str, Any], *, limit: int | None = None) -> list[Item]:
        """Items of all collections that this user may read; see `ArchiveDriver.find`."""
        found = [item for part in self._parts() for item in part.find(query, limit=limit)]
        found.sort(key=by_age)
        return found if limit is None else found[max(0, len(found) - limit) :]

    def prune(
        self, *, before: int | None = None, max_bytes: int | None = None, lasting: Lasting = NOTHING
    ) -> int:
        """See `ArchiveDriver.prune`; of all collections in which this user may delete."""
        parts = self._parts()
        limits = {} if max_bytes is None else _limits(parts, max_bytes, lasting)
        return sum(_pruned(part, before, lasting, limits.get(part)) for part in parts)

    def tend(self) -> None:
        """See `ArchiveDriver.tend`."""
        self._own.tend()

    def close(self) -> None:
        """See `ArchiveDriver.close`."""
        self._own.close()

    def _parts(self) -> "list[_Sized]":
        """The own collection and what else may be read; looked for every few seconds."""
        if time.monotonic() - self._looked_at >= _LOOK_SECONDS:
            self._others = {
                name: self._others.get(name) or _OtherCollection(self._own, self._base, ending)
                for name, ending in self._readable(self._own.names())
            }
            self._looked_at = time.monotonic()
        return [self._own, *self._others.values()]

    def _readable(self, names: Iterable[str]) -> Iterable[tuple[str, str]]:
        """Names and endings of other apps' collections, and of the one that apps shared before."""
        for name in sorted(names)[:_MOST]:
            start, joint, app = name.partition(_JOINT)
            if start == self._base and name != self._own.name and (not joint or _APP.fullmatch(app)):
                yield name, joint + app


class _Limit(NamedTuple):
    """What one collection may hold, bytes."""

    all_items: int
    lasting: int


class _Sized(MongoArchive):
    """Knows its size."""

    def size(self) -> int:
        """Bytes of all documents."""
        with self.errors():
            return self._retention.size()

    def lasting_size(self, lasting: Lasting) -> int:
        """Bytes of the documents that last."""
        with self.errors():
            return self._retention.lasting_size(lasting)

    def prune_to(self, limit: _Limit, lasting: Lasting) -> int:
        """Delete the oldest documents until the limit is kept; the number of items."""
        with self.errors():
            return self._retention.larger(limit.all_items, lasting, limit.lasting)


class _OwnCollection(_Sized):
    """What this app writes."""

    @property
    def name(self) -> str:
        """Of the collection."""
        return self._collection + self._ending

    def names(self) -> list[str]:
        """Collections of the database that this user may read."""
        with self.errors():
            database = self._table().database
            return database.list_collection_names(authorizedCollections=True)

    def shared(self, name: str) -> Collection[Document]:
        """Another collection, over the same connections."""
        return self._named(name)


class _OtherCollection(_Sized):
    """What another app writes: no index is made, and there are no connections of its own."""

    def __init__(self, own: _OwnCollection, collection: str, ending: str) -> None:
        super().__init__("mongodb://-/-?" + urlencode({"collection": collection}), ending=ending)
        self.shown = own.shown
        self._own = own

    def _named(self, name: str) -> Collection[Document]:
        return self._own.shared(name)


def _limits(parts: "list[_Sized]", max_bytes: int, lasting: Lasting) -> "dict[_Sized, _Limit]":
    """The limit in parts as the sizes now are: one for what lasts, one for the rest; none while all of it fits."""
    sizes = {part: part.size() for part in parts}
    if sum(sizes.values()) <= max_bytes:
        return {}
    lasts = {part: part.lasting_size(lasting) for part in parts}
    others = {part: max(0, sizes[part] - lasts[part]) for part in parts}
    half = max_bytes // SHARE
    room = min(sum(lasts.values()), half)
    found = {}
    for part in parts:
        own = room * lasts[part] // max(1, sum(lasts.values()))
        rest = (max_bytes - room) * others[part] // max(1, sum(others.values()))
        # while what lasts fits, nothing of it goes: not even what is written before the limit is applied
        found[part] = _Limit(own + rest, half if room < half else own)
    return found


def _pruned(part: _Sized, before: int | None, lasting: Lasting, limit: _Limit | None) -> int:
    try:
        deleted = part.prune(before=before, lasting=lasting)
        return deleted if limit is None else deleted + part.prune_to(limit, lasting)
    except ArchiveUnavailable:
        raise
    except BackendError as error:
        cause = error.__cause__
        if isinstance(cause, OperationFailure) and cause.code == _UNAUTHORIZED:
            return 0
        raise
