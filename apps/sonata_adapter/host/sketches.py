"""Approximate state for operators that exceed their limit of exact keys: fixed memory, known error.

Bloom filter   for distinct: may mistake a new tuple for an old one, never the reverse
Count-Min      for reduce: may count too much, never too little
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.key_tables import Hashes, Numbers

_HASHES: Final = 4
_BITS_EACH: Final = 16
_ODD: Final = np.array(
    [0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93, 0xA0761D6478BD642F], dtype=np.uint64
)


def _places(keys: Hashes, size: int) -> list[NDArray[np.int64]]:
    """One cell for each key and hash function; the keys are mixed already."""
    return [((keys * odd >> np.uint64(20)) % np.uint64(size)).astype(np.int64) for odd in _ODD]


class Bloom:
    """Sixteen bits for each expected key: one in 400 new keys is missed when it is as full as expected."""

    def __init__(self, expected: int) -> None:
        self._bits = np.zeros(expected * _BITS_EACH, dtype=np.bool_)

    def add(self, keys: Hashes) -> NDArray[np.intp]:
        """Rows of keys that were not in it, first occurrences only."""
        _, first = np.unique(keys, return_index=True)
        first.sort()
        chosen = keys[first]
        places = _places(chosen, len(self._bits))
        known = np.ones(len(chosen), dtype=np.bool_)
        for place in places:
            known &= self._bits[place]
        for place in places:
            self._bits[place] = True
        return first[~known]

    @property
    def missed_share(self) -> float:
        """Probability that a new key is mistaken for an old one now."""
        return float(self._bits.mean()) ** _HASHES


class CountMin:
    """Counts of keys in four rows of cells; the least of a key's four cells is its estimate."""

    def __init__(self, width: int) -> None:
        self._cells = np.zeros((_HASHES, width), dtype=np.int64)
        self.total = 0

    def add(self, keys: Hashes, amounts: Numbers) -> Numbers:
        """Add and return each row's estimate afterwards."""
        self.total += int(amounts.sum())
        estimates = np.full(len(keys), np.iinfo(np.int64).max)
        for row, place in enumerate(_places(keys, self._cells.shape[1])):
            np.add.at(self._cells[row], place, amounts)
            estimates = np.minimum(estimates, self._cells[row][place])
        return estimates

    @property
    def excess(self) -> int:
        """An estimate is too large by more than this with a probability of e^-4 (2 %) at most."""
        return int(np.e * self.total / self._cells.shape[1])
