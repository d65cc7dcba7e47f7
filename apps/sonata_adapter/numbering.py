"""Short numbers for keys that come often: looked up once a batch, for all operators that go by these keys."""

from typing import Final

import numpy as np

from apps.sonata_adapter.tables import Hashes, KeyTable, Numbers

_KNOWN: Final = 1 << 16
_NEW_SHARE: Final = 8
"""Where more than one key in so many is new, looking them up is in vain."""
_PAUSE: Final = 32
"""For so many batches then."""


class Numbering:
    """Numbers of at most 65,536 keys, across batches and windows; starts again where they are all taken.

    Keys that mostly come once are not worth it: then it pauses.
    """

    def __init__(self) -> None:
        self._table = KeyTable(_KNOWN)
        self._pause = 0

    def number(self, keys: Hashes) -> "Numbered | None":
        """The keys' numbers; None: look for yourself this time."""
        if self._pause:
            self._pause -= 1
            return None
        known = self._table.size
        begin = 0 if known else len(keys) // _NEW_SHARE
        if begin:  # a few first: most of the others are the same
            self._table.number(keys[:begin])
        numbers, _ = self._table.number(keys)
        if (self._table.size - known) * _NEW_SHARE > len(keys):
            self._pause = _PAUSE
        if self._table.size < _KNOWN:
            return Numbered(self._table, numbers)
        self._table = KeyTable(_KNOWN)
        return None


class Numbered:
    """The numbers of a batch's keys, as `table` has them."""

    def __init__(self, table: KeyTable, numbers: Numbers) -> None:
        self.table = table
        self.numbers = numbers


class Translation:
    """From those numbers to an operator's own, as far as it knows."""

    def __init__(self) -> None:
        self._table: KeyTable | None = None
        self._own = np.empty(0, dtype=np.int64)

    def own(self, numbered: Numbered) -> Numbers:
        """The operator's numbers; -1: not known."""
        if self._table is not numbered.table:
            self._table = numbered.table
            self._own = np.empty(0, dtype=np.int64)
        missing = numbered.table.size - len(self._own)
        if missing > 0:
            self._own = np.concatenate((self._own, np.full(missing, -1)))
        return self._own[numbered.numbers]

    def learn(self, numbers: Numbers, own: Numbers) -> None:
        """What the operator calls them; of the same table as `own` was asked for."""
        self._own[numbers] = own
