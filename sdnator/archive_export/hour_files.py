"""Rows as Parquet files, a folder for each hour of event time.  Does I/O.

Files are written aside; `export_folder` moves them to their places.  Rows wait in memory until there are enough for a
row group, and as few files are open as possible: rows that come out of order make more files, not more memory.
"""

import os
from collections import OrderedDict
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from apps.messages import MessageError
from apps.sonata_adapter.host.archive_columns import KEY, TIME
from due import RecordBatch
from sdnator.errors import BadInput

HOUR_US: Final = 3_600 * 10**6
MOST_HOURS: Final = 4_096
"""Most hours of event time in one hour of the archive."""
_GROUP_ROWS: Final = 131_072
_MOST_WAITING: Final = 524_288
_MOST_OPEN: Final = 16
_PRIVATE: Final = 0o600


class WrittenFile(NamedTuple):
    """A complete file that is not in its place yet."""

    path: Path
    place: str
    """Below the export's folder."""
    rows: int


class _Open:
    """A file that is being written."""

    def __init__(self, path: Path, place: str, schema: Any) -> None:
        self._path, self._place = path, place
        self._rows = 0
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _PRIVATE)
        self._file = os.fdopen(descriptor, "wb")
        self._writer = import_module("pyarrow.parquet").ParquetWriter(self._file, schema, compression="zstd")

    def write(self, table: Any) -> None:
        self._writer.write_table(table)
        self._rows += table.num_rows

    def close(self) -> WrittenFile:
        try:
            self._writer.close()
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()
        return WrittenFile(self._path, self._place, self._rows)

    def abandon(self) -> None:
        self._file.close()


class HourFiles:
    """The files of one hour of the archive.

    Args:
        folder: for files that are not in their places yet.
        name: with which each file's name begins.
        columns: of all rows, name to Arrow's type; empty: those of the first.
    """

    def __init__(self, folder: Path, name: str, columns: Mapping[str, str]) -> None:
        self._arrow = arrow()
        self._folder, self._name = folder, name
        self.columns = dict(columns)
        """Name to Arrow's type; empty before the first row."""
        self._schema: Any = None
        self._waiting: dict[int, list[Any]] = {}
        self._sizes: dict[int, int] = {}
        self._open: OrderedDict[int, _Open] = OrderedDict()
        self._parts: dict[int, int] = {}
        self._written: list[WrittenFile] = []

    def add(self, key: str, rows: RecordBatch) -> None:
        """Take rows of one item.

        Raises:
            MessageError: their columns are not those of the others, or they are of too many hours.
            OSError: they cannot be written.
        """
        table = self._table(key, rows)
        columns = {column.name: str(column.type) for column in table.schema}
        if self.columns not in ({}, columns):
            raise MessageError("columns", f"{key}: its columns differ from those of the other items")
        hours = rows[TIME] // HOUR_US
        found = np.unique(hours).tolist()
        if len(self._parts.keys() | set(found)) > MOST_HOURS:
            raise MessageError(
                "size",
                f"{key}: one hour of the archive holds packets of more than {MOST_HOURS:,} hours of event time",
            )
        self.columns, self._schema = columns, table.schema
        for hour in found:
            self._parts.setdefault(hour, 0)
            mine = table if len(found) == 1 else table.filter(self._arrow.array(hours == hour))
            self._waiting.setdefault(hour, []).append(mine)
            self._sizes[hour] = self._sizes.get(hour, 0) + mine.num_rows
            if self._sizes[hour] >= _GROUP_ROWS:
                self._write(hour)
        while sum(self._sizes.values()) > _MOST_WAITING:
            self._write(max(self._sizes, key=self._sizes.__getitem__))

    def close(self) -> list[WrittenFile]:
        """Complete all files; raises OSError."""
        for hour in list(self._waiting):
            self._write(hour)
        while self._open:
            self._close_oldest()
        return self._written

    def abandon(self) -> None:
        """Close what is open; the files are of no use."""
        while self._open:
            self._open.popitem()[1].abandon()

    def _write(self, hour: int) -> None:
        waiting = self._arrow.concat_tables(self._waiting.pop(hour)).combine_chunks()
        del self._sizes[hour]
        file = self._open.pop(hour, None)
        if file is None:
            if len(self._open) >= _MOST_OPEN:
                self._close_oldest()
            file = self._begin(hour)
        self._open[hour] = file
        file.write(waiting)

    def _begin(self, hour: int) -> _Open:
        name = f"{self._name}-{self._parts[hour]:03}.parquet"
        self._parts[hour] += 1
        return _Open(self._folder / f"{hour}-{name}", f"{folder_of(hour)}/{name}", self._schema)

    def _close_oldest(self) -> None:
        _, file = self._open.popitem(last=False)
        self._written.append(file.close())

    def _table(self, key: str, rows: RecordBatch) -> Any:
        pa = self._arrow
        names = pa.DictionaryArray.from_arrays(np.zeros(len(rows), dtype="i4"), pa.array([key], pa.string()))
        return pa.table({KEY: names, **{name: _column(pa, rows[name]) for name in rows}})


def _column(pa: Any, column: np.ndarray) -> Any:
    if column.dtype.kind != "V":
        return pa.array(np.ascontiguousarray(column).astype(column.dtype.newbyteorder("="), copy=False))
    kind = pa.binary(column.dtype.itemsize)
    return pa.Array.from_buffers(
        kind, len(column), [None, pa.py_buffer(np.ascontiguousarray(column).tobytes())]
    )


def folder_of(hour: int) -> str:
    """The folder of an hour, as Hive and Spark name it: `date=2024-05-01/hour=07`.

    Args:
        hour: since the epoch, UTC.
    """
    day = np.datetime64(hour // 24, "D")
    return f"date={day}/hour={hour % 24:02}"


def arrow() -> Any:
    """The module pyarrow; raises `BadInput` where it is not installed."""
    try:
        import_module("pyarrow.parquet")
        return import_module("pyarrow")
    except ImportError:
        raise BadInput("pyarrow is not installed: pip install 'sdnator[arrow]'") from None
