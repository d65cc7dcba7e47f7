"""The operators that keep state in a window: distinct and reduce over batches, memory bounded.

Each holds at most `limit` keys exactly.  What comes after goes through a sketch (Bloom filter for
distinct, Count-Min for reduce), and `error` says so.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.columns import NO_TUPLES, Tuples
from apps.sonata_adapter.dataflow import VALUE, DistinctNode, ReduceNode, kinds_of
from apps.sonata_adapter.evaluation import Rows, evaluate
from apps.sonata_adapter.expressions import Expression, Number
from apps.sonata_adapter.numbering import Translation
from apps.sonata_adapter.sketches import Bloom, CountMin
from apps.sonata_adapter.tables import Growing, Hashes, KeyTable, Numbers, Store

_NO_ROWS: Final = np.empty(0, dtype=np.int64)


def filtered(rows: Rows, filters: tuple[Expression, ...]) -> Rows:
    """Rows for which all conditions hold."""
    for condition in filters:
        rows = rows.where(condition)
    return rows


class DistinctOperator:
    """Lets the first of equal tuples pass."""

    def __init__(self, node: DistinctNode, limit: int, expected: int = 0) -> None:
        self._node = node
        kinds = kinds_of(node)
        self._names = list(kinds)
        self._table = KeyTable(limit, expected)
        self._store = Store(kinds.values())
        self._limit = limit
        self._bloom: Bloom | None = None
        self.beyond = 0

    def take(self, rows: Rows) -> Tuples:
        """The new tuples."""
        rows = filtered(rows, self._node.filters)
        if not len(rows):
            return NO_TUPLES
        keys = rows.keys(self._node.values)
        numbers, first = self._table.number(keys)
        fresh = rows.columns_at(self._node.values, first)
        if len(first):
            self._store.append(fresh)
        unplaced = np.flatnonzero(numbers < 0) if self._table.size >= self._limit else _NO_ROWS
        if len(unplaced):
            first = np.sort(np.concatenate((first, self._beyond(keys, unplaced))))
            fresh = rows.columns_at(self._node.values, first)
        made = dict(zip(self._names, fresh, strict=True))
        return Tuples(made, len(first), rows.origin[first])

    @property
    def size(self) -> int:
        """Tuples that are held."""
        return self._table.size

    def _beyond(self, keys: Hashes, unplaced: NDArray[np.intp]) -> NDArray[np.intp]:
        if self._bloom is None:
            self._bloom = Bloom(self._limit)
        new = unplaced[self._bloom.add(keys[unplaced])]
        self.beyond += len(new)
        return new

    def table(self) -> Tuples:
        """All tuples that are held exactly."""
        return Tuples(dict(zip(self._names, self._store.columns(), strict=True)), self._table.size)

    @property
    def error(self) -> str:
        if self._bloom is None:
            return ""
        share = self._bloom.missed_share
        return f"distinct: {self.beyond} tuples beyond the bound of {self._limit}, up to {share:.2%} of these missed"


class ReduceOperator:
    """Sum or maximum for each key."""

    def __init__(self, node: ReduceNode, limit: int, expected: int = 0) -> None:
        self._node = node
        kinds = kinds_of(node)
        del kinds[VALUE]
        self._names = list(kinds)
        self._table = KeyTable(limit, expected)
        self._store = Store(kinds.values())
        self._limit = limit
        self._values = Growing(np.int64)
        self._translation = Translation()
        self._sketch: CountMin | None = None
        self.beyond = 0

    def take(self, rows: Rows) -> "Update":
        """Count the rows in."""
        rows = filtered(rows, self._node.filters)
        if not len(rows):
            return Update(self, rows, _NO_ROWS)
        numbers = self._number(rows)
        unplaced = np.flatnonzero(numbers < 0) if self._table.size >= self._limit else _NO_ROWS
        if not len(unplaced):
            self._add(numbers, rows)
            return Update(self, rows, numbers)
        placed = np.flatnonzero(numbers >= 0)
        amounts = self.amounts(rows)
        self._add_at(numbers[placed], amounts[placed])
        estimates = self._beyond(rows.keys_at(self._node.keys, unplaced), amounts[unplaced])
        return Update(self, rows, numbers, unplaced=unplaced, estimates=estimates)

    def _number(self, rows: Rows) -> Numbers:
        """The number of each row's key, -1 beyond the bound."""
        numbered = rows.numbered(self._node.keys)
        if numbered is None:
            numbers, first = self._table.number(rows.keys(self._node.keys))
            self._keep(rows, first)
            return numbers
        numbers = self._translation.own(numbered)
        rest = (numbers < 0).nonzero()[0]
        if len(rest):
            numbers[rest], first = self._table.number(rows.keys_at(self._node.keys, rest))
            self._translation.learn(numbered.numbers[rest], numbers[rest])
            self._keep(rows, rest[first])
        return numbers

    def _keep(self, rows: Rows, first: NDArray[np.intp]) -> None:
        if len(first):
            self._store.append(rows.columns_at(self._node.keys, first))
            self._values.extend(self._table.size)

    def _add(self, numbers: Numbers, rows: Rows) -> None:
        data, value = self._values.data, self._node.value
        if isinstance(value, Number) and self._node.function == "sum" and len(numbers) > len(data):
            data += np.bincount(numbers, minlength=len(data)) * value.value
        else:
            self._add_at(numbers, self.amounts(rows))

    def _add_at(self, numbers: Numbers, amounts: Numbers) -> None:
        (np.add if self._node.function == "sum" else np.maximum).at(self._values.data, numbers, amounts)

    def _beyond(self, keys: Hashes, amounts: Numbers) -> Numbers:
        if self._sketch is None:
            self._sketch = CountMin(self._limit)
        self.beyond += len(keys)
        return self._sketch.add(keys, amounts)

    @property
    def values(self) -> Numbers:
        """By number of the key."""
        return self._values.data

    @property
    def size(self) -> int:
        """Keys that are held."""
        return self._table.size

    def amounts(self, rows: Rows) -> Numbers:
        """What each row adds."""
        return evaluate(self._node.value, rows)

    @property
    def names(self) -> list[str]:
        return self._names

    @property
    def keys(self) -> tuple[Expression, ...]:
        return self._node.keys

    def table(self) -> Tuples:
        """Keys and values that are held exactly."""
        made = dict(zip(self._names, self._store.columns(), strict=True))
        return Tuples({**made, VALUE: (self.values.copy(),)}, self._table.size)

    @property
    def error(self) -> str:
        if self._sketch is None:
            return ""
        return (
            f"reduce: {self.beyond} tuples of keys beyond the bound of {self._limit}, "
            f"their counts too large by up to {self._sketch.excess}"
        )


