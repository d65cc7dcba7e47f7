"""Shard keys of the archive's collections on a sharded MongoDB cluster.

    <collection>         dataKey, timestamp: ranges
    <collection>_parts   _id: hashed
    <collection>_keys    not sharded: one small document for each key

**Key, then time.**  Nearly all queries, and all deletions, name keys and a range of time: mongos sends them to the
shards that have these ranges.  Time alone would be a hot shard, because all that is written now has the greatest time.
The key alone would be a jumbo chunk: what one switch reports for a month could not be split.  With both, writers end in
as many places as there are keys, and the chunk of a busy key is split by time; only a single busiest key is written to
one shard at a time.  Ranges instead of a hashed key, so that keys of one prefix are neighbours, and zones can keep
them at a site.

**Nothing twice.**  Each shard knows its own `_id`s only.  An `_id` is made from key, instance and sequence number, and
an item keeps the time with which it was written: the same `_id` has the same shard key, so that it comes to the same
shard, which refuses it.  `_id` is therefore the only unique index.

**No time-series collection.**  It has no unique index, so an insert that is tried again would be stored twice; its
times are whole milliseconds, ours are nanoseconds; and documents cannot be deleted or changed one by one before 7.0.
"""

import json
import logging
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, TypeAlias

from pymongo.database import Database
from pymongo.errors import OperationFailure

ShardKey: TypeAlias = Mapping[str, int | str]

SHARD_KEYS: Mapping[str, ShardKey] = {
    "": {"dataKey": 1, "timestamp": 1},
    "parts": {"_id": "hashed"},
}
"""Companion of the collection, as in its name, to the shard key; an empty name is the collection itself."""

_DONE_BY_OTHERS = frozenset({23, 46, 117})
"""Errors AlreadyInitialized (it is sharded, by a key of the operator's), LockBusy and ConflictingOperationInProgress
(another process shards it now)."""

log = logging.getLogger("due.archive")


def shard(database: Database[dict[str, Any]], collections: Mapping[str, ShardKey]) -> None:
    """On a sharded cluster: shard what is not sharded yet; otherwise nothing.

    Where this user may not, the commands for an operator are logged, and all data stays on one of MongoDB's shards.  Another
    shard key that an operator has chosen is kept.

    Args:
        database: of the archive.
        collections: shard key by name.

    Raises:
        ConnectionFailure: the server is away.
    """
    if not _is_cluster(database):
        return
    missing = {name: key for name, key in collections.items() if not _is_sharded(database, name)}
    if not missing:
        return
    # not needed from MongoDB 6 on, where only who may shard a collection may lack this right
    _refused(lambda: database.client.admin.command("enableSharding", database.name))
    refusals = [_refused(partial(_shard, database, *one)) for one in missing.items()]
    if any(refusals):
        log.warning(
            "archive %s: its collections could not be sharded, so MongoDB keeps all of it on one shard (%s); "
            "unless somebody has sharded them since, run in mongosh: %s",
            database.name,
            next(filter(None, refusals)),
            "; ".join(commands(database.name, missing)),
        )


def commands(database: str, collections: Mapping[str, ShardKey]) -> Iterator[str]:
    """What an operator types into mongosh to shard collections.

    Args:
        database: its name.
        collections: shard key by name.
    """
    yield f'sh.enableSharding("{database}")'
    for name, key in collections.items():
        fields = ", ".join(f"{field}: {json.dumps(kind)}" for field, kind in key.items())
        yield f'sh.shardCollection("{database}.{name}", {{{fields}}})'


def _is_cluster(database: Database[dict[str, Any]]) -> bool:
    """Whether the server is a mongos."""
    try:
        return bool(database.client.admin.command("hello").get("msg") == "isdbgrid")
    except OperationFailure:  # before MongoDB 4.4
        return False


def _is_sharded(database: Database[dict[str, Any]], name: str) -> bool:
    """Whether a collection is known to be sharded; False, too, where this user may not see it."""
    try:
        return bool(database.command("collStats", name).get("sharded"))
    except OperationFailure:
        return False


def _shard(database: Database[dict[str, Any]], name: str, key: ShardKey) -> None:
    database[name].create_index(list(key.items()))  # a collection with documents needs it first
    database.client.admin.command("shardCollection", f"{database.name}.{name}", key=dict(key))


def _refused(call: Callable[[], object]) -> str:
    """Why the server refused a call; an empty text where it did not, or another process has done the same."""
    try:
        call()
    except OperationFailure as error:
        told = str((error.details or {}).get("errmsg", error))
        return "" if error.code in _DONE_BY_OTHERS else told
    return ""
