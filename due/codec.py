"""Values and frames as bytes (docs/wire-format.md).

    frame = "DUE" version(1 byte)  msgpack array:
            [key, app, instance, epoch, first sequence, published before, timestamps, event times | nil, values]

msgpack throughout; types that msgpack lacks are extensions:
    -1 aware datetime (msgpack's own)   1 naive datetime   2 datetime64[ns]   3 numpy array   4 record batch

Big values and columns are copied once on the way out (into the payload) and not at all on the way in:
received arrays are read-only views of the received bytes.

Decoded bytes are untrusted: within the limits below decoding returns a value, beyond them it raises `DecodeError`
and nothing else.  Encoding refuses what decoding would refuse.
"""

import datetime as dt
import operator
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import count, repeat
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from due.arrays import array_body, batch_body, read_array, read_batch
from due.errors import DecodeError, NewerVersion, UnsupportedValue
from due.keys import MAX_BYTES
from due.messages import Item, PackedFrame, RecordBatch

VERSION = 1
MAGIC = b"DUE"
_HEADER = MAGIC + bytes([VERSION])

_NAIVE_DATETIME, _DATETIME64, _ARRAY, _BATCH = 1, 2, 3, 4
_EPOCH = dt.datetime(1970, 1, 1)  # noqa: DTZ001 - naive on purpose
_MICROSECOND = dt.timedelta(microseconds=1)
_FIRST_MICROSECOND = (dt.datetime.min - _EPOCH) // _MICROSECOND  # noqa: DTZ901 - naive, as _EPOCH
_LAST_MICROSECOND = (dt.datetime.max - _EPOCH) // _MICROSECOND  # noqa: DTZ901 - the same
_INT64 = struct.Struct("<q")

_ATOMS = frozenset((type(None), bool, float, bytes))
"""Immutable types that always encode: buffered without a copy."""
_PLAIN = _ATOMS | {int, str}
_NESTING = frozenset((list, dict))


MAX_PAYLOAD = 64 << 20
"""Bytes of a frame or value."""
MAX_ITEMS = 1 << 20
"""Items of a frame."""
MAX_DEPTH = 64
"""Lists and maps within each other: more is neither written nor read."""
MAX_NUMBER = 2**62 - 1
"""Limit of `sequence` and `before`, also after the last item of a frame."""
MAX_EPOCH = 2**32 - 1
"""Epochs begin at the unix time of the first Coordinator's start and grow by one with each change of the active
instance."""
MAX_TIME = 2**63 - 1
"""ns, either side of 1970."""
MAX_ID = 64
"""Characters of an app id or instance id."""

_Number = Annotated[int, msgspec.Meta(ge=0, le=MAX_NUMBER - MAX_ITEMS)]
_Epoch = Annotated[int, msgspec.Meta(ge=0, le=MAX_EPOCH)]
_Time = Annotated[int, msgspec.Meta(le=MAX_TIME)]
_Id = Annotated[str, msgspec.Meta(max_length=MAX_ID)]
_KeyText = Annotated[str, msgspec.Meta(max_length=MAX_BYTES)]
_Some = msgspec.Meta(min_length=1, max_length=MAX_ITEMS)


class Frame(msgspec.Struct, array_like=True, gc=False):
    """A decoded frame: consecutive items of one (instance, key)."""

    key: _KeyText
    app_id: _Id
    instance_id: _Id
    epoch: _Epoch
    sequence: _Number
    """Of the first item."""
    before: _Number
    """How many items of this (instance, key) were published before this frame: shows gaps and repeats."""
    timestamps: Annotated[list[_Time], _Some]
    event_times: Annotated[list[_Time], _Some] | None
    """None where they equal the timestamps."""
    values: Annotated[list[Any], _Some]

    def items(self) -> list[Item]:
        """The items, in order."""
        return list(self.stream())

    def stream(self) -> Iterator[Item]:
        """The items, in order, created one by one, so that each is cached when its callback runs."""
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
    if len(data) > MAX_PAYLOAD:
        raise DecodeError(f"not a DUE value: {len(data)} bytes, at most {MAX_PAYLOAD} are read")
    try:
        value = _value_decoder.decode(data)
    except _DAMAGED as error:
        raise DecodeError(f"not a DUE value: {error}") from None
    if _too_deep([value]):
        raise DecodeError(f"not a DUE value: nested over {MAX_DEPTH} levels deep")
    return value


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
    _check_size(len(buffer), frame.key)
    payload = bytes(buffer)
    if len(payload) <= _SPARE_BYTES:
        _spare.append(buffer)
    return payload


