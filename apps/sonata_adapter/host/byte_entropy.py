"""Shannon entropy of byte strings, one for each row of a matrix.

Reference:
    Shannon, A Mathematical Theory of Communication, 1948, section 6.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_MOST_BYTES: Final = 256
_ROWS: Final = 1_024
"""Rows at a time: their histograms take 2 MB."""
_COUNTS: Final = np.arange(_MOST_BYTES + 1, dtype=np.float64)
_TERMS: Final = _COUNTS * np.log2(np.maximum(_COUNTS, 1))
"""By count c: c · log2 c."""


def byte_entropy(letters: NDArray[np.uint8], sizes: NDArray[Any]) -> NDArray[np.int64]:
    """Entropy of the first `sizes` bytes of each row.

    Args:
        letters: at most 256 bytes a row, shape (n, m).
        sizes: bytes of each row that count, shape (n,); at most m.

    Returns:
        Thousandths of a bit a byte, rounded, 0 to 8,000; 0 for no bytes.
    """
    found = np.zeros(len(letters), dtype=np.int64)
    for begin in range(0, len(letters), _ROWS):
        part, counted = letters[begin : begin + _ROWS], np.asarray(sizes[begin : begin + _ROWS])
        inside = np.arange(letters.shape[1]) < counted[:, None]
        places = np.arange(len(part))[:, None] * 256 + part
        counts = np.bincount(places[inside], minlength=256 * len(part)).reshape(len(part), 256)
        whole = np.maximum(counted, 1)
        bits = np.log2(whole) - _TERMS[counts].sum(axis=1) / whole
        found[begin : begin + _ROWS] = np.rint(1000 * bits)
    return found
