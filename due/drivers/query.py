"""The archives' query dialect: MongoDB operators over the fields of an archived item.

    mapping ── parse() ──► Query ── .matches(item)     Python; this is the meaning of the dialect
                                 ├─ .to_sql(lookup)    candidates among the rows of SQLite
                                 └─ .to_mongo(expand)  candidates for a MongoDB server

A driver narrows with its own language and decides with `matches`, so every driver gives the same
answer. What a translation cannot express it drops; candidates are therefore never too few.

Fields: dataKey, value, value.<path>, timestamp, eventTime, appId, instanceId, sequence.
Operators: $and $or $nor $not $eq $ne $gt $gte $lt $lte $in $nin $exists $regex $options $size.
Comparison follows MongoDB: only like kinds compare (a number never equals a string or a bool), a
list matches if the whole or one element does, NaN equals NaN and is in no other order, `None`
matches what is missing. `dataKey` takes a key as `observe` does, wildcards and fewer specs included.

An archive may store many items as one frame: candidates are then frames that may hold a match.
"""

import datetime as dt
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np

from due.errors import InvalidQuery
from due.keys import Key

_FIELDS = {
    "dataKey": "key",
    "value": "value",
    "timestamp": "timestamp",
    "eventTime": "event_time",
    "appId": "app_id",
    "instanceId": "instance_id",
    "sequence": "sequence",
}
_TIMES = ("timestamp", "eventTime")
_INTEGERS = (*_TIMES, "sequence")
_OPPOSITE = {"gt": "lte", "gte": "lt", "lt": "gte", "lte": "gt"}
_COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    "eq": lambda a, b: bool(a == b),
    "gt": lambda a, b: bool(a > b),
    "gte": lambda a, b: bool(a >= b),
    "lt": lambda a, b: bool(a < b),
    "lte": lambda a, b: bool(a <= b),
}
_KEY_OPERATORS = ("eq", "in", "regex")
_REGEX_FLAGS = {"i": re.IGNORECASE, "m": re.MULTILINE, "s": re.DOTALL, "x": re.VERBOSE}
_EPOCH = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
_INT64 = 2**63
Name_co = TypeVar("Name_co", covariant=True)


class Record(Protocol):
    """What a query looks at: `due.Item` is one."""

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
Spans: TypeAlias = Mapping[str, int]
"""Field to the most nanoseconds that the items of one frame lie apart in it."""


class Lookup(Protocol[Name_co]):
    """Which of an archive's own dictionary entries meet a condition."""

    def __call__(self, condition: Condition, /) -> Sequence[Name_co]: ...


Test: TypeAlias = Callable[[Any], bool]
_EVERYTHING = And(())


