"""Numpy arrays and record batches as bodies of extensions (docs/wire-format.md).

    body = u32 length of the head, u8 padding, head (msgpack), padding, then the bytes of each array in C order
    head = [dtype, shape]  or  [rows, [[name, dtype], …]]

Received bytes are untrusted: a dtype must follow the grammar below before numpy sees it, and every array must
lie within the data before memory is allocated for it.  Reading raises `DecodeError` and nothing else.
Writing applies the same limits and raises `UnsupportedValue`.
"""

import math
import re
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from due.errors import DecodeError, UnsupportedValue
from due.messages import RecordBatch

MAX_COLUMNS = 4096
MAX_FIELDS = 1024
"""Fields of one structured dtype, those of nested ones included."""
MAX_NESTING = 8
"""Structured dtypes within structured dtypes."""
MAX_DIMENSIONS = 32
MAX_ITEM_BYTES = 1 << 20
MAX_NAME = 256
"""Characters of a column's or field's name."""
MAX_ELEMENTS = 1 << 40
"""Product of a shape without its zero dimensions: numpy computes it even for empty arrays."""

_ALIGNMENT = 16
_COPIED_BELOW = 512
"""Arrays smaller than this are copied: that is faster than making a view."""
_PREFIX = struct.Struct("<IB")

_DTYPE = re.compile(
    r"[|<>][biu]1|[<>][iu][248]|[<>]f(?:2|4|8|16)|[<>]c(?:8|16|32)"
    r"|\|[SV][1-9][0-9]{0,6}|[<>]U[1-9][0-9]{0,6}"
    r"|[<>][mM]8(?:\[(?:[1-9][0-9]{0,8})?(?:Y|M|W|D|h|m|s|ms|us|ns|ps|fs|as)\])?"
)

_Name = Annotated[str, msgspec.Meta(max_length=MAX_NAME)]
_DtypeHead = str | list[Any]
_Size = Annotated[int, msgspec.Meta(ge=0, le=MAX_ELEMENTS)]
_array_head = msgspec.msgpack.Decoder(
    tuple[_DtypeHead, Annotated[list[_Size], msgspec.Meta(max_length=MAX_DIMENSIONS)]]
)
_batch_head = msgspec.msgpack.Decoder(
    tuple[_Size, Annotated[list[tuple[_Name, _DtypeHead]], msgspec.Meta(max_length=MAX_COLUMNS)]]
)
_encoder = msgspec.msgpack.Encoder()


def array_body(array: npt.NDArray[Any], offset: int) -> list[bytes | memoryview]:
    """The parts of an array's body; `offset`: where it will begin in the payload."""
    _checked_shape(array.shape)
    return _body([_dtype_text(array.dtype), list(array.shape)], [array], offset)


def batch_body(batch: RecordBatch, offset: int) -> list[bytes | memoryview]:
    """The parts of a record batch's body; padding follows each column."""
    names = batch.columns
    if len(names) > MAX_COLUMNS or any(type(name) is not str or len(name) > MAX_NAME for name in names):
        raise UnsupportedValue(
            f"a RecordBatch has at most {MAX_COLUMNS} columns, named by str of at most {MAX_NAME} characters"
        )
    columns = [batch[name] for name in names]
    head = [len(batch), [[n, _dtype_text(c.dtype)] for n, c in zip(names, columns, strict=True)]]
    return _body(head, columns, offset)


def read_array(data: memoryview) -> npt.NDArray[Any]:
    """The array of a body, a read-only view of `data` where its alignment allows; raises `DecodeError`."""
    (text, shape), at = _head(data, _array_head)
    kind = _dtype(text)
    if math.prod(size for size in shape if size) > MAX_ELEMENTS:
        raise DecodeError(f"damaged array: more than {MAX_ELEMENTS} elements")
    array, _ = _read(data, at, kind, math.prod(shape))
    return array.reshape(shape)


def read_batch(data: memoryview) -> RecordBatch:
    """The record batch of a body, its columns as in `read_array`; raises `DecodeError`."""
    (rows, heads), at = _head(data, _batch_head)
    columns: dict[str, npt.NDArray[Any]] = {}
    for name, text in heads:
        columns[name], at = _read(data, at, _dtype(text), rows)
    if len(columns) != len(heads) or (rows and not heads):
        raise DecodeError("damaged record batch: a column occurs twice, or there are rows without columns")
    return RecordBatch(columns)


def _head(data: memoryview, decoder: "msgspec.msgpack.Decoder[Any]") -> tuple[Any, int]:
    """The head, and where the first array begins."""
    if len(data) < _PREFIX.size:
        raise DecodeError("damaged array: cut off")
    length, padding = _PREFIX.unpack_from(data)
    end = _PREFIX.size + length
    if end + padding > len(data):
        raise DecodeError("damaged array: its head is cut off")
    try:
        return decoder.decode(data[_PREFIX.size : end]), end + padding
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise DecodeError(f"damaged array: {error}") from None