class Update:
    """What one batch did to a reduce."""

    def __init__(
        self,
        operator: ReduceOperator,
        rows: Rows,
        numbers: Numbers,
        *,
        unplaced: NDArray[np.intp] = _NO_ROWS,
        estimates: Numbers = _NO_ROWS,
    ) -> None:
        self._operator = operator
        self._rows = rows
        self._numbers = numbers
        self._unplaced = unplaced
        self._estimates = estimates

    def crossed(self, threshold: int, reported: "Reported") -> "Crossed":
        """Rows in which keys reach the threshold, not reported before; marks them as reported."""
        if not len(self._numbers):
            return _NOTHING
        done = reported.flags(len(self._operator.values))
        over = (self._operator.values >= threshold) & ~done
        if not len(self._unplaced) and not over[self._numbers].any():
            return _NOTHING
        numbers = self._numbers
        placed = np.flatnonzero(numbers >= 0) if len(self._unplaced) else np.arange(len(numbers))
        candidates = placed[np.flatnonzero(over[numbers[placed]])]
        rows, values = self._first_over(candidates, threshold)
        done[numbers[rows]] = True
        exact = np.ones(len(rows), dtype=np.bool_)
        if len(self._unplaced):
            more = np.flatnonzero(self._estimates >= threshold)
            keys = self._rows.keys_at(self._operator.keys, self._unplaced[more])
            more = more[reported.first(keys)]
            rows = np.concatenate((rows, self._unplaced[more]))
            values = np.concatenate((values, self._estimates[more]))
            exact = np.concatenate((exact, np.zeros(len(more), dtype=np.bool_)))
        order = np.argsort(rows, kind="stable")
        return self._report(rows[order], values[order], exact[order])

    def _first_over(self, candidates: NDArray[np.intp], threshold: int) -> tuple[NDArray[np.intp], Numbers]:
        """For the keys of these rows (all their rows of the batch): the row that crosses, and the value then."""
        if not len(candidates):
            return candidates, _NO_ROWS
        order = candidates[np.argsort(self._numbers[candidates], kind="stable")]
        numbers, amounts = self._numbers[order], self._operator.amounts(self._rows)[order]
        begins = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
        sizes = np.diff(begins, append=len(numbers))
        sums = np.add.reduceat(amounts, begins)
        before = self._operator.values[numbers[begins]] - sums
        running = np.cumsum(amounts)
        running += np.repeat(before - (running[begins] - amounts[begins]), sizes)
        over = np.flatnonzero(running >= threshold)
        first = np.flatnonzero(np.diff(numbers[over], prepend=-1))
        return order[over[first]], running[over[first]]

    def _report(self, rows: NDArray[np.intp], values: Numbers, exact: NDArray[np.bool_]) -> "Crossed":
        columns = self._rows.columns_at(self._operator.keys, rows)
        made = dict(zip(self._operator.names, columns, strict=True))
        return Crossed(Tuples({**made, VALUE: (values,)}, len(rows), self._rows.origin[rows]), exact)


class Crossed:
    """Keys that reached a threshold, in the order of their packets, and which counts are exact."""

    def __init__(self, tuples: Tuples, exact: NDArray[np.bool_]) -> None:
        self.tuples = tuples
        self.exact = exact


_NOTHING: Final = Crossed(NO_TUPLES, np.empty(0, dtype=np.bool_))


class Reported:
    """Which keys of a reduce a query has reported in this window."""

    def __init__(self, limit: int) -> None:
        self._flags = Growing(np.bool_)
        self._beyond = KeyTable(limit)

    def flags(self, size: int) -> NDArray[np.bool_]:
        """By number of the key, writable."""
        self._flags.extend(size)
        return self._flags.data

    def first(self, keys: Hashes) -> NDArray[np.intp]:
        """Rows of keys beyond the bound that were not reported before."""
        return self._beyond.number(keys)[1]
