"""An archived item as rows of a table.  Pure.

Packets and reports of switches are checked as the Sonata adapter checks them; other items need columns of numbers or
text.  Without a column `time_us` the item's event time is that of its rows.
"""

from typing import Final

import numpy as np

from apps.messages import LATEST_NS, MessageError
from apps.packets import MOST_ROWS
from apps.sonata_adapter.arrivals import data_in
from apps.sonata_adapter.host.archive_columns import ITEM, KEY, ROW, TIME, WRITTEN
from due import Item, Key, RecordBatch

_CHECKED: Final = ("packets", "frames", "digests", "counts")
_WRITER: Final = "p4runtime_ctrl"
_PLAIN: Final = "biufUSV"
_MOST_COLUMNS: Final = 256
_LATEST_US: Final = LATEST_NS // 1000
_OURS: Final = (KEY, WRITTEN, ITEM, ROW)


def rows_of(item: Item, first: int) -> RecordBatch:
    """The rows of an item.

    Args:
        item: archived, by whomever.
        first: number of its first row in the archive.

    Returns:
        The columns of its value, `time_us` among them, and `archive_ns`, `archive_item` and `archive_row`.

    Raises:
        MessageError: its value has no such columns, or times that cannot be.
    """
    batch = _checked(item)
    size = len(batch)
    times = batch[TIME] if TIME in batch else np.full(size, item.event_time // 1000, dtype="i8")
    if times.dtype != np.dtype("i8") or (
        size and not 0 <= int(times.min()) <= int(times.max()) <= _LATEST_US
    ):
        raise MessageError("range", f"{item.key}: {TIME} is not within 0 to {_LATEST_US}")
    return RecordBatch(
        {
            **batch,
            TIME: times,
            WRITTEN: np.full(size, item.timestamp, dtype="i8"),
            ITEM: np.full(size, first, dtype="i8"),
            ROW: np.arange(first, first + size, dtype="i8"),
        }
    )


def _checked(item: Item) -> RecordBatch:
    segments = Key.parse(item.key).segments
    if len(segments) == 5 and segments[1] in _CHECKED and segments[2] == _WRITER:
        return data_in(item)
    batch = item.value
    if not isinstance(batch, RecordBatch):
        raise MessageError("shape", f"{item.key}: columns are expected, not {type(batch).__name__}")
    if len(batch) > MOST_ROWS or len(batch.columns) > _MOST_COLUMNS:
        raise MessageError("size", f"{item.key}: {len(batch):,} rows of {len(batch.columns)} columns")
    wrong = [name for name in batch if batch[name].dtype.kind not in _PLAIN or name in _OURS]
    if wrong:
        raise MessageError("columns", f"{item.key}: column {wrong[0]!r} cannot be written")
    return batch
