"""Hash tables for the state of operators: keys of 64 bits to dense numbers, a whole batch at a time.

A key's 64 bits are mixed from its columns with constants drawn when the process starts, so that
an attacker cannot provoke collisions: two of a million keys of a window collide with a probability
of 3 in 10^8.
"""

import secrets
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.query.expressions import Kind

Numbers = NDArray[np.int64]
Hashes = NDArray[np.uint64]
Part = NDArray[Any]
Column = tuple[Part, ...]
"""A column of tuples: one array of int64, or two of uint64 for the halves of an address."""

_DTYPES: Final = {"address": (np.uint64, np.uint64), "name": (np.uint64,)}
_SMALL: Final = 1 << 10
_ROOMY: Final = 1 << 16
_FEW: Final = 12
"""Up to this many rows, placing them one by one is faster than as a batch."""
_ODD: Final = np.array([secrets.randbits(64) | 1 for _ in range(24)], dtype=np.uint64)
_PARTS: Final = 2
"""Most parts of a column."""
_SHIFT: Final = np.uint64(29)
_HALF: Final = np.uint64(32)
_LEAST: Final = np.uint64(1)
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


def mixed(column: Column) -> Hashes:
    """64 bits for each value of a column, equal for equal values, whatever batch and place they stand in."""
    found: Hashes | None = None
    for part, odd in zip(column, _ODD, strict=False):
        # 0 adds nothing: a constant part and one that is 0 in this batch give the same
        if is_constant(part):
            continue
        bits = part.view(np.uint64) * odd
        bits ^= bits >> _HALF
        found = bits if found is None else found + bits
    return zeros(len(column[0])) if found is None else found


def combined(terms: Sequence[Hashes], rows: int) -> Hashes:
    """64 bits for each row, never 0, of what `mixed` gave for its columns."""
    if not terms:
        return np.ones(rows, dtype=np.uint64)
    bits: Hashes = terms[0] * _ODD[_PARTS]
    spare = np.empty_like(bits)
    for place, term in enumerate(terms[1:], 1):
        bits += np.multiply(term, _ODD[_PARTS + place % (len(_ODD) - _PARTS)], out=spare)
    bits ^= np.right_shift(bits, _SHIFT, out=spare)
    bits *= _FINAL
    bits ^= np.right_shift(bits, _HALF, out=spare)
    return np.maximum(bits, _LEAST, out=bits)


def hashes(columns: list[Column], rows: int) -> Hashes:
    """64 bits for each row, never 0; equal for equal rows, whatever batch they stand in."""
    return combined([mixed(column) for column in columns], rows)


def alike(keys: Hashes, slots: int) -> NDArray[np.intp]:
    """For each row the first with the same key.

    Keys that meet in one of the slots (a power of two) may be taken for different from themselves: a row
    then stands for itself.
    """
    home = (keys & np.uint64(slots - 1)).view(np.int64)
    rows = np.arange(len(keys))
    first = np.empty(slots, dtype=np.int64)
    first[home[::-1]] = rows[::-1]
    found = first[home]
    return np.where(keys[found] == keys, found, rows)


class KeyTable:
    """Keys in the order in which they were first seen; bounded.

    `limit` is the number of keys kept; further keys get the number -1.
    """

    def __init__(self, limit: int, expected: int = 0) -> None:
        self._limit = limit
        self.size = 0
        slots = _slots_for(min(expected, limit), _SMALL)
        self._slots = np.zeros(slots, dtype=np.uint64)
        self._numbers = np.zeros(slots, dtype=np.int64)

    def number(self, keys: Hashes) -> tuple[Numbers, NDArray[np.intp]]:
        """For each key its number, and the rows in which new keys stand first, in order."""
        before = self.size
        place, rest = self._look_up(keys)
        if not len(rest):
            return self._numbers[place], rest
        if self._reserve(min(before + len(rest), self._limit)):
            place, rest = self._look_up(keys)
        mask = len(self._slots) - 1
        claimed: list[NDArray[np.intp]] = []
        while len(rest) > _FEW:
            rest, taken = self._claim(keys, place, rest, claimed)
            place[rest] = (place[rest] + taken) & mask
        if len(rest):
            claimed.append(self._claim_each(keys, place, rest))
        fresh = np.sort(np.concatenate(claimed)) if claimed else rest
        if len(fresh):
            self._numbers[place[fresh]] = np.arange(before, before + len(fresh))
        numbers = self._numbers[place]
        if self.size >= self._limit:
            numbers[place < 0] = -1
        return numbers, fresh

    def _look_up(self, keys: Hashes) -> tuple[Numbers, NDArray[np.intp]]:
        """Each key's first slot, and the rows of keys that do not stand there."""
        place = (keys & np.uint64(len(self._slots) - 1)).view(np.int64)
        return place, (self._slots[place] != keys).nonzero()[0]

    def _claim_each(self, keys: Hashes, place: Numbers, rest: NDArray[np.intp]) -> NDArray[np.intp]:
        """Slots for the last few rows, one by one: cheaper than whole rounds; returns which were claimed."""
        mask = len(self._slots) - 1
        claimed: list[int] = []
        for row, key, first in zip(rest.tolist(), keys[rest].tolist(), place[rest].tolist(), strict=True):
            slot = first
            while (held := int(self._slots[slot])) not in (key, 0):
                slot = (slot + 1) & mask
            if held:
                place[row] = slot
            elif self.size == self._limit:
                place[row] = -1
            else:
                place[row] = slot
                self._slots[slot] = key
                self.size += 1
                claimed.append(row)
        return np.array(claimed, dtype=np.intp)

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

    def _reserve(self, keys: int) -> bool:
        """Room for this many keys: a quarter full while that is cheap, then half full; whether all moved."""
        size = _slots_for(keys, len(self._slots))
        if size == len(self._slots):
            return False
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
        return True


def _slots_for(keys: int, slots: int) -> int:
    while slots < (4 if keys <= _ROOMY else 2) * keys:
        slots *= 2
    return slots


class Growing:
    """An array that grows at its end."""

    def __init__(self, dtype: Any) -> None:
        self._data = np.zeros(_SMALL, dtype=dtype)
        self.size = 0

    @property
    def data(self) -> NDArray[Any]:
        """The content: a view, which becomes stale when the array grows."""
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
    """Tuples by number: the values behind the keys of a `KeyTable`."""

    def __init__(self, kinds: Iterable[Kind]) -> None:
        self._columns = [[Growing(dtype) for dtype in _DTYPES.get(kind, (np.int64,))] for kind in kinds]

    def append(self, columns: list[Column]) -> None:
        for held, column in zip(self._columns, columns, strict=True):
            for growing, part in zip(held, column, strict=True):
                growing.append(part)

    def columns(self) -> list[Column]:
        """All tuples, oldest first."""
        return [tuple(growing.data for growing in held) for held in self._columns]
