"""The archives' query dialect: MongoDB operators over the fields of an archived item.

    mapping ── parse() ──► Query ── .matches(item)              query_meaning: Python; what counts
                                 └─ .to_sql(…), .to_mongo(…)    query_candidates: what to look at

A driver narrows with its own language and decides with `matches`, so every driver gives the same
answer. What a translation cannot express it drops; candidates are therefore never too few.

Fields: dataKey, value, value.<path>, timestamp, eventTime, appId, instanceId, sequence.
Operators: $and $or $nor $not $eq $ne $gt $gte $lt $lte $in $nin $exists $regex $options $size.
Bounds: 30 levels, 20,000 elements, a million characters; `$regex` see `query_regex`.  Beyond: InvalidQuery.
`dataKey` takes a key as `observe` does, wildcards and fewer specs included; times are datetimes (naive:
UTC) or int ns.
"""

import re
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from due.drivers.query_predicate import FIELDS, QueriedItem, compiled, kind_of, nanoseconds
from due.drivers.query_pushdown import Lookup, Spans, mongo, server_can, sql, time_range
from due.drivers.query_regex import expression
from due.drivers.query_tree import EQUAL_OR_ORDER, INT64, And, Condition, Node, Or, weaken
from due.errors import InvalidQuery
from due.keys import Key

_TIMES = ("timestamp", "eventTime")
_INTEGERS = (*_TIMES, "sequence")
_OPPOSITE = {"gt": "lte", "gte": "lt", "lt": "gte", "lte": "gt"}
_KEY_OPERATORS = ("eq", "in", "regex")
_MOST_LEVELS = 30
_MOST_ELEMENTS = 20_000
_MOST_CHARACTERS = 1_000_000


