"""The operators that keep state in a window: distinct and reduce over batches, memory bounded.

Each holds at most `limit` keys exactly.  Further keys go through a sketch (Bloom filter for
distinct, Count-Min for reduce), and `error` says so.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.columns import NO_TUPLES, Tuples
from apps.sonata_adapter.host.evaluation import TupleRows, evaluate
from apps.sonata_adapter.host.key_dictionary import KeyNumbers
from apps.sonata_adapter.host.key_tables import Growing, Hashes, KeyTable, Numbers, Store
from apps.sonata_adapter.host.sketches import Bloom, CountMin
from apps.sonata_adapter.query.dataflow import VALUE, DistinctNode, ReduceNode, kinds_of
from apps.sonata_adapter.query.expressions import Expression, Number
from apps.sonata_adapter.results import TOO_LARGE

_NO_ROWS: Final = np.empty(0, dtype=np.int64)
_BUSY: Final = 8
"""With at least one row per this many keys, a batch is added up in one pass."""


def filtered(rows: TupleRows, filters: tuple[Expression, ...]) -> TupleRows:
    """Rows for which all conditions hold."""
    for condition in filters:
        rows = rows.where(condition)
    return rows


class DistinctOperator:
    """Passes on the first of equal tuples."""

    def __init__(self, node: DistinctNode, limit: int, expected: int = 0) -> None:
        self._node = node
        kinds = kinds_of(node)
        self._names = dict(zip(kinds, node.values, strict=True))
        self._kinds = tuple(kinds.values())
        self._table = KeyTable(limit, expected)
        self._store: Store | None = None
        self._stored = 0
        self.kept = False
        """Whether the table is needed; only then are the tuples held besides their keys."""
        self._limit = limit
        self._bloom: Bloom | None = None
        self.beyond = 0

    def take(self, rows: TupleRows) -> TupleRows:
        """The new tuples."""
        rows = filtered(rows, self._node.filters)
        if not len(rows):
            return NO_TUPLES
        keys = rows.keys(self._node.values)
        numbers, first = self._table.number(keys)
        fresh = rows.tuples(self._names, first)
        if self.kept and len(first):
            self._store = self._store or Store(self._kinds)
            self._store.append([fresh.column(name) for name in self._names])
            self._stored += len(first)
        unplaced = np.flatnonzero(numbers < 0) if self._table.size >= self._limit else _NO_ROWS
        if len(unplaced):
            first = np.sort(np.concatenate((first, self._beyond(keys, unplaced))))
            fresh = rows.tuples(self._names, first)
        return fresh

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
        """All tuples that are held exactly, since they are `kept`."""
        columns = (self._store or Store(self._kinds)).columns()
        return Tuples(dict(zip(self._names, columns, strict=True)), self._stored)

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
        self._keys = KeyNumbers(kinds.values(), limit, expected)
        self._limit = limit
        self._values = Growing(np.int64)
        value = node.value
        self._each = value.value if isinstance(value, Number) and node.function == "sum" else 0
        """The amount that every row adds; 0 if it differs."""
        self._seen = Growing(np.bool_)
        """By number, which keys are held, if their values do not show it."""
        self._sketch: CountMin | None = None
        self.beyond = 0

    def take(self, rows: TupleRows) -> "Update":
        """Count the rows in."""
        rows = filtered(rows, self._node.filters)
        if not len(rows):
            return Update(self, rows, _NO_ROWS)
        numbers = self._number(rows)
        self._values.extend(self._keys.size)
        unplaced = np.flatnonzero(numbers < 0) if self._keys.full else _NO_ROWS
        if not len(unplaced):
            self._add(numbers, rows)
            return Update(self, rows, numbers)
        placed = np.flatnonzero(numbers >= 0)
        amounts = self.amounts(rows)
        self._add_at(numbers[placed], amounts[placed])
        estimates = self._beyond(rows.keys_at(self._node.keys, unplaced), amounts[unplaced])
        return Update(self, rows, numbers, unplaced=unplaced, estimates=estimates)

    def _number(self, rows: TupleRows) -> Numbers:
        """The number of each row's key, -1 beyond the bound."""
        keys = self._node.keys
        if len(keys) == 1:  # combinations of two columns recur less often
            shared = self._keys.share(rows.numbered(keys[0]))
            if shared is not None:
                return shared
        return self._keys.number(rows.keys(keys), lambda first: rows.columns_at(keys, first))

    def _add(self, numbers: Numbers, rows: TupleRows) -> None:
        data = self._values.data
        if self._each and _BUSY * len(numbers) > len(data):
            data += np.bincount(numbers, minlength=len(data)) * self._each
        else:
            self._add_at(numbers, self.amounts(rows))

    def _add_at(self, numbers: Numbers, amounts: Numbers) -> None:
        (np.add if self._node.function == "sum" else np.maximum).at(self._values.data, numbers, amounts)
        if not self._each:
            self._seen.extend(self._keys.size)
            self._seen.data[numbers] = True

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
        return int(np.count_nonzero(self._marks))

    @property
    def _marks(self) -> NDArray[Any]:
        return self._values.data if self._each else self._seen.data

    def amounts(self, rows: TupleRows) -> Numbers:
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
        held = np.flatnonzero(self._marks)
        made = dict(zip(self._names, self._keys.columns(held), strict=True))
        return Tuples({**made, VALUE: (self.values[held],)}, len(held))

    @property
    def error(self) -> str:
        if self._sketch is None:
            return ""
        return (
            f"reduce: {self.beyond} tuples of keys beyond the bound of {self._limit}, "
            f"their {TOO_LARGE} {self._sketch.excess}"
        )


class Update:
    """The effect of one batch on a reduce."""

    def __init__(
        self,
        operator: ReduceOperator,
        rows: TupleRows,
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
        values = self._operator.values
        few = values if len(self._numbers) >= len(values) else values[self._numbers]
        if not len(self._unplaced) and not (few >= threshold).any():
            return _NOTHING
        done = reported.flags(len(values))
        over = (values >= threshold) & ~done
        if not len(self._unplaced) and not over.any():
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

    def __init__(self, tuples: TupleRows, exact: NDArray[np.bool_]) -> None:
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
