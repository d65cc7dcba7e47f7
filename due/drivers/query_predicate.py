"""The meaning of a query: a test of one item, in Python.

Comparison follows MongoDB: only like kinds compare (a number never equals a string or a bool), a list
matches if the whole or one element does, NaN equals NaN and is in no other order, `None` matches what
is missing.
"""

import datetime as dt
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter, eq, ge, gt, le, lt
from typing import Any, Protocol, TypeAlias

import numpy as np

from due.drivers.query_tree import And, Condition, Node
from due.keys import Key

FIELDS = {
    "dataKey": "key",
    "value": "value",
    "timestamp": "timestamp",
    "eventTime": "event_time",
    "appId": "app_id",
    "instanceId": "instance_id",
    "sequence": "sequence",
}
"""Field of a query to attribute of an item."""
_COMPARE: dict[str, Callable[[Any, Any], Any]] = {"eq": eq, "gt": gt, "gte": ge, "lt": lt, "lte": le}
_INDEX_DIGITS = 9
_EPOCH = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)

Test: TypeAlias = Callable[[Any], bool]


class QueriedItem(Protocol):
    """What a query tests; `due.Item` implements it."""

    @property
    def key(self) -> str: ...
    @property
    def value(self) -> Any: ...
    @property
    def timestamp(self) -> int: ...
    @property
    def event_time(self) -> int: ...
    @property
    def app_id(self) -> str: ...
    @property
    def instance_id(self) -> str: ...
    @property
    def sequence(self) -> int: ...


def compiled(node: Node) -> Test:
    """A function that decides over any `QueriedItem`."""
    if isinstance(node, Condition):
        return _test_value(node) if node.field == "value" else _test_metadata(node)
    tests = tuple(compiled(part) for part in node.parts)
    if isinstance(node, And):
        return lambda item: all(test(item) for test in tests)
    return lambda item: any(test(item) for test in tests)


def _test_metadata(condition: Condition) -> Test:
    get = attrgetter(FIELDS[condition.field])
    holds = _metadata_predicate(condition)
    if condition.negated:
        return lambda item: not holds(get(item))
    return lambda item: holds(get(item))


def _metadata_predicate(condition: Condition) -> Test:
    operand = condition.operand
    if condition.operator == "exists":
        return lambda _: True
    if condition.operator == "regex":
        search: Test = operand.search
        return search
    if condition.field == "dataKey":
        patterns: tuple[Key, ...] = operand if condition.operator == "in" else (operand,)
        return _key_predicate(patterns)
    if condition.operator == "in":
        wanted = frozenset(operand)
        return lambda value: value in wanted
    compare = _COMPARE[condition.operator]
    return lambda value: bool(compare(value, operand))


def _key_predicate(patterns: tuple[Key, ...]) -> Test:
    known: dict[str, bool] = {}

    def holds(text: str) -> bool:
        found = known.get(text)
        if found is None:
            key = Key.parse(text)
            found = known[text] = any(pattern.matches(key) for pattern in patterns)
        return found

    return holds


def _test_value(condition: Condition) -> Test:
    holds = _value_predicate(condition)
    path, negated = condition.path, condition.negated
    return lambda item: holds(list(_reach(item.value, path))) != negated


def _value_predicate(condition: Condition) -> Test:
    """A test of all values that a path reaches in one value."""
    operator, operand = condition.operator, condition.operand
    if operator == "exists":
        return bool
    if operator == "size":
        return lambda reached: any(kind_of(one) == "list" and len(one) == operand for one in reached)
    if operator == "regex":
        return lambda reached: any(isinstance(one, str) and operand.search(one) for one in _spread(reached))
    wanted = operand if operator == "in" else (operand,)
    compare = "eq" if operator == "in" else operator
    null = compare == "eq" and any(one is None for one in wanted)

    def holds(reached: Sequence[Any]) -> bool:
        if not reached:
            return null
        return any(_holds(compare, one, other) for one in _spread(reached) for other in wanted)

    return holds


def _reach(value: Any, path: Sequence[str]) -> Iterator[Any]:
    """Values at a path; as in MongoDB, a list on the way is entered at an index or at every element."""
    if not path:
        yield value
    elif isinstance(value, Mapping):
        if path[0] in value:
            yield from _reach(value[path[0]], path[1:])
    elif isinstance(value, list | tuple):
        if _is_index(path[0]) and int(path[0]) < len(value):
            yield from _reach(value[int(path[0])], path[1:])
        for element in value:
            if isinstance(element, Mapping):
                yield from _reach(element, path)


def _is_index(step: str) -> bool:
    return step.isdecimal() and len(step) <= _INDEX_DIGITS


def _spread(reached: Sequence[Any]) -> Iterator[Any]:
    for one in reached:
        yield one
        if isinstance(one, np.ndarray):
            yield from one.ravel().tolist()
        elif isinstance(one, list | tuple):
            yield from one


def kind_of(value: Any) -> str:
    """Values of different kinds are neither equal nor in any order."""
    if value is None:
        return "null"
    for kind, types in _KINDS:
        if isinstance(value, types):
            return kind
    return type(value).__name__


_KINDS: tuple[tuple[str, tuple[type, ...]], ...] = (
    ("bool", (bool, np.bool_)),
    ("number", (int, float, np.integer, np.floating)),
    ("text", (str,)),
    ("bytes", (bytes, bytearray, memoryview)),
    ("time", (dt.datetime, np.datetime64)),
    ("list", (list, tuple, np.ndarray)),
    ("map", (Mapping,)),
)


def _holds(operator: str, value: Any, operand: Any) -> bool:
    kind = kind_of(value)
    if kind != kind_of(operand):
        return False
    if kind == "list":
        return operator == "eq" and _same_list(value, operand)
    if kind == "map":
        return operator == "eq" and _same_map(value, operand)
    if kind == "time":
        value, operand = nanoseconds(value), nanoseconds(operand)
    if kind == "bytes":
        value, operand = bytes(value), bytes(operand)
    if kind == "number" and (_is_nan(value) or _is_nan(operand)):
        return operator in ("eq", "gte", "lte") and _is_nan(value) and _is_nan(operand)
    return bool(_COMPARE[operator](value, operand))


def _is_nan(number: Any) -> bool:
    """Integers may be too large for `math.isnan`."""
    return isinstance(number, float | np.floating) and math.isnan(number)


def _same_list(value: Any, operand: Any) -> bool:
    return len(value) == len(operand) and all(_holds("eq", a, b) for a, b in zip(value, operand, strict=True))


def _same_map(value: Mapping[Any, Any], operand: Mapping[Any, Any]) -> bool:
    return value.keys() == operand.keys() and all(_holds("eq", value[key], operand[key]) for key in value)


def nanoseconds(value: Any) -> Any:
    """A time as int ns since 1970 (naive datetimes are UTC); anything else as it is."""
    if isinstance(value, dt.datetime):
        aware = value if value.tzinfo is not None else value.replace(tzinfo=dt.UTC)
        return (aware - _EPOCH) // dt.timedelta(microseconds=1) * 1000
    if isinstance(value, np.datetime64):
        return int(value.astype("datetime64[ns]").astype(np.int64))
    return int(value) if isinstance(value, np.integer) else value
