"""Hash tables for the state of operators: keys of 64 bits to dense numbers, a whole batch at a time.

A key's 64 bits are mixed from its columns with constants drawn when the process starts, so that
nobody outside can aim at collisions: two of a million keys of a window fall together with a chance
of 3 in 10^8.
"""

import secrets
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.expressions import Kind

Numbers = NDArray[np.int64]
Hashes = NDArray[np.uint64]
Part = NDArray[Any]
Column = tuple[Part, ...]
"""A column of tuples: one array of int64, or two of uint64 for the halves of an address."""

_DTYPES: Final = {"address": (np.uint64, np.uint64), "name": (np.uint64,)}
_SMALL: Final = 1 << 10
_ROOMY: Final = 1 << 16
_ODD: Final = np.array([secrets.randbits(64) | 1 for _ in range(24)], dtype=np.uint64)
_SHIFT: Final = np.uint64(29)
_FINAL: Final = np.uint64(0x9E3779B97F4A7C15)
_UNSEEN: Final = np.uint64(0)
_ZEROS: Final = np.broadcast_to(_UNSEEN, (1 << 40,))


def is_constant(part: Part) -> bool:
    """Whether all rows hold the same zero, as the upper halves of IPv4 addresses do."""
    return part.strides == (0,)


def zeros(rows: int) -> NDArray[np.uint64]:
    """A column of zeros that takes no memory."""
    return _ZEROS[:rows]


def take(column: Column, rows: NDArray[np.intp]) -> Column:
    """Some rows of a column."""
    return tuple(zeros(len(rows)) if is_constant(part) else part[rows] for part in column)


def hashes(columns: list[Column], rows: int) -> Hashes:
    """64 bits for each row, never 0; equal for equal rows, whatever batch they stand in."""
    mixed = np.full(rows, _ODD[-1], dtype=np.uint64)
    place = 0
    for column in columns:
        for part in column:
            odd = _ODD[place % (len(_ODD) - 1)]
            place += 1
            if is_constant(part):
                continue
            # 0 adds nothing: a constant part and one that is 0 in this batch give the same
            mixed += part.view(np.uint64) * odd ^ (part.view(np.uint64) >> _SHIFT) * (
                odd ^ _FINAL | np.uint64(1)
            )
    mixed ^= mixed >> _SHIFT
    mixed *= _FINAL
    mixed ^= mixed >> np.uint64(32)
    mixed[mixed == _UNSEEN] = np.uint64(1)
    return mixed


class KeyTable:
    """Keys in the order in which they were first seen; bounded.

    `limit` is how many keys are kept; what comes after gets the number -1.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.size = 0
        self._slots = np.zeros(_SMALL, dtype=np.uint64)
        self._numbers = np.zeros(_SMALL, dtype=np.int64)

    def number(self, keys: Hashes) -> tuple[Numbers, NDArray[np.intp]]:
        """For each key its number, and the rows in which new keys stand first, in order."""
        before = self.size
        self._reserve(min(before + len(keys), self._limit))
        mask = len(self._slots) - 1
        place = (keys & np.uint64(mask)).view(np.int64)
        rest = np.flatnonzero(self._slots[place] != keys)
        claimed: list[NDArray[np.intp]] = []
        while len(rest):
            rest, taken = self._claim(keys, place, rest, claimed)
            place[rest] = (place[rest] + taken) & mask
        fresh = np.sort(np.concatenate(claimed)) if claimed else rest
        self._numbers[place[fresh]] = np.arange(before, before + len(fresh))
        numbers = self._numbers[place]
        numbers[place < 0] = -1
        return numbers, fresh

    def _claim(
        self, keys: Hashes, place: Numbers, rest: NDArray[np.intp], claimed: list[NDArray[np.intp]]
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Give empty slots to keys; returns the rows that are left, and whether another has their slot."""
        slots, wanted = place[rest], keys[rest]
        found = self._slots[slots]
        empty = np.flatnonzero(found == _UNSEEN)[: self._limit - self.size]
        if len(empty):
            # written backwards, so that of equal or competing keys the first row wins
            backwards = empty[::-1]
            self._slots[slots[backwards]] = wanted[backwards]
            self._numbers[slots[backwards]] = backwards
            won = empty[self._numbers[slots[empty]] == empty]
            claimed.append(rest[won])
            self.size += len(won)
            found = self._slots[slots]
        left = found != wanted
        taken = found != _UNSEEN
        if self.size >= self._limit:
            place[rest[~taken]] = -1
            left &= taken
        return rest[left], taken[left]

    def _reserve(self, keys: int) -> None:
        """Room for this many keys: a quarter full while that is cheap, then half full."""
        size = len(self._slots)
        while size < (4 if keys <= _ROOMY else 2) * keys:
            size *= 2
        if size == len(self._slots):
            return
        held = np.flatnonzero(self._slots)
        old_keys, old_numbers = self._slots[held], self._numbers[held]
        self._slots = np.zeros(size, dtype=np.uint64)
        self._numbers = np.zeros(size, dtype=np.int64)
        mask = np.uint64(size - 1)
        slot = (old_keys & mask).astype(np.int64)
        while len(old_keys):
            free = self._slots[slot] == _UNSEEN
            self._slots[slot[free]] = old_keys[free]
            self._numbers[slot[free]] = old_numbers[free]
            left = self._slots[slot] != old_keys
            old_keys, old_numbers, slot = old_keys[left], old_numbers[left], (slot[left] + 1) & (size - 1)


class Growing:
    """An array that grows at its end."""

    def __init__(self, dtype: Any) -> None:
        self._data = np.zeros(_SMALL, dtype=dtype)
        self.size = 0

    @property
    def data(self) -> NDArray[Any]:
        """What is in it: a view that later growth may leave behind."""
        return self._data[: self.size]

    def extend(self, size: int) -> None:
        """Make it at least this long, with zeros."""
        if size > len(self._data):
            data = np.zeros(max(size, 2 * len(self._data)), dtype=self._data.dtype)
            data[: self.size] = self._data[: self.size]
            self._data = data
        self.size = max(self.size, size)

    def append(self, values: NDArray[Any]) -> None:
        start = self.size
        self.extend(start + len(values))
        self._data[start : self.size] = values


class Store:
    """Tuples by number: what the keys of a `KeyTable` stand for."""

    def __init__(self, kinds: Iterable[Kind]) -> None:
        self._columns = [[Growing(dtype) for dtype in _DTYPES.get(kind, (np.int64,))] for kind in kinds]

    def append(self, columns: list[Column]) -> None:
        for held, column in zip(self._columns, columns, strict=True):
            for growing, part in zip(held, column, strict=True):
                growing.append(part)

    def columns(self) -> list[Column]:
        """All tuples, oldest first."""
        return [tuple(growing.data for growing in held) for held in self._columns]
