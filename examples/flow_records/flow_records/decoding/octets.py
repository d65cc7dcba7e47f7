"""Big-endian numbers at many places of a datagram at once."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Places = NDArray[np.intp]
"""Offsets in the datagram, one a record."""
MOST_WIDTH: Final = 8


def octets_of(datagram: bytes) -> NDArray[np.uint8]:
    """A view of the bytes."""
    return np.frombuffer(datagram, dtype=np.uint8)


def numbers(octets: NDArray[np.uint8], at: Places, width: int) -> NDArray[np.uint64]:
    """The numbers of 1 to 8 bytes that begin at these places, shape of `at`."""
    found = np.zeros(len(at), dtype=np.uint64)
    for place in range(width):
        found <<= np.uint64(8)
        found |= octets[at + place]
    return found
