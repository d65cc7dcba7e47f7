"""Evaluation of expressions over rows, column by column."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from ipaddress import ip_network
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.key_dictionary import NumberedKeys
from apps.sonata_adapter.host.key_tables import Column, Hashes, is_constant
from apps.sonata_adapter.query.expressions import (
    COMPARISONS,
    BinaryOperation,
    Contains,
    Expression,
    Field,
    Not,
    Number,
    Operator,
    Within,
)

SIX: Final = 0xFFFF_0000_0000_0001
"""What the upper half of an IPv6 address is XORed with; see `columns`."""
_ALL_ONES: Final = (1 << 64) - 1
_ALL_BITS: Final = -1


class TupleRows(Protocol):
    """Tuples of one batch."""

    def __len__(self) -> int: ...

    def column(self, name: str) -> Column:
        """A field's values."""

    def compared(self, name: str, operator: Operator, number: int, mask: int) -> NDArray[np.bool_] | None:
        """`field & mask == number` and the like, read as it stands (mask -1: all of it); None: evaluate it."""

    def contains(self, pattern: bytes) -> NDArray[np.bool_]:
        """Mask of the packets whose payload contains the pattern."""

    def where(self, condition: Expression) -> "TupleRows":
        """The rows for which the condition holds."""

    def keys(self, values: tuple[Expression, ...]) -> Hashes:
        """64 bits for each row, equal for equal values."""

    def columns_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> list[Column]:
        """The values in some of the rows."""

    def keys_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> Hashes:
        """The keys of some of the rows."""

    def tuples(self, names: Mapping[str, Expression], rows: NDArray[np.intp]) -> "TupleRows":
        """Tuples of these values, under these names, of some of the rows."""

    def numbered(self, value: Expression) -> NumberedKeys | None:
        """Shared numbers for keys of one value; None if they are not worthwhile."""

    @property
    def origin(self) -> NDArray[np.intp]:
        """For each row its packet's row in the batch."""


def column_of(expression: Expression, rows: TupleRows) -> Column:
    """Values of an expression: a field's column, or numbers."""
    if isinstance(expression, Field):
        return rows.column(expression.name)
    return (np.ascontiguousarray(evaluate(expression, rows), dtype=np.int64),)


def evaluate(expression: Expression, rows: TupleRows) -> NDArray[Any]:
    """Numbers or booleans, one for each row."""
    match expression:
        case Number(value):
            return np.full(len(rows), value, dtype=np.int64)
        case Field(name):
            return rows.column(name)[0]
        case Not(operand):
            return ~evaluate(operand, rows)
        case Within(field, prefix):
            return _within(rows.column(field.name), prefix)
        case Contains(pattern):
            return rows.contains(pattern)
        case BinaryOperation(operator, left, right):
            found = _compared(operator, left, right, rows) if isinstance(right, Number) else None
            return _binary(operator, left, right, rows) if found is None else found


def _compared(
    operator: Operator, left: Expression, right: Number, rows: TupleRows
) -> NDArray[np.bool_] | None:
    if operator in COMPARISONS:
        match left:
            case Field(name):
                return rows.compared(name, operator, right.value, _ALL_BITS)
            case BinaryOperation("&", Field(name), Number(mask)) if mask >= 0:
                return rows.compared(name, operator, right.value, mask)
    return None


def _binary(operator: Operator, left: Expression, right: Expression, rows: TupleRows) -> NDArray[Any]:
    if operator in ("==", "!=") and isinstance(left, Field) and isinstance(right, Field):
        pairs = zip(rows.column(left.name), rows.column(right.name), strict=True)
        same = np.logical_and.reduce([a == b for a, b in pairs])
        return np.asarray(same if operator == "==" else ~same)
    first = evaluate(left, rows)
    second: Any = right.value if isinstance(right, Number) else evaluate(right, rows)
    return FUNCTIONS[operator](first, second)


def _divide(left: NDArray[Any], right: Any) -> NDArray[Any]:
    divisor = np.asarray(right)
    return np.where(divisor == 0, 0, left // np.where(divisor == 0, 1, divisor))


def _modulo(left: NDArray[Any], right: Any) -> NDArray[Any]:
    divisor = np.asarray(right)
    return np.where(divisor == 0, 0, left % np.where(divisor == 0, 1, divisor))


FUNCTIONS: Final[dict[Operator, Callable[[NDArray[Any], Any], NDArray[Any]]]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": _divide,
    "%": _modulo,
    "&": lambda a, b: a & b,
    "|": lambda a, b: a | b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "and": lambda a, b: a & b,
    "or": lambda a, b: a | b,
}


def _within(address: Column, prefix: str) -> NDArray[np.bool_]:
    high, low = address
    version, first, mask = _prefix(prefix)
    if is_constant(high) and version == 6:
        return np.zeros(len(low), dtype=np.bool_)
    upper = np.asarray(high, dtype=np.uint64)
    if version == 4:
        found: NDArray[np.bool_] = low & np.uint64(mask) == np.uint64(first)
        if not is_constant(high):
            found &= upper == 0
        return found
    upper = upper ^ np.uint64(SIX)
    same: NDArray[np.bool_] = upper & np.uint64(mask >> 64) == np.uint64(first >> 64)
    same &= low & np.uint64(mask & _ALL_ONES) == np.uint64(first & _ALL_ONES)
    same &= high != 0
    return same


@lru_cache(maxsize=1024)
def _prefix(text: str) -> tuple[int, int, int]:
    network = ip_network(text)
    return network.version, int(network.network_address), int(network.netmask)
