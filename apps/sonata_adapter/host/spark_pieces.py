"""What Spark's workers do for queries: packets to pieces, and the pieces of a window to results.  Pure.

    packets ─► `pieces_of` ─► (window, shard, packets) ─► grouped by Spark ─► `results_of` ─► results

A query's packets of one window lie in a few shards, none of which needs to know of another.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.host.shards import parts_of, shard_rows, union
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult
from due import RecordBatch

SHARDS: Final = 4
_IDENTITY: Final = ("arrival", "sequence", "time_us")
"""Columns in which two different packets of a switch always differ."""


class ShardPiece(NamedTuple):
    """What one shard of a query gets of some packets, in one window."""

    shard: int
    newest_us: int
    """Capture time of its newest packet."""
    packets: RecordBatch


def pieces_of(
    query: Query, batch: RecordBatch, packets: PacketColumns, windows: NDArray[np.int64]
) -> Iterator[ShardPiece]:
    """Divide packets among a query's shards and windows.

    Args:
        query: one that reports results by windows.
        batch: the packets.
        packets: the same; queries that share it share what they calculate.
        windows: number of the window of each packet.
    """
    rows: dict[int, list[NDArray[np.intp]]] = {}
    for part in parts_of(query):
        for shard, mine in shard_rows(part, packets, SHARDS).items():
            rows.setdefault(shard, []).append(mine)
    for shard, found in rows.items():
        together = union(found)
        for number in np.unique(windows[together]).tolist():
            piece = batch.take(together[windows[together] == number])
            yield ShardPiece(shard, int(piece["time_us"].max()), piece)


def results_of(
    query: Query, pieces: Sequence[RecordBatch], base_us: int, limit: int, *, ordered: bool = False
) -> list[QueryResult]:
    """What a query finds in one window, among the keys of one shard.

    Args:
        query: one that reports results by windows.
        pieces: all packets of that window and shard.
        base_us: absolute time of the switch's clock zero.
        limit: keys that one operator keeps exactly.
        ordered: the pieces are in the order in which the switch sent them; otherwise arrival numbers tell it.
    """
    columns = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0].columns}
    order = _first_of_each(columns) if ordered else np.argsort(columns["arrival"], kind="stable")
    engine = HostEngine(limit=limit, base_us=base_us)
    engine.add(query)
    whole = RecordBatch({name: column[order] for name, column in columns.items()})
    outputs = [*engine.process(whole), *engine.finish()]
    return [each for each in outputs if isinstance(each, QueryResult)]


def joined(batches: Iterable[RecordBatch]) -> RecordBatch:
    """Packets of several batches with the same columns, one after the other."""
    found = list(batches)
    if len(found) == 1:
        return found[0]
    return RecordBatch({name: np.concatenate([each[name] for each in found]) for name in found[0].columns})


def _first_of_each(columns: dict[str, NDArray[np.generic]]) -> NDArray[np.intp]:
    """Rows in order, without those that a producer has written twice."""
    identity = np.rec.fromarrays([columns[name] for name in _IDENTITY])
    _, first = np.unique(identity, return_index=True)
    return np.sort(first)
