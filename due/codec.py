"""Values and frames as bytes (docs/wire-format.md).

    frame = "DUE" version(1 byte)  msgpack array:
            [key, app, instance, epoch, first sequence, published before, timestamps, event times | nil, values]

msgpack throughout; types that msgpack lacks are extensions:
    -1 aware datetime (msgpack's own)   1 naive datetime   2 datetime64[ns]   3 numpy array   4 record batch

Big values and columns are copied once on the way out (into the payload) and not at all on the way in:
received arrays are read-only views of the received bytes.
"""

import datetime as dt
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import count, repeat
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from due.errors import DecodeError, NewerVersion, UnsupportedValue
from due.messages import Item, PackedFrame, RecordBatch

VERSION = 1
MAGIC = b"DUE"
_HEADER = MAGIC + bytes([VERSION])
_ALIGNMENT = 16

_NAIVE_DATETIME, _DATETIME64, _ARRAY, _BATCH = 1, 2, 3, 4
_EPOCH = dt.datetime(1970, 1, 1)  # noqa: DTZ001 - naive on purpose
_MICROSECOND = dt.timedelta(microseconds=1)
_KINDS = frozenset("biufcSUMmV")

_ATOMS = frozenset((type(None), bool, float, bytes))
"""Types whose values neither change nor fail to encode: they may wait in a buffer as they are."""
_PLAIN = _ATOMS | {int, str}


class Frame(msgspec.Struct, array_like=True, gc=False):
    """A decoded frame: consecutive items of one (instance, key)."""

    key: str
    app_id: str
    instance_id: str
    epoch: int
    sequence: int
    """Of the first item."""
    before: int
    """How many items of this (instance, key) were published before this frame: shows gaps and repeats."""
    timestamps: list[int]
    event_times: list[int] | None
    """None where they equal the timestamps."""
    values: list[Any]

    def items(self) -> list[Item]:
        """The items, in order."""
        return list(self.stream())

    def stream(self) -> Iterator[Item]:
        """The items, in order, each made when it is asked for: a callback finds it in the cache."""
        times = self.timestamps if self.event_times is None else self.event_times
        key, app, instance = repeat(self.key), repeat(self.app_id), repeat(self.instance_id)
        return map(Item, key, self.values, self.timestamps, times, app, instance, count(self.sequence))


def freeze(value: Any) -> Any:
    """`value` in a form that can wait in a buffer: itself if immutable, else encoded now.

    Raises `UnsupportedValue`.
    """
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind is int:
        return _checked_int(value)
    if kind is str:
        return _checked_text(value)
    return msgspec.Raw(encode_value(value))


def encode_value(value: Any) -> bytes:
    """`value` as msgpack; raises `UnsupportedValue` naming the type."""
    return b"".join(_value_parts(value, 0))


def decode_value(data: bytes | memoryview) -> Any:
    """The inverse of `encode_value`; raises `DecodeError`.  Arrays are read-only views of `data`."""
    try:
        return _value_decoder.decode(data)
    except _DAMAGED as error:
        raise DecodeError(f"not a DUE value: {error}") from error


def encode_frame(frame: Frame) -> bytes:
    """A frame whose values are immutable or frozen, as bytes."""
    try:
        buffer = _spare.pop()
    except IndexError:
        buffer = bytearray(_HEADER)
    try:
        _encoder.encode_into(frame, buffer, len(_HEADER))
    except (OverflowError, UnicodeError) as error:
        raise UnsupportedValue(f"a value under {frame.key} cannot be encoded: {error}") from error
    payload = bytes(buffer)
    if len(payload) <= _SPARE_BYTES:
        _spare.append(buffer)
    return payload


def encode_single(head: Frame, value: Any) -> bytes:
    """A frame of one value, which is copied once; `head.values` must be empty."""
    prefix = _HEADER + _encoder.encode(head)[:-1] + b"\x91"
    return b"".join((prefix, *_value_parts(value, len(prefix))))


_DAMAGED = (msgspec.DecodeError, ValueError, TypeError, RecursionError, OverflowError, struct.error)
"""What reading bytes that are no values may raise; the last two of our own extensions."""


def decode_frame(payload: bytes) -> Frame:
    """The inverse of `encode_frame`; raises `NewerVersion` or `DecodeError`."""
    if payload[:4] != _HEADER:
        if payload[:3] == MAGIC and len(payload) > 4:
            raise NewerVersion(f"wire format version {payload[3]}, this DUE reads version {VERSION}")
        raise DecodeError(f"not a DUE frame: begins with {payload[:8]!r}")
    try:
        frame = _frame_decoder.decode(memoryview(payload)[4:])
    except _DAMAGED as error:
        raise DecodeError(f"damaged DUE frame: {error}") from error
    times = len(frame.timestamps) if frame.event_times is None else len(frame.event_times)
    if not len(frame.values) == len(frame.timestamps) == times:
        raise DecodeError("damaged DUE frame: values and times differ in number")
    return frame