def _read(data: memoryview, at: int, kind: np.dtype[Any], size: int) -> tuple[npt.NDArray[Any], int]:
    length = size * kind.itemsize
    if at + length > len(data):
        raise DecodeError(f"damaged array: {size} x {kind.itemsize} bytes are announced, fewer are there")
    array = np.frombuffer(data, kind, size, at) if size else np.empty(0, kind)
    if not array.flags.aligned:
        array = array.copy()
        array.flags.writeable = False
    return array, at + length + -length % _ALIGNMENT


def _dtype(head: _DtypeHead) -> np.dtype[Any]:
    return _simple(head) if isinstance(head, str) else _structured(head)


@lru_cache(maxsize=256)
def _simple(text: str) -> np.dtype[Any]:
    if not _DTYPE.fullmatch(text):
        raise DecodeError(f"damaged array: {text[:40]!r} is not a dtype that DUE encodes")
    try:
        kind = np.dtype(text)
    except (TypeError, ValueError) as error:  # an item size that numpy does not have on this machine
        raise DecodeError(f"damaged array: {error}") from None
    return _bounded(kind)


def _structured(head: list[Any]) -> np.dtype[Any]:
    try:
        kind = np.dtype(_fields(head, [MAX_FIELDS], MAX_NESTING))
    except (ValueError, TypeError) as error:  # two fields of one name
        raise DecodeError(f"damaged array: {error}") from None
    return _bounded(kind)


def _bounded(kind: np.dtype[Any]) -> np.dtype[Any]:
    if not 0 < kind.itemsize <= MAX_ITEM_BYTES:
        raise DecodeError(f"damaged array: an item has 1 to {MAX_ITEM_BYTES} bytes, not {kind.itemsize}")
    return kind


def _fields(head: list[Any], left: list[int], nesting: int) -> list[tuple[Any, ...]]:
    """The fields in numpy's form; `left`: how many more are allowed."""
    left[0] -= len(head)
    if left[0] < 0 or not nesting:
        raise DecodeError(f"damaged array: over {MAX_FIELDS} fields, or over {MAX_NESTING} levels of them")
    return [_field(field, left, nesting) for field in head]


def _field(field: Any, left: list[int], nesting: int) -> tuple[Any, ...]:
    if not isinstance(field, list) or len(field) not in (2, 3):
        raise DecodeError("damaged array: a field is [name, dtype] or [name, dtype, shape]")
    name, kind = field[:2]
    if not isinstance(name, str) or len(name) > MAX_NAME or not isinstance(kind, str | list):
        raise DecodeError("damaged array: a field is [name, dtype] or [name, dtype, shape]")
    inner = _simple(kind) if isinstance(kind, str) else _fields(kind, left, nesting - 1)
    return (name, inner) if len(field) == 2 else (name, inner, _field_shape(field[2]))


def _field_shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, list) or len(shape) > MAX_DIMENSIONS:
        raise DecodeError("damaged array: a field's shape is a list of sizes")
    if not all(type(size) is int and 0 < size <= MAX_ITEM_BYTES for size in shape):
        raise DecodeError("damaged array: a size in a field's shape is out of range")
    if math.prod(shape) > MAX_ITEM_BYTES:
        raise DecodeError(f"damaged array: an item has over {MAX_ITEM_BYTES} bytes")
    return tuple(shape)


def _body(head: Any, arrays: Sequence[npt.NDArray[Any]], offset: int) -> list[bytes | memoryview]:
    """Padding makes the data of each array start at a multiple of 16 bytes in the whole payload."""
    text = _encoder.encode(head)
    padding = -(offset + _PREFIX.size + len(text)) % _ALIGNMENT
    parts: list[bytes | memoryview] = [_PREFIX.pack(len(text), padding), text, bytes(padding)]
    for array in arrays:
        data = _raw(array)
        parts += (data, bytes(-len(data) % _ALIGNMENT))
    return parts


def _raw(array: npt.NDArray[Any]) -> memoryview | bytes:
    if array.nbytes <= _COPIED_BELOW:
        return array.tobytes()
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data


def _checked_shape(shape: tuple[int, ...]) -> None:
    if len(shape) > MAX_DIMENSIONS or math.prod(size for size in shape if size) > MAX_ELEMENTS:
        raise UnsupportedValue(f"an array has at most {MAX_DIMENSIONS} dimensions, {MAX_ELEMENTS} elements")


@lru_cache(maxsize=256)
def _dtype_text(dtype: np.dtype[Any]) -> Any:
    """The dtype as written in a head; refuses what readers refuse."""
    if dtype.hasobject:
        raise UnsupportedValue(f"arrays of dtype {dtype} cannot travel; use numbers, bytes or times")
    text = dtype.str if dtype.names is None else _field_list(dtype.descr)
    try:
        _dtype(text)
    except DecodeError as error:
        raise UnsupportedValue(
            f"arrays of dtype {dtype} cannot travel ({error}); use numbers, bytes or times"
        ) from None
    return text


def _field_list(fields: list[Any]) -> list[Any]:
    return [
        [name, _field_list(kind) if isinstance(kind, list) else kind, *map(list, shape)]
        for name, kind, *shape in fields
    ]
