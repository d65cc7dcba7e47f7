"""Which counted keys can become results of a query that is only decided at the window's end.

A result must meet `syns + syn_acks - acks >= 3`; counts are not negative, so one of the positive ones
is at least 2.  The switch reports keys at that count, and the host reads the others for these alone.
Conditions on one count make others stronger: with `bytes >= 500`, `bytes <= 90 * connections` needs six
connections.

Where a result is one difference of counts and nothing else, as `syns + syn_acks - acks` is, the switch can
count it in one cell, up and down: then it needs no candidates (`difference`).
"""

from collections.abc import Iterator, Mapping, Sequence

import msgspec

from apps.sonata_adapter.errors import NotPlaced
from apps.sonata_adapter.query.dataflow import VALUE, TableJoin, WindowTable, conjuncts, sources
from apps.sonata_adapter.query.expressions import BinaryOperation, Expression, Field, Number, substitute
from apps.sonata_adapter.query.language import Filter, Map

_Terms = tuple[dict[str, int], int]
"""Coefficient of each count, and the constant."""


class Difference(msgspec.Struct, frozen=True):
    """A query that reports keys whose counts, added and subtracted, come to a threshold."""

    signs: tuple[int, ...]
    """For each of `dataflow.sources` 1 or -1; the first is 1."""
    threshold: int
    """1 or more."""


def difference(table: WindowTable) -> Difference | None:
    """The table as one difference; None: it is none, or a result says more than what it comes to."""
    walk = _Walk()
    try:
        names, conditions = walk.table(table)
    except NotPlaced:
        return None
    inequalities = [_inequality(condition) for condition in conditions]
    terms = inequalities[0][0] if inequalities and inequalities[0] is not None else {}
    signs = tuple(terms.get(f"{VALUE}{place}", 0) for place in range(walk.sources))
    bounds = [each[1] for each in inequalities if each is not None and each[0] == terms]
    is_one = len(bounds) == len(inequalities) and all(sign in (1, -1) for sign in signs)
    says_more = any(_is_count(value) and _linear(value) != (terms, 0) for value in names.values())
    if not bounds or not is_one or says_more or signs[0] != 1 or max(bounds) < 1:
        return None
    return Difference(signs, max(bounds)) if _has_rows(table, signs) else None


def _has_rows(table: WindowTable, signs: tuple[int, ...]) -> bool:
    """Whether each key that one of the added counts has makes a row."""
    place = 1
    for step in table.steps:
        if not isinstance(step, TableJoin):
            continue
        kinds = ("outer",) if signs[place] > 0 else ("outer", "left")
        if len(sources(step.other)) > 1 or step.kind not in kinds:
            return False
        place += 1
    return True


def candidates(table: WindowTable) -> list[int]:
    """For each of `dataflow.sources(table)` the count at which its keys are candidates, 0 = at none.

    Every result is a candidate of at least one source.  Raises `NotPlaced` where that cannot be said.
    """
    walk = _Walk()
    _, conditions = walk.table(table)
    inequalities = [found for found in map(_inequality, conditions) if found is not None]
    least = _least(inequalities)
    best: list[int] = []
    for terms, bound in inequalities:
        found = _thresholds(terms, bound, walk.sources, least)
        if any(found) and (not best or _is_better(found, best)):
            best = found
    if not best:
        raise NotPlaced("no count of a key says early that the key may become a result")
    return best


class _Walk:
    """Follows names through the steps; the count of source n is called `#n`."""

    def __init__(self) -> None:
        self.sources = 0

    def table(self, table: WindowTable) -> tuple[dict[str, Expression], list[Expression]]:
        """Names and conditions after all steps."""
        mine = {VALUE: Field(f"{VALUE}{self.sources}")}
        self.sources += 1
        names = {name: substitute(value, mine) for name, value in table.names}
        conditions = [substitute(condition, mine) for condition in table.filters]
        for step in table.steps:
            match step:
                case Filter(condition):
                    conditions += conjuncts(substitute(condition, names))
                case Map(fields):
                    names = {name: substitute(value, names) for name, value in fields}
                case TableJoin():
                    names, more = self._join(names, step)
                    conditions += more
                case _:
                    raise NotPlaced("the switch counts before a join, not after it")
        return names, conditions

    def _join(
        self, names: Mapping[str, Expression], step: TableJoin
    ) -> tuple[dict[str, Expression], list[Expression]]:
        theirs, conditions = self.table(step.other)
        for side in (names, theirs):
            if {name for name, value in side.items() if not _is_count(value)} != set(step.keys):
                raise NotPlaced("cells can be read for whole keys only, and the join has others")
        if step.kind == "anti" or (step.kind != "inner" and conditions):
            raise NotPlaced(f"a join of kind {step.kind} needs all keys of the other side")
        return {**theirs, **names}, conditions


def _is_count(value: Expression) -> bool:
    return not isinstance(value, Field) or value.name.startswith(VALUE)


def _is_better(new: list[int], old: list[int]) -> bool:
    """Fewer sources that report; where they are the same, at higher counts."""
    mine, theirs = list(map(bool, new)), list(map(bool, old))
    return sum(mine) < sum(theirs) or (mine == theirs and sum(new) > sum(old))


def _inequality(condition: Expression) -> _Terms | None:
    """The condition as `sum of terms >= number`; None: it is none."""
    if not isinstance(condition, BinaryOperation) or condition.operator not in (">=", ">", "<=", "<"):
        return None
    left, right = _linear(condition.left), _linear(condition.right)
    if left is None or right is None:
        return None
    if condition.operator in ("<=", "<"):
        left, right = right, left
    terms = {name: left[0].get(name, 0) - right[0].get(name, 0) for name in {*left[0], *right[0]}}
    return terms, right[1] - left[1] + (condition.operator in (">", "<"))


def _least(inequalities: Sequence[_Terms]) -> dict[str, int]:
    """What each count is at least, by the conditions on it alone."""
    found: dict[str, int] = {}
    for terms, bound in inequalities:
        if len(terms) == 1:
            ((name, factor),) = terms.items()
            if factor > 0:
                found[name] = max(found.get(name, 0), -(-bound // factor))
    return found


def _thresholds(terms: Mapping[str, int], bound: int, sources: int, least: Mapping[str, int]) -> list[int]:
    """Counts that the condition implies, one of which must be reached; zeros: it implies nothing."""
    none = [0] * sources
    needed = bound - sum(factor * least.get(name, 0) for name, factor in terms.items() if factor < 0)
    positive = {name: factor for name, factor in terms.items() if factor > 0}
    if needed < 1 or not positive:
        return none
    share = -(-needed // len(positive))
    found = list(none)
    for name, factor in positive.items():
        found[int(name.removeprefix(VALUE))] = -(-share // factor)
    return found


def _linear(expression: Expression) -> _Terms | None:
    match expression:
        case Number(value):
            return {}, value
        case Field(name) if name.startswith(VALUE):
            return {name: 1}, 0
        case BinaryOperation("+" | "-", left, right):
            parts = list(_both(left, right))
            if len(parts) < 2:
                return None
            (terms, constant), (more, other) = parts
            sign = 1 if expression.operator == "+" else -1
            names = {*terms, *more}
            return {n: terms.get(n, 0) + sign * more.get(n, 0) for n in names}, constant + sign * other
        case BinaryOperation("*", left, Number(factor)) if (found := _linear(left)) is not None:
            return {name: value * factor for name, value in found[0].items()}, found[1] * factor
        case _:
            return None


def _both(left: Expression, right: Expression) -> Iterator[_Terms]:
    for side in (left, right):
        found = _linear(side)
        if found is not None:
            yield found
