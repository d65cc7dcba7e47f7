"""Steps over whole tables at a window's end: filter, map, distinct, reduce and join."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.columns import Tuples
from apps.sonata_adapter.host.evaluation import TupleRows, column_of, evaluate
from apps.sonata_adapter.host.key_tables import Column, Hashes, hashes, take
from apps.sonata_adapter.query.dataflow import Node, TableJoin, TableStep, WindowTable
from apps.sonata_adapter.query.language import Distinct, Filter, JoinKind, Map, Reduce

_MISSING: Final = -1
_NO_ROWS: Final = np.empty(0, dtype=np.intp)


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
            case Filter() | Distinct() if not self.size:
                return self
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
        if not self.size:
            return Relation({**{key: self.columns[key] for key in step.keys}, step.name: (_NO_ROWS,)}, 0)
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
        if not self.size and kind != "outer":
            more = {} if kind == "anti" else other.take(_NO_ROWS).columns
            return Relation({**self.columns, **{n: c for n, c in more.items() if n not in keys}}, 0)
        mine, theirs = self.hashes(keys), other.hashes(keys)
        order = np.argsort(theirs, kind="stable")
        ordered = theirs[order]
        begin = np.searchsorted(ordered, mine, side="left")
        matches = _matches(ordered, mine, begin)
        if kind == "anti":
            return self.take(np.flatnonzero(matches == 0))
        rows, partners = _pairs(order, begin, matches, alone=kind != "inner")
        if kind != "outer":
            return self._paired(other, keys, rows, partners)
        unmatched = np.ones(other.size, dtype=np.bool_)
        unmatched[partners[partners != _MISSING]] = False
        rest = np.flatnonzero(unmatched)
        rows = np.concatenate((rows, np.full(len(rest), _MISSING)))
        return self._paired(other, keys, rows, np.concatenate((partners, rest)))

    def _paired(
        self, other: "Relation", keys: tuple[str, ...], rows: NDArray[np.intp], partners: NDArray[np.intp]
    ) -> "Relation":
        there = rows != _MISSING
        whole = bool(there.all())
        made: dict[str, Column] = {}
        for name, column in self.columns.items():
            if whole:
                made[name] = take(column, rows)
            elif name in keys:
                theirs = _picked(other.columns[name], partners)
                pairs = zip(_picked(column, rows), theirs, strict=True)
                made[name] = tuple(np.where(there, left, right) for left, right in pairs)
            else:
                made[name] = _picked(column, rows)
        for name, column in other.columns.items():
            if name not in keys:
                made[name] = _picked(column, partners)
        return Relation(made, len(rows))


def _pairs(
    order: NDArray[np.intp], begin: NDArray[np.intp], matches: NDArray[np.intp], *, alone: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of this side with those of the other that match; `alone`: also those that have no match."""
    counts = np.maximum(matches, 1) if alone else matches
    if (counts == 1).all():
        rows = np.arange(len(counts))
        places = begin
    else:
        rows = np.repeat(np.arange(len(counts)), counts)
        places = begin[rows] + np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    partners = np.full(len(rows), _MISSING, dtype=np.intp)
    has = matches[rows] > 0
    partners[has] = order[places[has]]
    return rows, partners


def _matches(ordered: Hashes, wanted: Hashes, begin: NDArray[np.intp]) -> NDArray[np.intp]:
    """How often each key stands among the ordered ones, from `begin` on."""
    if not len(ordered) or (ordered[1:] == ordered[:-1]).any():
        counts: NDArray[np.intp] = np.searchsorted(ordered, wanted, side="right") - begin
        return counts
    found = ordered[np.minimum(begin, len(ordered) - 1)] == wanted
    return np.where(found, 1, 0)


def _picked(column: Column, rows: NDArray[np.intp]) -> Column:
    """Rows of a column, 0 where the row is missing."""
    there = rows != _MISSING
    found = []
    for part in column:
        picked = np.zeros(len(rows), dtype=part.dtype)
        picked[there] = part[rows[there]]
        found.append(picked)
    return tuple(found)


def relation_of(table: WindowTable, held: Callable[[Node], Tuples]) -> Relation:
    """A table after all its steps, where `held` gives what a node holds."""
    rows: TupleRows = held(table.node)
    for condition in table.filters:
        rows = rows.where(condition)
    relation = Relation({name: column_of(value, rows) for name, value in table.names}, len(rows))
    for step in table.steps:
        other = relation_of(step.other, held) if isinstance(step, TableJoin) else None
        relation = relation.apply(step, other)
    return relation