def unpack(frame: PackedFrame | bytes) -> list[Item]:
    """The items of a frame, in order; raises `DecodeError`, `NewerVersion`."""
    return decode_frame(frame if isinstance(frame, bytes) else frame.payload).items()


def pack(items: Sequence[Item], *, index: bool = False) -> PackedFrame:
    """One frame of consecutive items of one (instance, key); for drivers and tests."""
    first = items[0]
    times = [item.timestamp for item in items]
    events = [item.event_time for item in items]
    values = [freeze(item.value) for item in items]
    given = None if events == times else events
    frame = Frame(first.key, first.app_id, first.instance_id, 0, first.sequence, 0, times, given, values)
    return packed(frame, encode_frame(frame), index=index)


def packed(frame: Frame, payload: bytes, *, index: bool = False) -> PackedFrame:
    """The head of `frame`, whose encoded form is `payload`, for an archive."""
    times = frame.timestamps
    events = times if frame.event_times is None else frame.event_times
    return PackedFrame(
        frame.key,
        frame.app_id,
        frame.instance_id,
        frame.sequence,
        len(times),
        min(times),
        max(times),
        min(events),
        max(events),
        index,
        payload,
    )


def _checked_int(value: int) -> int:
    if -(2**63) <= value < 2**64:
        return value
    raise UnsupportedValue(f"int {value} does not fit into 64 bits; send it as str or bytes")


def _checked_text(value: str) -> str:
    if not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise UnsupportedValue(f"str holds a lone surrogate and is not UTF-8: {error}") from None
    return value


def _value_parts(value: Any, offset: int) -> list[bytes | memoryview]:
    kind = type(value)
    if kind is bytes:
        return [_bin_header(len(value)), value]
    if kind is RecordBatch:
        return _batch_parts(value, offset)
    if kind is np.ndarray:
        return _array_parts(value, offset)
    try:
        return [_encoder.encode(value if kind in _PLAIN else _checked(value))]
    except (OverflowError, UnicodeError) as error:
        raise UnsupportedValue(f"{kind.__name__} cannot be encoded: {error}") from error
    except RecursionError:
        raise UnsupportedValue(f"{kind.__name__} is nested too deeply or contains itself") from None


