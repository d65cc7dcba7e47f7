"""Archived packets on Spark's workers, as Arrow batches in and out.  Pure.

    packets ─► `split_rows`: without the late ones ─► switch, window, shard, row, packets
                                                       └─ divided and sorted by Spark
    the pieces of each window and shard, in order ─► `run_groups`: the numpy operators ─► switch, result

A window's pieces are read one after the other; only what stands between others in the archive's order is held back.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
from operator import itemgetter
from typing import Any, Final

import msgspec
import numpy as np

from apps.sonata_adapter.host.archive_columns import ITEM, ROW, numbers, packets_in
from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.engine import HostEngine
from apps.sonata_adapter.host.spark_late import Closings, WindowClock, by_switch
from apps.sonata_adapter.host.spark_pieces import joined, pieces_of
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult
from due import RecordBatch
from due.codec import decode_value, encode_value

PIECES: Final = "switch string, number bigint, shard int, row bigint, packets binary, late bigint"
"""Spark's schema of what `split_rows` yields."""
RESULTS: Final = "switch string, result string, late bigint"
"""Spark's schema of what `run_groups` yields."""
NO_SHARD: Final = -1
"""Of a row that only counts late packets."""
_Piece = tuple[str, int, int, int, bytes, int]


@dataclass(frozen=True, kw_only=True)
class ArchiveJob:
    """What workers need to know."""

    query: str
    """As JSON."""
    limit: int
    """Keys that one operator keeps exactly."""
    clock: WindowClock
    closings: dict[str, Closings]
    """By switch."""

    def parsed(self) -> Query:
        """The query."""
        return msgspec.json.decode(self.query, type=Query)


def split_rows(batches: Iterable[Any], job: ArchiveJob) -> Iterator[Any]:
    """Arrow batches with `PACKET_SCHEMA` to Arrow batches of `PIECES`."""
    pa: Any = import_module("pyarrow")

    query = job.parsed()
    kinds = (pa.string(), pa.int64(), pa.int32(), pa.int64(), pa.binary(), pa.int64())
    names = [column.split()[0] for column in PIECES.split(", ")]
    for batch in batches:
        columns: list[Any] = list(zip(*_pieces(batch, query, job), strict=True)) or [()] * len(names)
        arrays = [pa.array(column, kind) for column, kind in zip(columns, kinds, strict=True)]
        yield pa.RecordBatch.from_arrays(arrays, names=names)


def _pieces(unsorted: Any, query: Query, job: ArchiveJob) -> Iterator[_Piece]:
    # a batch may hold the end of one file and the begin of another
    batch = unsorted.take(np.argsort(numbers(unsorted, ROW), kind="stable"))
    whole, items = packets_in(batch), numbers(batch, ITEM)
    for switch, rows in by_switch(batch):
        windows = job.clock.windows(switch, whole["time_us"][rows])
        in_time = ~job.closings[switch].late(windows, items[rows])
        yield switch, 0, NO_SHARD, 0, b"", len(rows) - int(in_time.sum())
        if not in_time.any():
            continue
        packets, windows = whole.take(rows[in_time]), windows[in_time]
        for piece in pieces_of(query, packets, PacketColumns(packets), windows):
            number = int(job.clock.windows(switch, piece.packets["time_us"][:1])[0])
            data = encode_value(piece.packets)
            yield switch, number, piece.shard, int(piece.packets[ROW].min()), data, 0


def run_groups(batches: Iterable[Any], job: ArchiveJob) -> Iterator[Any]:
    """Arrow batches of `PIECES`, sorted by switch, window, shard and row, to Arrow batches of `RESULTS`.

    A row without a result has the number of a switch's late packets.
    """
    pa: Any = import_module("pyarrow")

    query = job.parsed()
    for (switch, _, shard), pieces in groupby(_read(batches), itemgetter(0, 1, 2)):
        if shard == NO_SHARD:
            found, late = [""], sum(count for *_, count in pieces)
        else:
            found, late = _found(query, switch, job, (decode_value(packets) for *_, packets, _ in pieces)), 0
        if found:
            yield pa.RecordBatch.from_pydict(
                {
                    "switch": pa.array([switch] * len(found), pa.string()),
                    "result": pa.array(found, pa.string()),
                    "late": pa.array([late] * len(found), pa.int64()),
                }
            )


def _found(query: Query, switch: str, job: ArchiveJob, pieces: Iterable[RecordBatch]) -> list[str]:
    engine = HostEngine(limit=job.limit, base_us=job.clock.bases[switch])
    engine.add(query)
    outputs = [each for batch in in_order(pieces) for each in engine.process(batch)]
    return [
        msgspec.json.encode(each).decode()
        for each in (*outputs, *engine.finish())
        if isinstance(each, QueryResult)
    ]


def _read(batches: Iterable[Any]) -> Iterator[tuple[str, int, int, bytes, int]]:
    for batch in batches:
        columns = [batch.column(name) for name in ("switch", "number", "shard", "packets", "late")]
        for row in range(batch.num_rows):
            switch, number, shard, packets, late = (column[row].as_py() for column in columns)
            yield switch, number, shard, packets, late


def in_order(pieces: Iterable[RecordBatch]) -> Iterator[RecordBatch]:
    """The same packets by the numbers of their rows.

    Args:
        pieces: each sorted, and all by their first rows; one may begin before another has ended.
    """
    held: list[RecordBatch] = []
    last = -1
    for piece in pieces:
        if held and last < int(piece[ROW][0]):
            yield _merged(held)
            held = []
        held.append(piece)
        last = max(last, int(piece[ROW][-1]))
    if held:
        yield _merged(held)


def _merged(pieces: list[RecordBatch]) -> RecordBatch:
    whole = joined(pieces)
    return whole if len(pieces) == 1 else whole.take(np.argsort(whole[ROW], kind="stable"))
