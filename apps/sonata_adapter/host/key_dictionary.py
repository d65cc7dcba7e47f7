"""Small numbers for recurring keys: looked up once per batch, for all operators and windows.

    keys ─► Numbering ─► Numbered ─┬─► KeyNumbers of a reduce: counts stand under the shared number
                                   └─► KeyNumbers of a distinct: so do marks of what was seen

An operator that uses them needs no table of its own.  When they end, it copies its keys into one.
"""

from collections.abc import Callable, Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.key_tables import Column, Growing, Hashes, KeyTable, Numbers, Store, take
from apps.sonata_adapter.query.expressions import Kind

_KNOWN: Final = 1 << 16
_ROOM: Final = 1 << 14
"""Initial room, in keys: keys in their own slot are found faster."""
_TRIAL: Final = 1 << 14
"""Rows after which it is decided whether keys recur."""
_NEW_SHARE: Final = 3
"""If more than one row in this many has a new key, numbers are not worthwhile."""
_PAUSE: Final = 32 * _TRIAL
"""Rows for which numbering is then paused."""
_FIRST_SHARE: Final = 8
_LEAST_LIMIT: Final = 4 * _KNOWN
"""Operators with a lower limit use their own keys: shared ones would take too much of their room."""

Values = Callable[[NDArray[np.intp]], Column]
"""The values of the keys of some rows."""


class KnownKeys:
    """Keys by number, and the values that they stand for."""

    def __init__(self, kind: Kind) -> None:
        self._table = KeyTable(_KNOWN, _ROOM)
        self._keys = Growing(np.uint64)
        self._store = Store((kind,))

    @property
    def size(self) -> int:
        return self._table.size

    @property
    def full(self) -> bool:
        return self._table.size >= _KNOWN

    @property
    def keys(self) -> Hashes:
        return self._keys.data

    def columns(self) -> list[Column]:
        """The values, by number."""
        return self._store.columns()

    def number(self, keys: Hashes, values: Values) -> Numbers:
        """The keys' numbers, -1 for those beyond the bound."""
        begin = 0 if self.size else len(keys) // _FIRST_SHARE
        if begin:  # a few first: most other rows have the same keys
            _, first = self._table.number(keys[:begin])
            self._learn(keys, first, values)
        numbers, first = self._table.number(keys)
        self._learn(keys, first, values)
        return numbers

    def _learn(self, keys: Hashes, first: NDArray[np.intp], values: Values) -> None:
        if len(first):
            self._keys.append(keys[first])
            self._store.append([values(first)])


class NumberedKeys:
    """The numbers of some rows' keys."""

    def __init__(self, known: KnownKeys, numbers: Numbers) -> None:
        self.known = known
        self.numbers = numbers

    def at(self, rows: "NDArray[np.intp] | slice") -> "NumberedKeys":
        """Those of some of the rows."""
        return NumberedKeys(self.known, self.numbers[rows])


class KeyDictionary:
    """Numbers of at most 65,536 keys, across batches and windows; starts again when all are taken.

    It pauses while most keys occur only once.
    """

    def __init__(self, kind: Kind) -> None:
        self._kind = kind
        self._known = KnownKeys(kind)
        self.often = False
        """Numbers of all packets of a batch were asked for: most likely they will be in the next one."""
        self._pause = 0
        self._asked = 0
        self._new = 0

    def number(self, keys: Hashes, values: Values) -> NumberedKeys | None:
        """The keys' numbers; None: the operator has to look them up itself."""
        if self._pause > 0:
            self._pause -= len(keys)
            return None
        known, before = self._known, self._known.size
        numbers = known.number(keys, values)
        self._judge(len(keys), known.size - before)
        if not known.full:
            return NumberedKeys(known, numbers)
        self._known = KnownKeys(self._kind)
        return None

    def _judge(self, rows: int, new: int) -> None:
        self._asked += rows
        self._new += new
        if self._asked >= _TRIAL:
            if self._new * _NEW_SHARE > self._asked:
                self._pause = _PAUSE
            self._asked = self._new = 0


class KeyNumbers:
    """An operator's numbers for keys: the shared ones while there are any, then its own, which go on from them.

    At most `limit` keys have numbers.
    """

    def __init__(self, kinds: Iterable[Kind], limit: int, expected: int) -> None:
        self._limit = limit
        self._expected = expected
        self._known: KnownKeys | None = None
        self._table: KeyTable | None = None
        self._kinds = tuple(kinds)
        self._store: Store | None = None

    @property
    def size(self) -> int:
        """How many numbers there are; some may stand for keys that only others had."""
        held = self._table or self._known
        return 0 if held is None else held.size

    @property
    def full(self) -> bool:
        """Whether some keys may have no number."""
        return self._table is not None and self._table.size >= self._limit

    def share(self, numbered: NumberedKeys | None) -> Numbers | None:
        """The shared numbers; None: this operator uses its own from now on."""
        if self._table is None and numbered is not None and self._limit >= _LEAST_LIMIT:
            if self._known is None:
                self._known = numbered.known
            if self._known is numbered.known:
                return numbered.numbers
        return None

    def number(self, keys: Hashes, columns: Callable[[NDArray[np.intp]], list[Column]]) -> Numbers:
        """Own numbers, -1 beyond the limit."""
        if self._table is None or self._store is None:
            self._table, self._store = self._settled()
        numbers, first = self._table.number(keys)
        if len(first):
            self._store.append(columns(first))
        return numbers

    def _settled(self) -> tuple[KeyTable, Store]:
        known, self._known = self._known, None
        store = Store(self._kinds)
        if known is None:
            return KeyTable(self._limit, self._expected), store
        table = KeyTable(self._limit, max(self._expected, known.size))
        table.number(known.keys)
        store.append(known.columns())
        return table, store

    def columns(self, numbers: Numbers) -> list[Column]:
        """The values of the keys with these numbers."""
        held = self._known or self._store or Store(self._kinds)
        return [take(column, numbers) for column in held.columns()]
