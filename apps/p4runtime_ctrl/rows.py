"""Many messages with the same bit fields → one structured numpy array.

P4Runtime sends each field as a byte string without leading zeros; put back to a fixed width and
joined, the messages of a batch become an array in one step.
"""

from collections.abc import Iterable, Sequence
from itertools import chain, repeat
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_WIDTHS: Final = (1, 2, 4, 8, 16, 32)
_TYPES: Final = {1: "u1", 2: ">u2", 4: ">u4", 8: ">u8", 16: (">u8", 2), 32: ("u1", 32)}


class Layout:
    """Fields by name and width in bits, in the order in which their values come.

    Fields over 64 bits become two halves (up to 128 bits) or single bytes (up to 256 bits).
    """

    def __init__(self, fields: Iterable[tuple[str, int]]) -> None:
        named = list(fields)
        self._widths = [next(width for width in _WIDTHS if 8 * width >= bits) for _, bits in named]
        kinds = [_TYPES[width] for width in self._widths]
        self.dtype = np.dtype(
            [
                (name, *(kind if isinstance(kind, tuple) else (kind,)))
                for (name, _), kind in zip(named, kinds, strict=True)
            ]
        )

    def array(self, rows: Sequence[Sequence[bytes]]) -> NDArray[Any]:
        """One record for each row of byte strings."""
        data = self._joined(rows)
        if len(data) != len(rows) * self.dtype.itemsize:  # somebody sends leading zeros beyond the width
            data = self._joined([[value.lstrip(b"\0") for value in row] for row in rows])
        return np.frombuffer(data, self.dtype)

    def _joined(self, rows: Sequence[Sequence[bytes]]) -> bytes:
        widths, zeros = self._widths, repeat(b"\0")
        return b"".join(chain.from_iterable(map(bytes.rjust, row, widths, zeros) for row in rows))


def has_bit(maps: NDArray[np.uint8], bit: int) -> NDArray[np.bool_]:
    """Of 256-bit maps, one to a row as big-endian bytes: which have the bit."""
    return (maps[:, 31 - bit // 8] >> np.uint8(bit % 8) & 1).astype(np.bool_)
