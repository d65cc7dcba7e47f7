"""A query in the languages of SQLite and MongoDB: which stored frames may hold a match, never too few.

A frame holds one or more items of one key and one source, between a first and a last timestamp, event time
and sequence number.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar

from due.drivers.query_tree import EQUAL_OR_ORDER, INT64, And, Condition, Node

Name_co = TypeVar("Name_co", covariant=True)
Spans: TypeAlias = Mapping[str, int]
"""Field to the most nanoseconds that the items of one frame lie apart in it."""


class Lookup(Protocol[Name_co]):
    """The entries of an archive's own dictionary that meet a condition."""

    def __call__(self, condition: Condition, /) -> Sequence[Name_co]: ...


_COLUMNS = {
    "timestamp": ("first_time", "last_time"),
    "eventTime": ("first_event", "last_event"),
    "sequence": ("first_sequence", "last_sequence"),
}
_AMONG = {
    "key_id": "key_id IN (SELECT value FROM json_each(?))",
    "source_id": "source_id IN (SELECT value FROM json_each(?))",
}
MONGO_LAST = {"timestamp": "lastTimestamp", "eventTime": "lastEventTime", "sequence": "lastSequence"}
_NOTHING = {"dataKey": {"$in": list[str]()}}


def _range(condition: Condition) -> tuple[int, int] | None:
    """Least and greatest number that can meet a condition; None if none can."""
    operator, operand = condition.operator, condition.operand
    if operator == "exists" and condition.negated:
        return None
    if condition.negated or operator == "exists":
        return -INT64, INT64 - 1
    if operator == "in":
        return (min(operand), max(operand)) if operand else None
    low = operand if operator in ("eq", "gt", "gte") else -INT64
    high = operand if operator in ("eq", "lt", "lte") else INT64 - 1
    return low, high


def sql(node: Node, lookup: Lookup[int], spans: Spans, parameters: list[Any]) -> str:
    """A WHERE clause; appends to `parameters`."""
    if isinstance(node, Condition):
        if node.field in _COLUMNS:
            return _sql_range(node, spans, parameters)
        parameters.append("[" + ",".join(map(str, lookup(node))) + "]")
        return _AMONG["key_id" if node.field == "dataKey" else "source_id"]
    texts = [sql(part, lookup, spans, parameters) for part in node.parts]
    if isinstance(node, And):
        return "(" + " AND ".join(texts) + ")" if texts else "1"
    return "(" + " OR ".join(texts) + ")" if texts else "0"


def _sql_range(condition: Condition, spans: Spans, parameters: list[Any]) -> str:
    """A frame's items lie between its first and last; the span keeps the search inside the index."""
    bounds = _range(condition)
    if bounds is None:
        return "0"
    first, last = _COLUMNS[condition.field]
    low, high = bounds
    terms = []
    if low > -INT64:
        terms.append(f"{last} >= ?")
        parameters.append(low)
        if condition.field in spans:
            terms.append(f"{first} >= ?")
            parameters.append(max(low - spans[condition.field], -INT64))
    if high < INT64 - 1:
        terms.append(f"{first} <= ?")
        parameters.append(high)
    return "(" + " AND ".join(terms) + ")" if terms else "1"


def server_can(condition: Condition) -> bool:
    """Whether the server's evaluation accepts everything that ours accepts."""
    if condition.field != "value":
        return condition.operator != "regex" or condition.field == "dataKey"
    operands = condition.operand if condition.operator == "in" else (condition.operand,)
    return (
        not condition.negated
        and condition.operator in (*EQUAL_OR_ORDER, "in")
        and all(step and not step.startswith("$") and _is_plain(step) for step in condition.path)
        and all(_is_plain(operand) for operand in operands)
    )


def _is_plain(operand: Any) -> bool:
    if isinstance(operand, bool):
        return True
    if isinstance(operand, str):
        return operand.isprintable()
    if isinstance(operand, int):
        return -INT64 <= operand < INT64
    return isinstance(operand, float) and math.isfinite(operand)


def mongo(node: Node, lookup: Lookup[str], spans: Spans) -> dict[str, Any]:
    """A filter document."""
    if isinstance(node, Condition):
        return _mongo_condition(node, lookup, spans)
    parts = [mongo(part, lookup, spans) for part in node.parts]
    if isinstance(node, And):
        return _merge(parts)
    return {"$or": parts} if parts else _NOTHING


def _merge(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One flat document if the fields allow it; small servers use an index only then."""
    merged: dict[str, Any] = {}
    rest = []
    for part in parts:
        clash = any(name.startswith("$") or merged.get(name, {}).keys() & part[name] for name in part)
        if clash:
            rest.append(part)
            continue
        for name, test in part.items():
            merged[name] = merged.get(name, {}) | test
    return merged | {"$and": rest} if rest else merged


def _mongo_condition(condition: Condition, lookup: Lookup[str], spans: Spans) -> dict[str, Any]:
    field, operand = condition.field, condition.operand
    if field == "dataKey":
        keys = list(lookup(condition))
        return {"dataKey": {"$eq": keys[0]} if len(keys) == 1 else {"$in": keys}}
    if field in MONGO_LAST:
        return _mongo_range(condition, spans)
    if condition.operator == "exists":
        return _NOTHING if condition.negated else {}
    operator = f"${condition.operator}"
    if condition.negated:
        operator = {"$eq": "$ne", "$in": "$nin"}[operator]
    operand = list(operand) if condition.operator == "in" else operand
    test = {".".join((field, *condition.path)): {operator: operand}}
    if field != "value":
        return test
    # a server cannot look into a frame, nor at a value that BSON does not hold exactly
    return {"$or": [test, {"payload": {"$exists": True}}]}


def _mongo_range(condition: Condition, spans: Spans) -> dict[str, Any]:
    bounds = _range(condition)
    if bounds is None:
        return _NOTHING
    low, high = bounds
    tests: dict[str, dict[str, int]] = {}
    if low > -INT64:
        tests[MONGO_LAST[condition.field]] = {"$gte": low}
        tests[condition.field] = {"$gte": max(low - spans.get(condition.field, 2 * INT64), -INT64)}
    if high < INT64 - 1:
        tests.setdefault(condition.field, {})["$lte"] = high
    return tests


def time_range(node: Node) -> tuple[int, int] | None:
    """First and last timestamp of a query that asks for keys and times only; else None."""
    low, high = -INT64, INT64 - 1
    for part in node.parts if isinstance(node, And) else (node,):
        if not isinstance(part, Condition) or part.field not in ("dataKey", "timestamp"):
            return None
        if part.field == "timestamp":
            if part.negated or part.operator not in EQUAL_OR_ORDER:
                return None
            low = (
                max(low, part.operand + (part.operator == "gt"))
                if part.operator in ("gt", "gte", "eq")
                else low
            )
            high = (
                min(high, part.operand - (part.operator == "lt"))
                if part.operator in ("lt", "lte", "eq")
                else high
            )
    return low, high
