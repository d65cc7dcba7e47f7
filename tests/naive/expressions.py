"""Expressions evaluated as BMv2 defines them: on integers without bounds, node by node."""

import operator
from collections.abc import Callable, Mapping

from dataplane.v1model.tree import Binary, Conditional, Const, Expression, FieldRef, FieldType, Unary

Values = Mapping[str, int]
"""Field name -> value."""


def evaluate(e: Expression, values: Values) -> int:
    if isinstance(e, Const):
        return e.value
    if isinstance(e, FieldRef):
        return values[e.field.name]
    if isinstance(e, Conditional):
        return evaluate(e.yes if evaluate(e.condition, values) else e.no, values)
    if isinstance(e, Unary):
        operand = evaluate(e.operand, values)
        return {"~": ~operand, "not": int(not operand), "d2b": int(operand != 0), "b2d": operand}[e.op]
    assert isinstance(e, Binary)
    return binary(e.op, evaluate(e.left, values), evaluate(e.right, values))


def binary(op: str, a: int, b: int) -> int:
    if op in ("two_comp_mod", "usat_cast", "sat_cast"):
        return cast(op, a, b)
    if op in ("/", "%"):
        return 0 if b == 0 else a // b if op == "/" else a % b
    return _OPERATIONS[op](a, b)


_OPERATIONS: dict[str, Callable[[int, int], int]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "&": operator.and_,
    "|": operator.or_,
    "^": operator.xor,
    "<<": operator.lshift,
    ">>": operator.rshift,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "and": lambda a, b: int(bool(a and b)),
    "or": lambda a, b: int(bool(a or b)),
}


def cast(op: str, value: int, width: int) -> int:
    half = 1 << (width - 1)
    if op == "usat_cast":
        return min(max(value, 0), 2 * half - 1)
    if op == "sat_cast":
        return min(max(value, -half), half - 1)
    return (value + half) % (2 * half) - half


def stored(value: int, field: FieldType) -> int:
    """As a field of this type keeps it."""
    if field.saturating:
        return cast("sat_cast" if field.signed else "usat_cast", value, field.width)
    return cast("two_comp_mod", value, field.width) if field.signed else value % (1 << field.width)
