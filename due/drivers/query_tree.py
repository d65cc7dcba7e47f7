"""A query of the archives as a tree: conditions under `And` and `Or`; negation stands at the conditions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

INT64 = 2**63
"""Times and sequence numbers lie in [-INT64, INT64)."""
EQUAL_OR_ORDER = ("eq", "gt", "gte", "lt", "lte")


@dataclass(frozen=True, slots=True)
class Condition:
    """One test of one field; `operand` is already of the field's own type."""

    field: str
    path: tuple[str, ...]
    operator: str
    operand: Any
    negated: bool = False


@dataclass(frozen=True, slots=True)
class And:
    parts: tuple["Node", ...]


@dataclass(frozen=True, slots=True)
class Or:
    parts: tuple["Node", ...]


Node: TypeAlias = Condition | And | Or
EVERYTHING = And(())


def weaken(node: Node, keep: Callable[[Condition], bool]) -> Node:
    """The query with every condition that is not kept replaced by true."""
    if isinstance(node, Condition):
        return node if keep(node) else EVERYTHING
    parts = tuple(weaken(part, keep) for part in node.parts)
    if isinstance(node, Or):
        return EVERYTHING if EVERYTHING in parts else Or(parts)
    kept = tuple(part for part in parts if part != EVERYTHING)
    return kept[0] if len(kept) == 1 and kept != parts else And(kept)
