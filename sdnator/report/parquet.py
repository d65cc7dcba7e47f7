"""Writes a plain table as Parquet: one row group, no compression, required columns.

Enough for a table of numbers and short texts, without a library of fifty megabytes.  Source: the
Apache Parquet format specification and the Thrift compact protocol.
"""

import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

_MAGIC: Final = b"PAR1"
_INT32, _INT64, _DOUBLE, _BYTE_ARRAY = 1, 2, 5, 6
_KINDS: Final = {"i4": _INT32, "i8": _INT64, "f8": _DOUBLE}
_UTF8: Final = 0
_PLAIN, _RLE = 0, 3


def write_parquet(path: Path, columns: Mapping[str, npt.NDArray[Any]]) -> None:
    """Writes equally long columns of int32, int64, float64 or text.

    Raises `ValueError` for other types or unequal lengths and `OSError` when the file cannot be written.
    """
    rows = {len(column) for column in columns.values()}
    if len(rows) != 1:
        raise ValueError(f"{path}: columns of {sorted(rows)} rows; a table needs equally long ones")
    count = rows.pop()
    with path.open("wb") as file:
        file.write(_MAGIC)
        chunks = []
        for name, column in columns.items():
            kind, data = _encoded(name, column)
            start = file.tell()
            page = {1: 0, 2: len(data), 3: len(data), 5: {1: count, 2: _PLAIN, 3: _RLE, 4: _RLE}}
            file.write(_struct(page) + data)
            chunks.append(_chunk(name, kind, count, start, file.tell() - start))
        footer = _struct(_metadata(columns, chunks, count))
        file.write(footer + struct.pack("<I", len(footer)) + _MAGIC)


class _Long(int):
    """A 64-bit integer of the Thrift schema; plain ints are 32-bit."""


def _encoded(name: str, column: npt.NDArray[Any]) -> tuple[int, bytes]:
    if column.dtype.kind == "U":
        texts = [text.encode() for text in column.tolist()]
        return _BYTE_ARRAY, b"".join(struct.pack("<I", len(text)) + text for text in texts)
    kind = _KINDS.get(column.dtype.str[1:])
    if kind is None:
        raise ValueError(f"column {name} has type {column.dtype}; use int32, int64, float64 or text")
    return kind, np.ascontiguousarray(column).astype(column.dtype.newbyteorder("<"), copy=False).tobytes()


def _chunk(name: str, kind: int, count: int, start: int, size: int) -> dict[int, Any]:
    details = {1: kind, 2: [_PLAIN], 3: [name.encode()], 4: 0, 5: _Long(count)}
    details |= {6: _Long(size), 7: _Long(size), 9: _Long(start)}
    return {2: _Long(start), 3: details}


def _metadata(columns: Iterable[str], chunks: list[dict[int, Any]], count: int) -> dict[int, Any]:
    names = list(columns)
    schema: list[dict[int, Any]] = [{4: b"schema", 5: len(names)}]
    for name, chunk in zip(names, chunks, strict=True):
        kind = chunk[3][1]
        element = {1: kind, 3: 0, 4: name.encode()}
        schema.append(element | ({6: _UTF8} if kind == _BYTE_ARRAY else {}))
    size = _Long(sum(chunk[3][6] for chunk in chunks))
    return {1: 1, 2: schema, 3: _Long(count), 4: [{1: chunks, 2: size, 3: _Long(count)}], 6: b"sdnator"}


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _value(value: Any) -> tuple[int, bytes]:
    """Thrift compact type and encoding."""
    match value:
        case _Long():
            return 6, _varint(value << 1)
        case int():
            return 5, _varint(value << 1)
        case bytes():
            return 8, _varint(len(value)) + value
        case list():
            encoded = [_value(item) for item in value]
            head = bytes([min(len(encoded), 15) << 4 | encoded[0][0]])
            longer = _varint(len(encoded)) if len(encoded) >= 15 else b""
            return 9, head + longer + b"".join(data for _, data in encoded)
        case _:
            return 12, _struct(value)


def _struct(fields: Mapping[int, Any]) -> bytes:
    out, last = b"", 0
    for number, value in fields.items():
        kind, data = _value(value)
        out += bytes([number - last << 4 | kind]) + data
        last = number
    return out + b"\0"
