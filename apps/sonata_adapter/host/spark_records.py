"""Kafka's records on Spark's workers, as Arrow batches in and out.  Pure.

    topic, key, value, offset ─► `read_records`: DUE frames ─► time, switch, query, shard, offset, packets
                                                                    └─ grouped by Spark, window by window
    switch, query, pieces ─► `run_windows`: the numpy operators ─► switch, result

A row without a query carries the capture time of a switch's newest packet, or, without a switch, the time that all have
passed.  A frame that cannot be read, or is in the wrong place, makes a row with neither: it is counted.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

import msgspec

from apps.messages import MessageError
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.spark_pieces import joined, pieces_of, results_of
from apps.sonata_adapter.query.language import Query
from due import Item, Key, RecordBatch
from due.codec import decode_frame, decode_value, encode_value
from due.errors import DueError

NO_QUERY: Final = -1
ROWS: Final = "time bigint, switch string, query int, shard int, offset bigint, packets binary, read bigint, refused int"
RESULTS: Final = "switch string, result string"
_SWITCH_SEGMENT: Final = 3
_Row = tuple[int | None, str, int, int, int, bytes, int, int]
_DAMAGED: Final = (DueError, MessageError)


class UnknownSwitch(SonataError):
    """There are packets of a switch whose clock zero is not known, so that its windows are not."""


@dataclass(frozen=True, kw_only=True)
class WindowJob:
    """What workers need to know: queries of one window length."""

    queries: tuple[str, ...]
    """As JSON."""
    length_us: int
    limit: int
    """Keys that one operator keeps exactly."""
    bases: dict[str, int]
    """Switch to absolute time of its clock zero, us."""
    pattern: str
    """Paths of the packets."""
    clocks: str
    """Topic of the time that all switches have passed."""
    packets_in: Callable[[Item], RecordBatch]
    """Packets of an item; raises `MessageError`."""
    clock_in: Callable[[Item], int]
    """Capture time that all switches have passed, us, or 0; raises `MessageError`."""

    def shift_us(self, switch: str) -> int:
        """How much later than multiples of their length this switch's windows begin."""
        return self.bases[switch] % self.length_us

    def latest_shift_us(self) -> int:
        """The greatest of these, by which a time that all have passed is told."""
        return max(map(self.shift_us, self.bases))

    def parsed(self) -> list[Query]:
        """The queries."""
        return [msgspec.json.decode(text, type=Query) for text in self.queries]


def read_records(batches: Iterable[Any], job: WindowJob) -> Iterator[Any]:
    """Arrow batches of Kafka's records to Arrow batches of `ROWS`.

    Raises:
        UnknownSwitch: start again when its state has been heard.
    """
    queries, pattern = job.parsed(), Key.parse(job.pattern)
    for batch in batches:
        reading = _Reading(job, queries, pattern)
        columns = [batch.column(name).to_pylist() for name in ("topic", "key", "value", "offset")]
        for topic, key, value, offset in zip(*columns, strict=True):
            reading.take(topic, (key or b"").decode("ascii", "replace"), value or b"", offset)
        yield reading.rows()


def run_windows(batches: Iterable[Any], job: WindowJob) -> Iterator[Any]:
    """Arrow batches of grouped pieces to Arrow batches of `RESULTS`."""
    pa: Any = import_module("pyarrow")

    queries = job.parsed()
    for batch in batches:
        switches: list[str] = []
        results: list[str] = []
        columns = [batch.column(name) for name in ("switch", "query", "pieces")]
        for row in range(batch.num_rows):
            switch, query, pieces = (column[row].as_py() for column in columns)
            if query == NO_QUERY:  # its time has moved the watermark
                continue
            ordered = sorted(pieces, key=lambda piece: int(piece["offset"]))
            found = results_of(
                queries[query],
                [decode_value(piece["packets"]) for piece in ordered],
                job.bases[switch],
                job.limit,
                ordered=True,
            )
            results += [msgspec.json.encode(each).decode() for each in found]
            switches += [switch] * len(found)
        yield pa.RecordBatch.from_pydict(
            {"switch": pa.array(switches, pa.string()), "result": pa.array(results, pa.string())}
        )


class _Reading:
    """The rows of one Arrow batch, whose records are of one partition, in order."""

    def __init__(self, job: WindowJob, queries: list[Query], pattern: Key) -> None:
        self._job, self._queries, self._pattern = job, queries, pattern
        self._packets: dict[str, tuple[int, list[RecordBatch]]] = {}
        """By switch: offset of its first record, and its packets."""
        self._newest: dict[str, int] = {}
        self._passed = 0
        """Capture time that all switches have passed, us."""
        self._refused = 0

    def take(self, topic: str, path: str, value: bytes, offset: int) -> None:
        """One record."""
        if topic != self._job.clocks and not self._pattern.matches_path(path):
            return
        try:
            items = decode_frame(value).items()
            if Key.parse(items[0].key).path != path:
                raise MessageError("fields", f"{items[0].key} under {path}")
            if topic == self._job.clocks:
                self._passed = max(self._passed, *map(self._job.clock_in, items))
                return
            found = [batch for batch in map(self._job.packets_in, items) if len(batch)]
        except _DAMAGED:
            self._refused += 1
            return
        if found:
            self._note_packets(path, offset, found)

    def _note_packets(self, path: str, offset: int, found: list[RecordBatch]) -> None:
        switch = path.split(".")[_SWITCH_SEGMENT]
        if switch not in self._job.bases:
            raise UnknownSwitch(switch)
        self._packets.setdefault(switch, (offset, []))[1].extend(found)
        newest = max(int(batch["time_us"].max()) for batch in found)
        self._newest[switch] = max(newest, self._newest.get(switch, 0))

    def rows(self) -> Any:
        """As an Arrow batch."""
        pa: Any = import_module("pyarrow")

        rows: list[_Row] = [row for switch in self._packets for row in self._pieces(switch)]
        for switch, newest in self._newest.items():
            read = sum(len(batch) for batch in self._packets[switch][1])
            rows.append((newest - self._job.shift_us(switch), switch, NO_QUERY, 0, 0, b"", read, 0))
        if self._passed:
            rows.append((self._passed - self._job.latest_shift_us(), "", NO_QUERY, 0, 0, b"", 0, 0))
        if self._refused:
            rows.append((None, "", NO_QUERY, 0, 0, b"", 0, self._refused))
        names = [column.split()[0] for column in ROWS.split(", ")]
        kinds = (
            pa.int64(),
            pa.string(),
            pa.int32(),
            pa.int32(),
            pa.int64(),
            pa.binary(),
            pa.int64(),
            pa.int32(),
        )
        columns = list(zip(*rows, strict=True)) or [()] * len(names)
        return pa.RecordBatch.from_arrays(
            [pa.array(column, kind) for column, kind in zip(columns, kinds, strict=True)], names=names
        )

    def _pieces(self, switch: str) -> Iterator[_Row]:
        offset, batches = self._packets[switch]
        batch, shift = joined(batches), self._job.shift_us(switch)
        packets = PacketColumns(batch)
        windows = (batch["time_us"] - self._job.bases[switch]) // self._job.length_us
        for number, query in enumerate(self._queries):
            for piece in pieces_of(query, batch, packets, windows):
                data = encode_value(piece.packets)
                yield piece.newest_us - shift, switch, number, piece.shard, offset, data, 0, 0
