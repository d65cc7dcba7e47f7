"""Bounds of expressions, and expressions with p4c's redundant masks and casts taken out.

BMv2's integers are unbounded and p4c masks after every operation; most masks do nothing because the
operand cannot be that wide.  Bounds tell which, and tell the C back end how wide a value can get.
"""

from dataclasses import dataclass

from dataplane.errors import Unsupported
from dataplane.v1model.tree import (
    Binary,
    Conditional,
    Const,
    Expression,
    FieldRef,
    FieldType,
    Lookahead,
    Param,
    StackCount,
    StackLast,
    Unary,
    Valid,
)

_COMPARISONS = frozenset({"==", "!=", "<", "<=", ">", ">=", "and", "or"})
_LARGEST_SHIFT = 512


@dataclass(frozen=True, slots=True)
class Bounds:
    """low <= value <= high."""

    low: int
    high: int

    @property
    def bits(self) -> int:
        """Bits that hold the value: unsigned where low >= 0, two's complement otherwise."""
        if self.low >= 0:
            return self.high.bit_length()
        return max(self.high.bit_length(), (-self.low - 1).bit_length()) + 1

    @property
    def signed(self) -> bool:
        return self.low < 0


BOOLEAN = Bounds(0, 1)


def field_bounds(field: FieldType) -> Bounds:
    if field.signed:
        return Bounds(-(1 << (field.width - 1)), (1 << (field.width - 1)) - 1)
    return Bounds(0, (1 << field.width) - 1)


def union(a: Bounds, b: Bounds) -> Bounds:
    return Bounds(min(a.low, b.low), max(a.high, b.high))


def bounds(e: Expression) -> Bounds:
    """Bounds of an expression's value."""
    match e:
        case Const(value):
            return Bounds(value, value)
        case FieldRef(_, field) | StackLast(_, field):
            return field_bounds(field)
        case Valid():
            return BOOLEAN
        case Param(_, width) | Lookahead(_, width):
            return Bounds(0, (1 << width) - 1)
        case StackCount():
            return Bounds(-1, 1 << 16)
        case Unary(op, operand):
            inner = bounds(operand)
            return Bounds(~inner.high, ~inner.low) if op == "~" else BOOLEAN
        case Conditional(_, yes, no):
            return union(bounds(yes), bounds(no))
        case Binary(op, left, right):
            return _binary(op, left, right)
    raise AssertionError(e)


def _binary(op: str, left: Expression, right: Expression) -> Bounds:
    if op in _COMPARISONS:
        return BOOLEAN
    if op in ("two_comp_mod", "sat_cast", "usat_cast"):
        return _cast(op, right)
    a, b = bounds(left), bounds(right)
    if op in ("+", "-", "*"):
        return _arithmetic(op, a, b)
    if op in ("/", "%"):
        return Bounds(0, max(a.high, 0) if op == "/" else max(b.high - 1, 0))
    if op in ("<<", ">>"):
        return _shift(op, a, b)
    return _bitwise(op, a, b)


def _cast(op: str, width: Expression) -> Bounds:
    if not isinstance(width, Const):
        raise Unsupported(f"{op} to a width that is not a constant is not supported by the embedded switch")
    if op == "usat_cast":
        return Bounds(0, (1 << width.value) - 1)
    half = 1 << (width.value - 1)
    return Bounds(-half, half - 1)


def _arithmetic(op: str, a: Bounds, b: Bounds) -> Bounds:
    if op == "+":
        return Bounds(a.low + b.low, a.high + b.high)
    if op == "-":
        return Bounds(a.low - b.high, a.high - b.low)
    products = [a.low * b.low, a.low * b.high, a.high * b.low, a.high * b.high]
    return Bounds(min(products), max(products))


def _shift(op: str, a: Bounds, b: Bounds) -> Bounds:
    least, most = min(b.low, _LARGEST_SHIFT), min(b.high, _LARGEST_SHIFT)
    if op == ">>":
        ends = [a.low >> least, a.low >> most, a.high >> least, a.high >> most]
        return Bounds(min(ends), max(ends))
    return Bounds(min(a.low << most, a.low << least), max(a.high << most, a.high << least))


def _bitwise(op: str, a: Bounds, b: Bounds) -> Bounds:
    if op == "&" and (a.low >= 0 or b.low >= 0):
        return Bounds(0, min(x.high for x in (a, b) if x.low >= 0))
    bits = max(a.bits, b.bits)
    if a.low >= 0 and b.low >= 0:
        return Bounds(0, (1 << bits) - 1)
    return Bounds(-(1 << bits), (1 << bits) - 1)


def simplify(e: Expression) -> Expression:
    """The same value by a shorter way."""
    match e:
        case Unary(op, operand):
            return _unary(op, simplify(operand))
        case Conditional(condition, yes, no):
            chosen = simplify(condition)
            if isinstance(chosen, Const):
                return simplify(yes if chosen.value else no)
            return Conditional(chosen, simplify(yes), simplify(no))
        case Binary(op, left, right):
            return _shorter(op, simplify(left), simplify(right))
    return e


def _unary(op: str, operand: Expression) -> Expression:
    if op == "b2d":
        return operand
    if op == "d2b":
        return operand if bounds(operand) in (BOOLEAN, Bounds(0, 0)) else Binary("!=", operand, Const(0))
    if isinstance(operand, Const):
        return Const(~operand.value if op == "~" else int(not operand.value))
    return Unary(op, operand)


def _shorter(op: str, left: Expression, right: Expression) -> Expression:
    if isinstance(left, Const) and op in ("&", "|", "+", "*", "^"):
        left, right = right, left
    if op == "&" and isinstance(right, Const):
        return _masked(left, right.value)
    if isinstance(right, Const) and right.value == 0 and op in ("|", "+", "-", "^", "<<", ">>"):
        return left
    return Binary(op, left, right)


def _masked(value: Expression, mask: int) -> Expression:
    if isinstance(value, Const):
        return Const(value.value & mask)
    if isinstance(value, Binary) and value.op == "&" and isinstance(value.right, Const):
        return _masked(value.left, value.right.value & mask)
    limit = bounds(value)
    if limit.low >= 0:
        mask &= (1 << limit.high.bit_length()) - 1
        if mask == (1 << limit.high.bit_length()) - 1:
            return value
    if mask == 0:
        return Const(0)
    return Binary("&", value, Const(mask))
