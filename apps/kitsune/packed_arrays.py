"""A header and arrays as compressed bytes, and back within limits: what a checkpoint is made of.  Pure.

    mark, version │ zlib: length of the header, header (JSON), the arrays' bytes one after the other

The header names the arrays, their types and shapes. Nothing is unpacked beyond `MOST_BYTES`.
"""

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

MOST_BYTES: Final = 1 << 29
"""Of all arrays and the header."""
MOST_ARRAYS: Final = 256
_TYPES: Final = ("u1", "f8")
_MOST_DIMENSIONS: Final = 3
_LEVEL: Final = 1
"""Of compression: three times as quick as the usual one, a tenth larger."""
_LENGTH: Final = struct.Struct("<Q")
_HEAD: Final = struct.Struct("<8sI")

Arrays = Mapping[str, npt.NDArray[Any]]


class CheckpointError(ValueError):
    """Bytes are no checkpoint, or one that is of no use here; the text says why."""


def pack(mark: bytes, version: int, header: Mapping[str, Any], arrays: Arrays) -> bytes:
    """Header and arrays as bytes.

    Args:
        mark: 8 bytes that say what it is.
        version: of what the header says.
        header: fit for JSON.
        arrays: bytes and numbers of 64 bits, by name.
    """
    listed = [
        [name, array.dtype.str.lstrip("<|"), list(array.shape)] for name, array in sorted(arrays.items())
    ]
    text = json.dumps({**header, "arrays": listed}, separators=(",", ":")).encode()
    packer = zlib.compressobj(_LEVEL)
    parts = [_HEAD.pack(mark, version), packer.compress(_LENGTH.pack(len(text)) + text)]
    parts += [packer.compress(np.ascontiguousarray(array).data) for _, array in sorted(arrays.items())]
    return b"".join([*parts, packer.flush()])


def unpack(data: bytes, mark: bytes, version: int) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The inverse of `pack`.

    Args:
        data: from anywhere.
        mark: as given to `pack`.
        version: the only one that is read.

    Raises:
        CheckpointError: it is something else, damaged, too large, or of another version.
    """
    if len(data) < _HEAD.size or not data.startswith(mark):
        raise CheckpointError("not a checkpoint of Kitsune")
    found = _HEAD.unpack_from(data)[1]
    if found != version:
        raise CheckpointError(f"checkpoint version {found}, this program reads version {version}")
    content = memoryview(_unzipped(data[_HEAD.size :]))
    try:
        (length,) = _LENGTH.unpack_from(content)
        end = _LENGTH.size + length
        if end > len(content):
            raise CheckpointError("a damaged checkpoint: its end is missing")
        header = json.loads(bytes(content[_LENGTH.size : end]))
        return dict(header), _arrays(content[end:], header["arrays"])
    except (struct.error, KeyError, TypeError, ValueError, RecursionError) as error:
        raise _as_error(error) from error


def _as_error(error: Exception) -> CheckpointError:
    return error if isinstance(error, CheckpointError) else CheckpointError(f"a damaged checkpoint: {error}")


def _unzipped(data: bytes) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, MOST_BYTES)
    except (zlib.error, MemoryError) as error:
        raise CheckpointError(f"a damaged checkpoint: {error}") from error
    if not unpacker.eof or unpacker.unused_data:
        raise CheckpointError(
            f"a damaged checkpoint: its end is not where it should be, or it is larger than {MOST_BYTES:,} bytes"
        )
    return content


def _arrays(content: memoryview, listed: Any) -> dict[str, npt.NDArray[Any]]:
    if not isinstance(listed, list) or len(listed) > MOST_ARRAYS:
        raise CheckpointError("a damaged checkpoint: no list of arrays")
    found: dict[str, npt.NDArray[Any]] = {}
    at = 0
    for name, kind, shape in listed:
        if kind not in _TYPES or not all(type(size) is int and 0 <= size <= MOST_BYTES for size in shape):
            raise CheckpointError(f"a damaged checkpoint: an array of {kind} and shape {shape}")
        count = 1
        for size in shape:
            count *= size
        end = at + count * np.dtype(kind).itemsize
        if end > len(content) or name in found or len(shape) > _MOST_DIMENSIONS:
            raise CheckpointError("a damaged checkpoint: an array is cut off, or named twice")
        found[name] = np.frombuffer(content[at:end], dtype=f"<{kind}").reshape(shape).copy()
        at = end
    if at != len(content):
        raise CheckpointError("a damaged checkpoint: bytes that belong to no array")
    return found
