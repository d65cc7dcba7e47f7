"""Steps over whole tables at a window's end: filter, map, distinct, reduce and join."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.columns import Tuples
from apps.sonata_adapter.dataflow import Node, Table, TableJoin, TableStep
from apps.sonata_adapter.evaluation import Rows, column_of, evaluate
from apps.sonata_adapter.query import Distinct, Filter, JoinKind, Map, Reduce
from apps.sonata_adapter.tables import Column, Hashes, hashes, take

_MISSING: Final = -1


class Relation:
    """A table under the names of a query."""

    def __init__(self, columns: dict[str, Column], size: int) -> None:
        self.columns = columns
        self.size = size

    @property
    def tuples(self) -> Tuples:
        return Tuples(self.columns, self.size)

    def take(self, rows: NDArray[np.intp]) -> "Relation":
        return Relation({name: take(column, rows) for name, column in self.columns.items()}, len(rows))

    def hashes(self, names: tuple[str, ...]) -> Hashes:
        return hashes([self.columns[name] for name in names], self.size)

    def apply(self, step: TableStep, other: "Relation | None" = None) -> "Relation":
        """The table after a step; `other` is the other side of a join."""
        match step:
            case Filter(condition):
                return self.take(np.flatnonzero(evaluate(condition, self.tuples)))
            case Map(fields):
                tuples = self.tuples
                return Relation({name: column_of(value, tuples) for name, value in fields}, self.size)
            case Distinct():
                _, first = np.unique(self.hashes(tuple(self.columns)), return_index=True)
                return self.take(np.sort(first))
            case Reduce():
                return self._reduce(step)
            case _:
                assert other is not None  # noqa: S101 - a join has another side
                return self._join(other, step.keys, step.kind)

    def _reduce(self, step: Reduce) -> "Relation":
        _, first, group = np.unique(self.hashes(step.keys), return_index=True, return_inverse=True)
        amounts = evaluate(step.value, self.tuples)
        if step.function == "sum":
            values = np.zeros(len(first), dtype=np.int64)
            np.add.at(values, group, amounts)
        else:
            values = np.full(len(first), np.iinfo(np.int64).min)
            np.maximum.at(values, group, amounts)
        made = {key: take(self.columns[key], first) for key in step.keys}
        return Relation({**made, step.name: (values,)}, len(first))

    def _join(self, other: "Relation", keys: tuple[str, ...], kind: JoinKind) -> "Relation":
        mine, theirs = self.hashes(keys), other.hashes(keys)
        order = np.argsort(theirs, kind="stable")
        ordered = theirs[order]
        begin = np.searchsorted(ordered, mine, side="left")
        matches = _matches(ordered, mine, begin)
        if kind == "anti":
            return self.take(np.flatnonzero(matches == 0))
        counts = matches if kind == "inner" else np.maximum(matches, 1)
        rows = np.repeat(np.arange(self.size), counts)
        nth = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        has = matches[rows] > 0
        partners = np.full(len(rows), _MISSING, dtype=np.intp)
        partners[has] = order[begin[rows[has]] + nth[has]]
        if kind == "outer":
            alone = np.ones(other.size, dtype=np.bool_)
            alone[partners[has]] = False
            unmatched = np.flatnonzero(alone)
            rows = np.concatenate((rows, np.full(len(unmatched), _MISSING)))
            partners = np.concatenate((partners, unmatched))
        return self._paired(other, keys, rows, partners)

    def _paired(
        self, other: "Relation", keys: tuple[str, ...], rows: NDArray[np.intp], partners: NDArray[np.intp]
    ) -> "Relation":
        made: dict[str, Column] = {}
        for name, column in self.columns.items():
            if name in keys:
                made[name] = _either(column, rows, other.columns[name], partners)
            else:
                made[name] = tuple(_pick(part, rows) for part in column)
        for name, column in other.columns.items():
            if name not in keys:
                made[name] = tuple(_pick(part, partners) for part in column)
        return Relation(made, len(rows))


def _matches(ordered: Hashes, wanted: Hashes, begin: NDArray[np.intp]) -> NDArray[np.intp]:
    """How often each key stands among the ordered ones, from `begin` on."""
    if not len(ordered) or (ordered[1:] == ordered[:-1]).any():
        counts: NDArray[np.intp] = np.searchsorted(ordered, wanted, side="right") - begin
        return counts
    found = ordered[np.minimum(begin, len(ordered) - 1)] == wanted
    return np.where(found, 1, 0)


def _pick(part: NDArray[Any], rows: NDArray[np.intp]) -> NDArray[Any]:
    """Rows of a column, 0 where the row is missing."""
    picked = np.zeros(len(rows), dtype=part.dtype)
    there = rows != _MISSING
    picked[there] = part[rows[there]]
    return picked


def _either(mine: Column, rows: NDArray[np.intp], theirs: Column, partners: NDArray[np.intp]) -> Column:
    return tuple(
        np.where(rows != _MISSING, _pick(left, rows), _pick(right, partners))
        for left, right in zip(mine, theirs, strict=True)
    )


def relation_of(table: Table, held: Callable[[Node], Tuples]) -> Relation:
    """A table after all its steps, where `held` gives what a node holds."""
    rows: Rows = held(table.node)
    for condition in table.filters:
        rows = rows.where(condition)
    relation = Relation({name: column_of(value, rows) for name, value in table.names}, len(rows))
    for step in table.steps:
        other = relation_of(step.other, held) if isinstance(step, TableJoin) else None
        relation = relation.apply(step, other)
    return relation