class ArchiveQuery:
    """A query, checked once and used many times."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._metadata = weaken(node, lambda condition: condition.field != "value")
        #: Whether the query depends on the values of items.
        self.uses_value = self._metadata != node
        #: Decides over any `QueriedItem`.
        self.matches: Callable[[QueriedItem], bool] = compiled(node)
        #: The same without its conditions on values: never refuses what `matches` accepts.
        self.matches_metadata: Callable[[QueriedItem], bool] = compiled(self._metadata)
        #: First and last timestamp, if the query is about keys and times only (the usual case).
        self.time_range = time_range(node)

    def to_sql(self, lookup: Lookup[int], spans: Spans) -> tuple[str, list[Any]]:
        """WHERE clause and parameters over rows that hold one frame each.

        `lookup` gives the ids of the keys (field dataKey) or sources (appId, instanceId) that meet
        a condition.
        """
        parameters: list[Any] = []
        text = sql(self._metadata, lookup, spans, parameters)
        return text, parameters

    def to_mongo(self, lookup: Lookup[str], spans: Spans) -> dict[str, Any]:
        """Filter over documents that hold one frame each; `lookup` gives the keys of a dataKey condition."""
        return mongo(weaken(self.node, server_can), lookup, spans)

    def conditions(self, field: str) -> Iterator[Condition]:
        """The conditions on a field that every result has to meet."""
        parts = self.node.parts if isinstance(self.node, And) else (self.node,)
        return (part for part in parts if isinstance(part, Condition) and part.field == field)


def parse(query: Mapping[str, Any]) -> ArchiveQuery:
    """Check a query; raises InvalidQuery, or InvalidKey for a malformed dataKey."""
    if not isinstance(query, Mapping):
        raise InvalidQuery(f"a query is a mapping of fields to conditions, not {type(query).__name__}")
    _check_size(query)
    return ArchiveQuery(_conjunction(query, negated=False))


def _check_size(query: Mapping[str, Any]) -> None:
    """Bound the size before code that recurses and copies."""
    waiting: list[tuple[Any, int]] = [(query, 1)]
    elements = characters = 0
    while waiting:
        value, level = waiting.pop()
        elements += 1
        if isinstance(value, str | bytes):
            characters += len(value)
        elif isinstance(value, Mapping):
            characters += sum(len(name) for name in value if isinstance(name, str))
            waiting += [(part, level + 1) for part in value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            waiting += [(part, level + 1) for part in value]
        for count, most, what in (
            (level, _MOST_LEVELS, "levels"),
            (elements + len(waiting), _MOST_ELEMENTS, "elements"),
            (characters, _MOST_CHARACTERS, "characters"),
        ):
            if count > most:
                raise InvalidQuery(f"a query has at most {most} {what}; split it")


def _conjunction(query: Mapping[str, Any], *, negated: bool) -> Node:
    return _join([_clause(name, operand, negated=negated) for name, operand in query.items()], either=negated)


def _join(parts: Sequence[Node], *, either: bool) -> Node:
    if len(parts) == 1:
        return parts[0]
    kind = Or if either else And
    # a nested node of the same kind is flattened: conditions on every result stand at the top
    flat = [inner for part in parts for inner in (part.parts if isinstance(part, kind) else (part,))]
    return kind(tuple(flat))


def _clause(name: str, operand: Any, *, negated: bool) -> Node:
    if name in ("$and", "$or", "$nor"):
        if not isinstance(operand, list | tuple) or not operand:
            raise InvalidQuery(f"{name} takes a list of one or more queries, not {_shown(operand)}")
        inner = negated != (name == "$nor")
        either = (name != "$and") != inner
        for part in operand:
            if not isinstance(part, Mapping):
                raise InvalidQuery(f"{name} takes a list of queries, and {_shown(part)} is not one")
        return _join([_conjunction(part, negated=inner) for part in operand], either=either)
    field, _, rest = name.partition(".") if isinstance(name, str) else (name, "", "")
    if field not in FIELDS or (rest and field != "value"):
        fields = ", ".join(f"{known}[.<path>]" if known == "value" else known for known in FIELDS)
        raise InvalidQuery(f"unknown field or operator {_shown(name)} in a query; fields are {fields}")
    return _field(field, tuple(rest.split(".")) if rest else (), operand, negated=negated)


def _field(field: str, path: tuple[str, ...], operand: Any, *, negated: bool) -> Node:
    if isinstance(operand, re.Pattern):
        return _condition(field, path, "regex", expression(field, operand), negated=negated)
    named = (
        [isinstance(key, str) and key.startswith("$") for key in operand]
        if isinstance(operand, Mapping)
        else []
    )
    if not any(named):
        return _condition(field, path, "eq", operand, negated=negated)
    if not all(named):
        raise InvalidQuery(f"{field}: operators and plain fields do not mix in {_shown(operand)}")
    parts = []
    for operator, value in operand.items():
        if operator == "$not":
            if not isinstance(value, Mapping | re.Pattern):
                raise InvalidQuery(f"{field}: $not takes a mapping of operators, not {_shown(value)}")
            parts.append(_field(field, path, value, negated=not negated))
        elif operator == "$regex":
            pattern = expression(field, value, operand.get("$options", ""))
            parts.append(_condition(field, path, "regex", pattern, negated=negated))
        elif operator != "$options":
            parts.append(_operator(field, path, operator, value, negated=negated))
    return _join(parts, either=negated)


def _operator(field: str, path: tuple[str, ...], operator: str, value: Any, *, negated: bool) -> Condition:
    if operator in ("$ne", "$nin"):
        operator, negated = ("$eq" if operator == "$ne" else "$in"), not negated
    name = operator[1:]
    if name not in (*EQUAL_OR_ORDER, "in", "exists", "size"):
        raise InvalidQuery(
            f"{field}: unknown operator {_shown(operator)}; known are $eq $ne $gt $gte $lt $lte $in $nin "
            f"$exists $regex $options $size $not"
        )
    return _condition(field, path, name, value, negated=negated)


def _condition(field: str, path: tuple[str, ...], operator: str, value: Any, *, negated: bool) -> Condition:
    if operator == "in":
        if not isinstance(value, list | tuple | set | frozenset):
            raise InvalidQuery(f"{field}: $in and $nin take a list, not {_shown(value)}")
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


def _operand(field: str, operator: str, value: Any) -> Any:
    if field == "value":
        return _value_operand(operator, value)
    if operator == "size":
        raise InvalidQuery(f"{field}: $size counts the elements of a list, and {field} is not a list")
    if field in _INTEGERS:
        number = nanoseconds(value) if field in _TIMES else value
        if isinstance(number, bool) or not isinstance(number, int) or not -INT64 <= number < INT64:
            kinds = "a datetime or int nanoseconds" if field in _TIMES else "an int of 64 bits"
            raise InvalidQuery(f"{field}: compare with {kinds}, not {_shown(value)}")
        return number
    if not isinstance(value, str):
        raise InvalidQuery(f"{field}: compare with text, not {_shown(value)}")
    if field != "dataKey":
        return value
    if operator not in _KEY_OPERATORS:
        raise InvalidQuery(f"dataKey: ${operator} has no meaning on keys; use $eq, $ne, $in, $nin or $regex")
    return Key.parse(value)


def _value_operand(operator: str, value: Any) -> Any:
    if operator == "size":
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise InvalidQuery(f"value: $size takes a count from 0, not {_shown(value)}")
        return value
    if operator in _OPPOSITE and kind_of(value) not in ("bool", "number", "text", "bytes", "time"):
        raise InvalidQuery(f"value: ${operator} compares numbers, text, bytes or times, not {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    """A value for messages, shortened."""
    return reprlib.repr(value)