def _checked(value: Any) -> Any:
    """`value` with what msgspec would silently turn into text or numbers replaced or refused."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind in (list, tuple):
        return value if _PLAIN.issuperset(map(type, value)) else [_checked(v) for v in value]
    if kind is dict:
        if not all(type(name) is str for name in value):
            raise UnsupportedValue("names in a map are str; found " + _first_other(value))
        return value if _PLAIN.issuperset(map(type, value.values())) else _checked_map(value)
    if isinstance(value, np.generic):
        return _scalar(value)
    if kind is dt.datetime:
        return value if value.utcoffset() is not None else _naive(value)
    if kind in (np.ndarray, RecordBatch, msgspec.Raw):
        return _extension(value)
    if kind in (bytearray, memoryview):
        return bytes(value)
    raise UnsupportedValue(
        f"{kind.__module__}.{kind.__qualname__} is no DUE type; use None, bool, int, float, str, bytes, "
        "datetime, datetime64[ns], lists and maps of these, numpy arrays or RecordBatch"
    )


def _checked_map(value: dict[str, Any]) -> dict[str, Any]:
    return {name: _checked(v) for name, v in value.items()}


def _first_other(value: dict[Any, Any]) -> str:
    return next(type(name).__name__ for name in value if type(name) is not str)


def _scalar(value: np.generic) -> Any:
    if isinstance(value, np.datetime64):
        ns = value.astype("datetime64[ns]").astype(np.int64)
        return msgspec.msgpack.Ext(_DATETIME64, struct.pack("<q", int(ns)))
    if isinstance(value, np.bool_ | np.integer | np.floating | np.str_ | np.bytes_):
        return value.item() if not isinstance(value, np.longdouble) else float(value)
    raise UnsupportedValue(f"numpy.{type(value).__name__} is no DUE type; send an array of it")


def _naive(value: dt.datetime) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(_NAIVE_DATETIME, struct.pack("<q", (value - _EPOCH) // _MICROSECOND))


def _extension(value: Any) -> Any:
    if isinstance(value, msgspec.Raw):
        return value
    parts = _batch_body(value, 0) if isinstance(value, RecordBatch) else _array_body(value, 0)
    return msgspec.msgpack.Ext(_BATCH if isinstance(value, RecordBatch) else _ARRAY, b"".join(parts))


def _array_parts(array: npt.NDArray[Any], offset: int) -> list[bytes | memoryview]:
    body = _array_body(array, offset + _EXT_HEADER)
    return [_ext_header(_ARRAY, body), *body]


def _batch_parts(batch: RecordBatch, offset: int) -> list[bytes | memoryview]:
    body = _batch_body(batch, offset + _EXT_HEADER)
    return [_ext_header(_BATCH, body), *body]


def _array_body(array: npt.NDArray[Any], offset: int) -> list[bytes | memoryview]:
    """u32 length of the head, head = [dtype, shape], padding to the alignment, bytes in C order."""
    return _body([_dtype_text(array.dtype), list(array.shape)], [array], offset)


def _batch_body(batch: RecordBatch, offset: int) -> list[bytes | memoryview]:
    """u32 length of the head, head = [rows, [name, dtype]…], then each column with padding before it."""
    columns = [batch[name] for name in batch.columns]
    head = [len(batch), [[n, _dtype_text(c.dtype)] for n, c in zip(batch.columns, columns, strict=True)]]
    return _body(head, columns, offset)


def _body(head: Any, arrays: Sequence[npt.NDArray[Any]], offset: int) -> list[bytes | memoryview]:
    """Padding makes the data of each array start at a multiple of 16 bytes in the whole payload."""
    text = _encoder.encode(head)
    padding = -(offset + 5 + len(text)) % _ALIGNMENT
    parts: list[bytes | memoryview] = [struct.pack("<IB", len(text), padding), text, bytes(padding)]
    for array in arrays:
        data = _raw(array)
        parts += (data, bytes(-len(data) % _ALIGNMENT))
    return parts


def _raw(array: npt.NDArray[Any]) -> memoryview | bytes:
    if array.nbytes <= _COPIED_BELOW:
        return array.tobytes()
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data


def _dtype_text(dtype: np.dtype[Any]) -> Any:
    if dtype.hasobject or dtype.kind not in _KINDS or dtype.itemsize == 0:
        raise UnsupportedValue(f"arrays of dtype {dtype} cannot travel; use numbers, bytes or times")
    return dtype.str if dtype.names is None else [list(field) for field in dtype.descr]


_EXT_HEADER = 6
_COPIED_BELOW = 512
"""Bytes of an array that are copied sooner than a view of them is made."""


def _ext_header(code: int, body: list[bytes | memoryview]) -> bytes:
    return struct.pack(">BIb", 0xC9, sum(map(len, body)), code)


def _bin_header(length: int) -> bytes:
    return struct.pack(">BI", 0xC6, length)


def _from_extension(code: int, data: memoryview) -> Any:
    if code == _NAIVE_DATETIME:
        return _EPOCH + struct.unpack("<q", data)[0] * _MICROSECOND
    if code == _DATETIME64:
        return np.datetime64(struct.unpack("<q", data)[0], "ns")
    if code not in (_ARRAY, _BATCH):
        raise ValueError(f"extension type {code} is unknown")
    length, padding = struct.unpack_from("<IB", data)
    head = msgspec.msgpack.decode(data[5 : 5 + length])
    at = 5 + length + padding
    if code == _ARRAY:
        array, _ = _read_array(data, at, head[0], int(np.prod(head[1], dtype=np.int64)))
        return array.reshape(head[1])
    columns = {}
    for name, dtype in head[1]:
        columns[name], at = _read_array(data, at, dtype, head[0])
    return RecordBatch(columns)


def _read_array(data: memoryview, at: int, dtype: Any, size: int) -> tuple[npt.NDArray[Any], int]:
    kind = np.dtype(dtype if isinstance(dtype, str) else [_field(f) for f in dtype])
    if kind.hasobject or size < 0 or kind.itemsize == 0:
        raise ValueError(f"array of dtype {kind} is not allowed")
    array = np.frombuffer(data, kind, size, at) if size else np.empty(0, kind)
    if not array.flags.aligned:
        array = array.copy()
        array.flags.writeable = False
    length = size * kind.itemsize
    return array, at + length + -length % _ALIGNMENT


def _field(field: list[Any]) -> tuple[Any, ...]:
    return (field[0], field[1]) if len(field) == 2 else (field[0], field[1], tuple(field[2]))


_SPARE_BYTES = 1 << 18
_spare: deque[bytearray] = deque(maxlen=1)
"""Where frames are encoded: memory that is in the cache already and needs not grow.  Whoever uses it takes it out."""
_encoder = msgspec.msgpack.Encoder()
_value_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(Any, ext_hook=_from_extension)
_frame_decoder = msgspec.msgpack.Decoder(Frame, ext_hook=_from_extension)