def encode_single(head: Frame, value: Any) -> bytes:
    """A frame of one value, which is copied once; `head.values` must be empty."""
    prefix = _HEADER + _encoder.encode(head)[:-1] + b"\x91"
    parts = (prefix, *_value_parts(value, len(prefix)))
    _check_size(sum(map(len, parts)), head.key)
    return b"".join(parts)


_DAMAGED = (msgspec.MsgspecError, ValueError, TypeError, RecursionError, MemoryError)
"""What msgspec raises on bytes that are no values: text that is not UTF-8, maps under names that cannot be names,
nesting beyond the interpreter's stack, lengths beyond memory.  Our own extensions raise `DecodeError`."""


def decode_frame(payload: bytes) -> Frame:
    """The inverse of `encode_frame`; raises `NewerVersion` or `DecodeError`."""
    if not payload.startswith(_HEADER):
        if payload.startswith(MAGIC) and len(payload) > 4:
            raise NewerVersion(f"wire format version {payload[3]}, this DUE reads version {VERSION}")
        raise DecodeError(f"not a DUE frame: begins with {payload[:8]!r}")
    size = len(payload)
    if size > MAX_PAYLOAD:
        raise DecodeError(f"damaged DUE frame: {size} bytes, at most {MAX_PAYLOAD} are read")
    try:
        # copying a few bytes is faster than making a view of them
        frame = _frame_decoder.decode(payload[4:] if size <= _COPIED_BELOW else memoryview(payload)[4:])
    except _DAMAGED as error:
        raise DecodeError(f"damaged DUE frame: {error}") from None
    times = len(frame.timestamps) if frame.event_times is None else len(frame.event_times)
    if not len(frame.values) == len(frame.timestamps) == times:
        raise DecodeError("damaged DUE frame: values and times differ in number")
    if _too_deep(frame.values):
        raise DecodeError(f"damaged DUE frame: a value is nested over {MAX_DEPTH} levels deep")
    return frame


def _too_deep(values: list[Any]) -> bool:
    """Whether a value nests over `MAX_DEPTH` lists and maps."""
    if _NESTING.isdisjoint(map(type, values)):
        return False
    found, levels = values, 0
    while found := [
        inner
        for one in found
        if type(one) in _NESTING
        for inner in (one if type(one) is list else one.values())
    ]:
        levels += 1
        if levels > MAX_DEPTH:
            return True
    return False


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
    """`frame` with its encoded form `payload`, in the form that archives store."""
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


def checked_time(time: int) -> int:
    """An event time as it can travel; raises `UnsupportedValue`."""
    try:
        number = operator.index(time)
    except TypeError:
        raise UnsupportedValue(f"an event time is an int of ns, not {type(time).__name__}") from None
    if not -MAX_TIME - 1 <= number <= MAX_TIME:
        raise UnsupportedValue(f"event time {number} does not fit into 64 bits; it is in ns since 1970")
    return number


