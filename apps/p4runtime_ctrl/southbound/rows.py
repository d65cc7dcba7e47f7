"""Many messages with the same bit fields → one structured numpy array.

P4Runtime sends each field as a byte string without leading zeros.  Padded to a fixed width and joined, the
messages of a batch become an array in one step.
"""

from collections.abc import Iterable, Sequence
from itertools import chain, repeat
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.errors import Malformed

_WIDTHS: Final = (1, 2, 4, 8, 16, 32)
_TYPES: Final = {1: "u1", 2: ">u2", 4: ">u4", 8: ">u8", 16: (">u8", 2), 32: ("u1", 32)}


class RowLayout:
    """Fields by name and width in bits, in the order in which their values come.

    Fields over 64 bits become two halves (up to 128 bits) or single bytes (up to 256 bits).
    """

    def __init__(self, fields: Iterable[tuple[str, int]]) -> None:
        named = list(fields)
        self.widths = [next(width for width in _WIDTHS if 8 * width >= bits) for _, bits in named]
        kinds = [_TYPES[width] for width in self.widths]
        self.dtype = np.dtype(
            [
                (name, *(kind if isinstance(kind, tuple) else (kind,)))
                for (name, _), kind in zip(named, kinds, strict=True)
            ]
        )

    def array(self, rows: Sequence[Sequence[bytes]]) -> NDArray[Any]:
        """One record for each row of byte strings.

        Raises `Malformed` where a row has other fields than these, or a value does not fit.
        """
        if set(map(len, rows)) - {len(self.widths)}:
            raise Malformed(f"a message has other fields than {', '.join(self.dtype.names or ())}")
        data = self._joined(rows)
        if len(data) != len(rows) * self.dtype.itemsize:  # leading zeros beyond the width
            data = self._joined([[value.lstrip(b"\0") for value in row] for row in rows])
        if len(data) != len(rows) * self.dtype.itemsize:
            raise Malformed(f"a value does not fit into its field of {', '.join(self.dtype.names or ())}")
        return np.frombuffer(data, self.dtype)

    def read(self, rows: Sequence[Sequence[bytes]]) -> tuple[NDArray[Any], NDArray[np.intp]]:
        """Records of the rows that are well-formed, and which rows these are."""
        try:
            return self.array(rows), np.arange(len(rows))
        except Malformed:
            sound = [row for row, values in enumerate(rows) if self._fits(values)]
            return self.array([rows[row] for row in sound]), np.array(sound, dtype=np.intp)

    def _fits(self, row: Sequence[bytes]) -> bool:
        pairs = zip(row, self.widths, strict=False)
        return len(row) == len(self.widths) and all(
            len(value.lstrip(b"\0")) <= width for value, width in pairs
        )

    def _joined(self, rows: Sequence[Sequence[bytes]]) -> bytes:
        widths, zeros = self.widths, repeat(b"\0")
        return b"".join(chain.from_iterable(map(bytes.rjust, row, widths, zeros) for row in rows))


CLOCK_BITS: Final = 48
"""Width of a switch's clock in bits."""


def in_time(found: NDArray[Any]) -> NDArray[np.bool_]:
    """Which records have a time that the switch's clock can show."""
    return np.asarray(found["timestamp"].astype(np.uint64) >> np.uint64(CLOCK_BITS) == 0)


def has_bit(maps: NDArray[np.uint8], bit: int) -> NDArray[np.bool_]:
    """Which of the 256-bit maps, one per row as big-endian bytes, have the bit."""
    return (maps[:, 31 - bit // 8] >> np.uint8(bit % 8) & 1).astype(np.bool_)
