"""Columns of archived packets in Parquet: those of the packet record, and where each row stands in the archive.  Pure.

A row's number tells its place in the archive's order, the number of its item which rows were written together: results
depend on both where packets come out of order.
"""

from typing import Any, Final

import numpy as np

from apps.packets import PACKET_COLUMNS
from due import RecordBatch

KEY: Final = "archive_key"
"""The item's key."""
WRITTEN: Final = "archive_ns"
"""When the item was written, ns."""
ITEM: Final = "archive_item"
"""Number of the item's first row."""
ROW: Final = "archive_row"
"""Number of the row: rows of the archive in their order."""
TIME: Final = "time_us"
"""Event time, µs: hours and windows go by it."""
_SWITCH_SEGMENT: Final = 3
_ROWS_BITS: Final = 40
_SPARK_TYPES: Final = {
    "u1": "smallint", "u2": "int", "u4": "bigint", "u8": "decimal(20,0)", "i4": "int", "i8": "bigint",
}  # fmt: skip
"""numpy's types as Spark reads them out of Parquet."""

CLOCK_SCHEMA: Final = f"{KEY} string, {WRITTEN} bigint, {ITEM} bigint, {ROW} bigint, {TIME} bigint"
"""What tells when windows are over, as Spark's schema."""
PACKET_SCHEMA: Final = ", ".join(
    [
        f"{KEY} string, {WRITTEN} bigint, {ITEM} bigint, {ROW} bigint",
        *(f"{name} {_SPARK_TYPES[kind]}" for name, kind in PACKET_COLUMNS.items()),
    ]
)
"""All that is read of archived packets, as Spark's schema."""


def first_row(hour: int) -> int:
    """Number of the first row of an hour of the archive.

    Args:
        hour: in which the item was written, since the epoch.
    """
    return hour << _ROWS_BITS


def switch_of(key: str) -> str:
    """The switch in a key of packets; empty: there is none."""
    segments = key.partition(":")[0].split(".")
    return segments[_SWITCH_SEGMENT] if len(segments) > _SWITCH_SEGMENT else ""


def numbers(batch: Any, name: str, kind: str = "i8") -> np.ndarray:
    """A column of an Arrow batch as numpy's.

    Args:
        batch: with `PACKET_SCHEMA` or `CLOCK_SCHEMA`.
        name: of the column.
        kind: numpy's type of the result; u8 comes as a decimal.
    """
    column = batch.column(name)
    if kind != "u8":
        plain: np.ndarray = column.to_numpy(zero_copy_only=False)
        return plain.astype(kind)
    if not len(column):
        return np.empty(0, dtype=kind)
    # of 128 bits the lower half
    halves = np.frombuffer(column.buffers()[1], dtype="<u8")[2 * column.offset :]
    return halves[: 2 * len(column) : 2].copy()


def packets_in(batch: Any) -> RecordBatch:
    """The packets of an Arrow batch with `PACKET_SCHEMA`, with the numbers of their rows."""
    columns = {name: numbers(batch, name, kind) for name, kind in PACKET_COLUMNS.items()}
    return RecordBatch({**columns, ROW: numbers(batch, ROW)})