def _check_size(size: int, key: str) -> None:
    if size > MAX_PAYLOAD:
        raise UnsupportedValue(
            f"a value under {key} makes a frame of {size} bytes, more than {MAX_PAYLOAD}: write it in parts"
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
        return [_encoder.encode(value if kind in _PLAIN else _checked(value, MAX_DEPTH))]
    except (OverflowError, UnicodeError) as error:
        raise UnsupportedValue(f"{kind.__name__} cannot be encoded: {error}") from error


def _checked(value: Any, levels: int) -> Any:
    """`value` without anything that msgspec would silently turn into text or numbers."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind in (list, tuple):
        return value if _PLAIN.issuperset(map(type, value)) else _checked_list(value, levels)
    if kind is dict:
        if not all(type(name) is str for name in value):
            raise UnsupportedValue("names in a map are str; found " + _first_other(value))
        return value if _PLAIN.issuperset(map(type, value.values())) else _checked_map(value, levels)
    if isinstance(value, np.generic):
        return _scalar(value)
    if kind is dt.datetime:
        return value if value.utcoffset() is not None else _naive(value)
    if kind in (np.ndarray, RecordBatch, msgspec.Raw):
        return _extension(value)
    if kind in (bytearray, memoryview):
        return bytes(value)
    raise UnsupportedValue(
        f"{kind.__module__}.{kind.__qualname__} is not a DUE type; use None, bool, int, float, str, bytes, "
        "datetime, datetime64[ns], lists and maps of these, numpy arrays or RecordBatch"
    )


def _checked_list(value: Sequence[Any], levels: int) -> list[Any]:
    _check_levels(levels)
    return [_checked(v, levels - 1) for v in value]


def _checked_map(value: dict[str, Any], levels: int) -> dict[str, Any]:
    _check_levels(levels)
    return {name: _checked(v, levels - 1) for name, v in value.items()}


def _check_levels(left: int) -> None:
    if left <= 1:
        raise UnsupportedValue(f"a value is nested over {MAX_DEPTH} levels deep, or contains itself")


def _first_other(value: dict[Any, Any]) -> str:
    return next(type(name).__name__ for name in value if type(name) is not str)


def _scalar(value: np.generic) -> Any:
    if isinstance(value, np.datetime64):
        ns = value.astype("datetime64[ns]").astype(np.int64)
        return msgspec.msgpack.Ext(_DATETIME64, _INT64.pack(int(ns)))
    if isinstance(value, np.bool_ | np.integer | np.floating | np.str_ | np.bytes_):
        return value.item() if not isinstance(value, np.longdouble) else float(value)
    raise UnsupportedValue(f"numpy.{type(value).__name__} is not a DUE type; send an array of it")


def _naive(value: dt.datetime) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(_NAIVE_DATETIME, _INT64.pack((value - _EPOCH) // _MICROSECOND))


def _extension(value: Any) -> Any:
    if isinstance(value, msgspec.Raw):
        return value
    parts = batch_body(value, 0) if isinstance(value, RecordBatch) else array_body(value, 0)
    return msgspec.msgpack.Ext(_BATCH if isinstance(value, RecordBatch) else _ARRAY, b"".join(parts))


def _array_parts(array: npt.NDArray[Any], offset: int) -> list[bytes | memoryview]:
    body = array_body(array, offset + _EXT_HEADER)
    return [_ext_header(_ARRAY, body), *body]


def _batch_parts(batch: RecordBatch, offset: int) -> list[bytes | memoryview]:
    body = batch_body(batch, offset + _EXT_HEADER)
    return [_ext_header(_BATCH, body), *body]


_EXT_HEADER = 6


def _ext_header(code: int, body: list[bytes | memoryview]) -> bytes:
    return struct.pack(">BIb", 0xC9, sum(map(len, body)), code)


def _bin_header(length: int) -> bytes:
    return struct.pack(">BI", 0xC6, length)


def _from_extension(code: int, data: memoryview) -> Any:
    if code == _ARRAY:
        return read_array(data)
    if code == _BATCH:
        return read_batch(data)
    if code not in (_NAIVE_DATETIME, _DATETIME64):
        raise DecodeError(f"extension type {code} is unknown")
    if len(data) != _INT64.size:
        raise DecodeError(f"a time has {_INT64.size} bytes, not {len(data)}")
    number: int = _INT64.unpack(data)[0]
    if code == _DATETIME64:
        return np.datetime64(number, "ns")
    if not _FIRST_MICROSECOND <= number <= _LAST_MICROSECOND:
        raise DecodeError(f"a time of {number} µs is beyond the calendar")
    return _EPOCH + number * _MICROSECOND


_COPIED_BELOW = 512
_SPARE_BYTES = 1 << 18
_spare: deque[bytearray] = deque(maxlen=1)
"""A buffer for encoding frames, reused because it is cached and large enough; taken out while in use."""
_encoder = msgspec.msgpack.Encoder()
_value_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(Any, ext_hook=_from_extension)
_frame_decoder = msgspec.msgpack.Decoder(Frame, ext_hook=_from_extension)