class Query:
    """A query, checked once and used many times."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._metadata = _weaken(node, lambda condition: condition.field != "value")
        #: Whether the value of an item has to be looked at.
        self.uses_value = self._metadata != node
        #: Decides over any `Record`.
        self.matches: Callable[[Record], bool] = _compile(node)
        #: The same without its conditions on values: never refuses what `matches` accepts.
        self.matches_metadata: Callable[[Record], bool] = _compile(self._metadata)

    def to_sql(self, lookup: "Lookup[int]", spans: "Spans") -> tuple[str, list[Any]]:
        """WHERE clause and parameters over rows that hold one frame each.

        `lookup` gives the ids of the keys (field dataKey) or sources (appId, instanceId) that meet
        a condition.
        """
        parameters: list[Any] = []
        text = _sql(self._metadata, lookup, spans, parameters)
        return text, parameters

    def to_mongo(self, lookup: "Lookup[str]", spans: "Spans") -> dict[str, Any]:
        """Filter over documents that hold one frame each; `lookup` gives the keys of a dataKey condition."""
        return _mongo(_weaken(self.node, _server_can), lookup, spans)

    def conditions(self, field: str) -> Iterator[Condition]:
        """The conditions on a field that every result has to meet."""
        parts = self.node.parts if isinstance(self.node, And) else (self.node,)
        return (part for part in parts if isinstance(part, Condition) and part.field == field)


def parse(query: Mapping[str, Any]) -> Query:
    """Check a query; raises InvalidQuery, or InvalidKey for a malformed dataKey."""
    if not isinstance(query, Mapping):
        raise InvalidQuery(f"a query is a mapping of fields to conditions, not {type(query).__name__}")
    return Query(_conjunction(query, negated=False))


def _conjunction(query: Mapping[str, Any], *, negated: bool) -> Node:
    return _join([_clause(name, operand, negated=negated) for name, operand in query.items()], either=negated)


def _join(parts: Sequence[Node], *, either: bool) -> Node:
    if len(parts) == 1:
        return parts[0]
    return Or(tuple(parts)) if either else And(tuple(parts))


def _clause(name: str, operand: Any, *, negated: bool) -> Node:
    if name in ("$and", "$or", "$nor"):
        if not isinstance(operand, list | tuple) or not operand:
            raise InvalidQuery(f"{name} takes a list of one or more queries, not {operand!r}")
        inner = negated != (name == "$nor")
        either = (name != "$and") != inner
        for part in operand:
            if not isinstance(part, Mapping):
                raise InvalidQuery(f"{name} takes a list of queries, and {part!r} is none")
        return _join([_conjunction(part, negated=inner) for part in operand], either=either)
    field, _, rest = name.partition(".") if isinstance(name, str) else (name, "", "")
    if field not in _FIELDS or (rest and field != "value"):
        fields = ", ".join(f"{known}[.<path>]" if known == "value" else known for known in _FIELDS)
        raise InvalidQuery(f"unknown field or operator {name!r} in a query; fields are {fields}")
    return _field(field, tuple(rest.split(".")) if rest else (), operand, negated=negated)


def _field(field: str, path: tuple[str, ...], operand: Any, *, negated: bool) -> Node:
    if isinstance(operand, re.Pattern):
        return _condition(field, path, "regex", operand, negated=negated)
    named = (
        [isinstance(key, str) and key.startswith("$") for key in operand]
        if isinstance(operand, Mapping)
        else []
    )
    if not any(named):
        return _condition(field, path, "eq", operand, negated=negated)
    if not all(named):
        raise InvalidQuery(f"{field}: operators and plain fields do not mix in {operand!r}")
    parts = []
    for operator, value in operand.items():
        if operator == "$not":
            if not isinstance(value, Mapping | re.Pattern):
                raise InvalidQuery(f"{field}: $not takes a mapping of operators, not {value!r}")
            parts.append(_field(field, path, value, negated=not negated))
        elif operator == "$regex":
            pattern = _pattern(field, value, operand.get("$options", ""))
            parts.append(_condition(field, path, "regex", pattern, negated=negated))
        elif operator != "$options":
            parts.append(_operator(field, path, operator, value, negated=negated))
    return _join(parts, either=negated)


def _operator(field: str, path: tuple[str, ...], operator: str, value: Any, *, negated: bool) -> Condition:
    if operator in ("$ne", "$nin"):
        operator, negated = ("$eq" if operator == "$ne" else "$in"), not negated
    name = operator[1:]
    if name not in (*_COMPARE, "in", "exists", "size"):
        raise InvalidQuery(
            f"{field}: unknown operator {operator!r}; known are $eq $ne $gt $gte $lt $lte $in $nin "
            f"$exists $regex $options $size $not"
        )
    return _condition(field, path, name, value, negated=negated)


def _condition(field: str, path: tuple[str, ...], operator: str, value: Any, *, negated: bool) -> Condition:
    if operator == "in":
        if not isinstance(value, list | tuple | set | frozenset):
            raise InvalidQuery(f"{field}: $in and $nin take a list, not {value!r}")
        operand: Any = tuple(_operand(field, "eq", one) for one in value)
    elif operator == "exists":
        operand, negated = True, negated == bool(value)
    elif operator == "regex":
        if field in _INTEGERS:
            raise InvalidQuery(f"{field}: $regex looks at text, and {field} is a number")
        operand = value
    else:
        operand = _operand(field, operator, value)
    if field != "value" and negated and operator in _OPPOSITE:
        operator, negated = _OPPOSITE[operator], False
    return Condition(field, path, operator, operand, negated)


def _pattern(field: str, value: Any, options: Any) -> re.Pattern[str]:
    if isinstance(value, re.Pattern):
        return value
    if not isinstance(value, str) or not isinstance(options, str):
        raise InvalidQuery(f"{field}: $regex and $options take text, not {value!r} and {options!r}")
    unknown = set(options) - set(_REGEX_FLAGS)
    if unknown:
        raise InvalidQuery(f"{field}: unknown $options {''.join(sorted(unknown))!r}; known are i, m, s, x")
    flags = sum(_REGEX_FLAGS[letter] for letter in set(options))
    try:
        return re.compile(value, flags)
    except re.error as error:
        raise InvalidQuery(f"{field}: $regex {value!r} is not a regular expression: {error}") from error


def _operand(field: str, operator: str, value: Any) -> Any:
    if field == "value":
        return _value_operand(operator, value)
    if operator == "size":
        raise InvalidQuery(f"{field}: $size counts the elements of a list, and {field} is none")
    if field in _INTEGERS:
        number = _nanoseconds(value) if field in _TIMES else value
        if isinstance(number, bool) or not isinstance(number, int) or not -_INT64 <= number < _INT64:
            kinds = "a datetime or int nanoseconds" if field in _TIMES else "an int of 64 bits"
            raise InvalidQuery(f"{field}: compare with {kinds}, not {value!r}")
        return number
    if not isinstance(value, str):
        raise InvalidQuery(f"{field}: compare with text, not {value!r}")
    if field != "dataKey":
        return value
    if operator not in _KEY_OPERATORS:
        raise InvalidQuery(f"dataKey: ${operator} has no meaning on keys; use $eq, $ne, $in, $nin or $regex")
    return Key.parse(value)


def _value_operand(operator: str, value: Any) -> Any:
    if operator == "size":
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise InvalidQuery(f"value: $size takes a count from 0, not {value!r}")
        return value
    if operator in _OPPOSITE and _kind(value) not in ("bool", "number", "text", "bytes", "time"):
        raise InvalidQuery(f"value: ${operator} compares numbers, text, bytes or times, not {value!r}")
    return value


def _nanoseconds(value: Any) -> Any:
    if isinstance(value, dt.datetime):
        aware = value if value.tzinfo is not None else value.replace(tzinfo=dt.UTC)
        return (aware - _EPOCH) // dt.timedelta(microseconds=1) * 1000
    if isinstance(value, np.datetime64):
        return int(value.astype("datetime64[ns]").astype(np.int64))
    return int(value) if isinstance(value, np.integer) else value


# --- Python: the meaning -----------------------------------------------------------------------


def _compile(node: Node) -> Test:
    if isinstance(node, Condition):
        return _test_value(node) if node.field == "value" else _test_metadata(node)
    tests = tuple(_compile(part) for part in node.parts)
    if isinstance(node, And):
        return lambda item: all(test(item) for test in tests)
    return lambda item: any(test(item) for test in tests)


def _test_metadata(condition: Condition) -> Test:
    get = attrgetter(_FIELDS[condition.field])
    holds = _metadata_predicate(condition)
    if condition.negated:
        return lambda item: not holds(get(item))
    return lambda item: holds(get(item))


def _metadata_predicate(condition: Condition) -> Test:
    operand = condition.operand
    if condition.operator == "exists":
        return lambda _: True
    if condition.operator == "regex":
        return lambda text: operand.search(text) is not None
    if condition.field == "dataKey":
        patterns: tuple[Key, ...] = operand if condition.operator == "in" else (operand,)
        return _key_predicate(patterns)
    if condition.operator == "in":
        wanted = frozenset(operand)
        return lambda value: value in wanted
    compare = _COMPARE[condition.operator]
    return lambda value: compare(value, operand)


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
    """A test of the list of what a path reaches in one value."""
    operator, operand = condition.operator, condition.operand
    if operator == "exists":
        return bool
    if operator == "size":
        return lambda reached: any(_kind(one) == "list" and len(one) == operand for one in reached)
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
    """What a path leads to; as in MongoDB a list on the way is entered at an index or everywhere."""
    if not path:
        yield value
    elif isinstance(value, Mapping):
        if path[0] in value:
            yield from _reach(value[path[0]], path[1:])
    elif isinstance(value, list | tuple):
        if path[0].isdigit() and int(path[0]) < len(value):
            yield from _reach(value[int(path[0])], path[1:])
        for element in value:
            if isinstance(element, Mapping):
                yield from _reach(element, path)


def _spread(reached: Sequence[Any]) -> Iterator[Any]:
    for one in reached:
        yield one
        if isinstance(one, np.ndarray):
            yield from one.ravel().tolist()
        elif isinstance(one, list | tuple):
            yield from one


def _kind(value: Any) -> str:
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
    kind = _kind(value)
    if kind != _kind(operand):
        return False
    if kind == "list":
        return operator == "eq" and _same_list(value, operand)
    if kind == "map":
        return operator == "eq" and _same_map(value, operand)
    if kind == "time":
        value, operand = _nanoseconds(value), _nanoseconds(operand)
    if kind == "number" and (math.isnan(value) or math.isnan(operand)):
        return operator in ("eq", "gte", "lte") and math.isnan(value) and math.isnan(operand)
    return _COMPARE[operator](value, operand)


def _same_list(value: Any, operand: Any) -> bool:
    return len(value) == len(operand) and all(_holds("eq", a, b) for a, b in zip(value, operand, strict=True))


def _same_map(value: Mapping[Any, Any], operand: Mapping[Any, Any]) -> bool:
    return value.keys() == operand.keys() and all(_holds("eq", value[key], operand[key]) for key in value)


# --- translations: candidates ------------------------------------------------------------------


def _weaken(node: Node, keep: Callable[[Condition], bool]) -> Node:
    """The query with every condition that is not kept taken as met."""
    if isinstance(node, Condition):
        return node if keep(node) else _EVERYTHING
    parts = tuple(_weaken(part, keep) for part in node.parts)
    if isinstance(node, Or):
        return _EVERYTHING if _EVERYTHING in parts else Or(parts)
    kept = tuple(part for part in parts if part != _EVERYTHING)
    return kept[0] if len(kept) == 1 and kept != parts else And(kept)


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
        return -_INT64, _INT64 - 1
    if operator == "in":
        return (min(operand), max(operand)) if operand else None
    low = operand if operator in ("eq", "gt", "gte") else -_INT64
    high = operand if operator in ("eq", "lt", "lte") else _INT64 - 1
    return low, high


def _sql(node: Node, lookup: Lookup[int], spans: Spans, parameters: list[Any]) -> str:
    if isinstance(node, Condition):
        if node.field in _COLUMNS:
            return _sql_range(node, spans, parameters)
        parameters.append("[" + ",".join(map(str, lookup(node))) + "]")
        return _AMONG["key_id" if node.field == "dataKey" else "source_id"]
    texts = [_sql(part, lookup, spans, parameters) for part in node.parts]
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
    if low > -_INT64:
        terms.append(f"{last} >= ?")
        parameters.append(low)
        if condition.field in spans:
            terms.append(f"{first} >= ?")
            parameters.append(max(low - spans[condition.field], -_INT64))
    if high < _INT64 - 1:
        terms.append(f"{first} <= ?")
        parameters.append(high)
    return "(" + " AND ".join(terms) + ")" if terms else "1"


def _server_can(condition: Condition) -> bool:
    """Whether a server's own evaluation cannot refuse what ours accepts."""
    if condition.field != "value":
        return condition.operator != "regex" or condition.field == "dataKey"
    operands = condition.operand if condition.operator == "in" else (condition.operand,)
    return (
        not condition.negated
        and condition.operator in (*_COMPARE, "in")
        and all(step and not step.startswith("$") and _is_plain(step) for step in condition.path)
        and all(_is_plain(operand) for operand in operands)
    )


def _is_plain(operand: Any) -> bool:
    if isinstance(operand, bool):
        return True
    if isinstance(operand, str):
        return operand.isprintable()
    if isinstance(operand, int):
        return -_INT64 <= operand < _INT64
    return isinstance(operand, float) and math.isfinite(operand)


def _mongo(node: Node, lookup: Lookup[str], spans: Spans) -> dict[str, Any]:
    if isinstance(node, Condition):
        return _mongo_condition(node, lookup, spans)
    parts = [_mongo(part, lookup, spans) for part in node.parts]
    if isinstance(node, And):
        return _merge(parts)
    return {"$or": parts} if parts else _NOTHING


def _merge(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One flat document where fields allow: small servers use an index only then."""
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
    if low > -_INT64:
        tests[MONGO_LAST[condition.field]] = {"$gte": low}
        tests[condition.field] = {"$gte": max(low - spans.get(condition.field, 2 * _INT64), -_INT64)}
    if high < _INT64 - 1:
        tests.setdefault(condition.field, {})["$lte"] = high
    return tests
