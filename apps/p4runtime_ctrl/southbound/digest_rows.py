"""Digest lists as they travel → rows, by one call of C for each list.

Under load most of the stream is digest lists: hundreds of samples with thirty members each.  Protobuf would make
an object of every sample and of every member.  Without a C compiler at installation it does.
"""

import functools
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import cffi
import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from apps.p4runtime_ctrl.southbound.rows import RowLayout, in_time
from p4rt import p4runtime

_LOG = logging.getLogger(__name__)
_LIBRARY: Final = Path(__file__).with_name("_digest_rows.so")
_DECLARATIONS: Final = """
long digest_samples(const uint8_t *data, long size);
long digest_rows(const uint8_t *data, long size, const int32_t *widths, long fields, long row_bytes,
                 uint8_t *rows, long room);
typedef struct { int32_t at, width; } DigestField;
void digest_columns(const uint8_t *rows, long n, long row_bytes, const DigestField *fields, int64_t base_us, uint8_t *to);
"""
_DIGEST: Final = 0x1A
_LIST_PARTS: Final = (0x08, 0x10)
"""Tags of `digest` in a StreamMessageResponse, and of `digest_id` and `list_id` in a DigestList."""


class DigestRowsLibrary(NamedTuple):
    """The loaded library and its cffi instance."""

    ffi: Any
    lib: Any


@functools.cache
def load_digest_rows(path: Path = _LIBRARY) -> DigestRowsLibrary | None:
    """The library, or None with one line in the log when it was not built (no C compiler at installation)."""
    ffi = cffi.FFI()
    ffi.cdef(_DECLARATIONS)
    try:
        return DigestRowsLibrary(ffi, ffi.dlopen(str(path)))
    except OSError as error:
        _LOG.warning(
            "digests are read by protobuf, several times slower: %s. "
            "Install a C compiler and reinstall SDNator (pip install) to get the library.",
            error,
        )
        return None


class ReceivedDigests:
    """A DigestList whose samples nobody has parsed yet; what is used of p4runtime.DigestList is here, too."""

    __slots__ = ("_body", "digest_id", "list_id", "size")

    def __init__(self, digest_id: int, list_id: int, body: bytes, size: int) -> None:
        self.digest_id = digest_id
        self.list_id = list_id
        self.size = size
        """Bytes of the whole message."""
        self._body = body

    @classmethod
    def of(cls, message: bytes) -> "ReceivedDigests | None":
        """The list in a serialized StreamMessageResponse, if that is all it holds and its numbers come first."""
        if not message or message[0] != _DIGEST:
            return None
        try:
            size, start = _varint(message, 1)
            numbers, at = [0, 0], start
            for place, tag in enumerate(_LIST_PARTS):
                if at < len(message) and message[at] == tag:
                    numbers[place], at = _varint(message, at + 1)
        except IndexError:
            return None
        if start + size != len(message) or numbers[0] >> 32 or numbers[1] >> 64:
            return None
        return cls(numbers[0], numbers[1], message[start:], len(message))

    @property
    def data(self) -> Any:
        """Its samples, parsed; none of a damaged list."""
        try:
            return p4runtime.DigestList.FromString(self._body).data
        except DecodeError:
            return ()

    def SerializeToString(self) -> bytes:  # noqa: N802 - as protobuf calls it
        """The list as it came."""
        return self._body


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number and where it ends; raises IndexError beyond the data, or beyond ten bytes."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise IndexError(at)


def sound_rows(layout: RowLayout, digests: Any) -> tuple[NDArray[Any], int]:
    """Rows of the well-formed samples of a list, in order, and how many others there are.

    Args:
        layout: the members.
        digests: a p4runtime.DigestList or `ReceivedDigests`.
    """
    library = load_digest_rows()
    if library is None:
        rows = [[member.bitstring for member in data.struct.members] for data in digests.data]
        found, _ = layout.read(rows)
        return found, len(rows) - len(found)
    body = digests.SerializeToString()
    count = library.lib.digest_samples(library.ffi.from_buffer(body), len(body))
    # a sample has at least two bytes for each member: empty ones take no memory here
    room = min(max(count, 0), len(body) // (2 * len(layout.widths)) + 1)
    found = np.empty(room, layout.dtype)
    widths = np.asarray(layout.widths, np.int32)
    kept = library.lib.digest_rows(
        library.ffi.from_buffer(body),
        len(body),
        library.ffi.cast("int32_t *", widths.ctypes.data),
        len(widths),
        layout.dtype.itemsize,
        library.ffi.cast("uint8_t *", found.ctypes.data),
        room,
    )
    return found[:kept], 1 if count < 0 else count - kept


def read_lists(layout: RowLayout, lists: Sequence[Any]) -> tuple[NDArray[Any], int]:
    """Rows of digest lists, in order, and how many samples were left out as malformed."""
    read = [sound_rows(layout, each) for each in lists]
    malformed = sum(bad for _, bad in read)
    found = read[0][0] if len(read) == 1 else _joined(layout, [rows for rows, _ in read])
    sound = in_time(found)
    if sound.all():
        return found, malformed
    return found[sound], malformed + int(np.count_nonzero(~sound))


def _joined(layout: RowLayout, read: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Rows one behind the other, as bytes: numpy would turn each number of each row to the machine's order."""
    rows: NDArray[Any] = np.concatenate([each.view(np.uint8) for each in read] or [np.empty(0, np.uint8)])
    return rows.view(layout.dtype)
