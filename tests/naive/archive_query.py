"""The archives' query dialect read off MongoDB's manual, slow and obvious: a twin for the drivers."""

import datetime as dt
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from due.messages import Item

_NAMES = {
    "dataKey": "key",
    "timestamp": "timestamp",
    "eventTime": "event_time",
    "appId": "app_id",
    "instanceId": "instance_id",
    "sequence": "sequence",
}


def naive_find(items: Iterable[Item], query: Mapping[str, Any]) -> list[Item]:
    """What an archive of these items has to answer, oldest first."""
    found = [item for item in items if _document(item, query)]
    return sorted(found, key=lambda i: (i.timestamp, i.sequence, i.instance_id, i.key))


def _document(item: Item, query: Mapping[str, Any]) -> bool:
    for name, operand in query.items():
        if name == "$and":
            holds = all(_document(item, part) for part in operand)
        elif name == "$or":
            holds = any(_document(item, part) for part in operand)
        elif name == "$nor":
            holds = not any(_document(item, part) for part in operand)
        else:
            holds = _field(name, _candidates(item, name), operand)
        if not holds:
            return False
    return True


def _candidates(item: Item, name: str) -> list[Any]:
    if name in _NAMES:
        return [getattr(item, _NAMES[name])]
    found = [item.value]
    for step in name.split(".")[1:]:
        deeper: list[Any] = []
        for value in found:
            if isinstance(value, Mapping) and step in value:
                deeper.append(value[step])
            if isinstance(value, list):
                if step.isdigit() and int(step) < len(value):
                    deeper.append(value[int(step)])
                deeper += [part[step] for part in value if isinstance(part, Mapping) and step in part]
        found = deeper
    return found


def _field(name: str, values: list[Any], operand: Any) -> bool:
    if isinstance(operand, Mapping) and any(str(key).startswith("$") for key in operand):
        return all(_operator(name, values, op, arg, operand) for op, arg in operand.items())
    return _operator(name, values, "$eq", operand, {})


def _operator(name: str, values: list[Any], op: str, arg: Any, whole: Mapping[str, Any]) -> bool:
    if op == "$not":
        return not _field(name, values, arg)
    if op in ("$ne", "$nin"):
        return not _operator(name, values, {"$ne": "$eq", "$nin": "$in"}[op], arg, whole)
    if op == "$in":
        return any(_operator(name, values, "$eq", one, whole) for one in arg)
    if op == "$exists":
        return bool(values) == bool(arg)
    if op == "$options":
        return True
    if op == "$size":
        return any(isinstance(v, list) and len(v) == arg for v in values)
    if op == "$eq" and arg is None and not values:
        return True
    spread = values + [e for v in values if isinstance(v, list) for e in v]
    if op == "$regex":
        pattern = f"(?{whole['$options']}){arg}" if whole.get("$options") else arg
        return any(isinstance(v, str) and re.search(pattern, v) for v in spread)
    if name == "dataKey":
        return any(_key(arg, v) for v in values)
    return any(_compare(op, v, arg) for v in spread)


def _compare(op: str, value: Any, arg: Any) -> bool:
    value, arg = _time(value), _time(arg)
    numbers = [isinstance(x, int | float) and not isinstance(x, bool) for x in (value, arg)]
    if all(numbers):
        if math.isnan(value) or math.isnan(arg):
            return math.isnan(value) and math.isnan(arg) and op in ("$eq", "$gte", "$lte")
    elif type(value) is not type(arg):
        return False
    if op == "$eq":
        return bool(value == arg)
    if isinstance(value, list | dict | None):
        return False
    less, more = value < arg, value > arg
    return bool({"$gt": more, "$gte": not less, "$lt": less, "$lte": not more}[op])


def _time(value: Any) -> Any:
    if isinstance(value, dt.datetime):
        aware = value if value.tzinfo else value.replace(tzinfo=dt.UTC)
        since = aware - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
        return (since.days * 86_400_000_000 + since.seconds * 1_000_000 + since.microseconds) * 1000
    if isinstance(value, np.datetime64):
        return int(value.astype("datetime64[ns]").astype("int64"))
    return value


def _key(pattern: str, key: str) -> bool:
    """Segments by regular expression; every spec of the pattern in the key."""
    path, _, specs = pattern.partition(":")
    there, _, given = key.partition(":")
    expression = (
        re.escape(path).replace(r"\.\*\*", r"(\..+)?").replace(r"\*\*", ".+").replace(r"\*", r"[^.]+")
    )
    if not re.fullmatch(expression, there):
        return False
    have = dict(spec.split("=") for spec in given.split(",")) if given else {}
    for name, value in (spec.split("=") for spec in specs.split(",")) if specs else ():
        if name not in have or (value != "*" and have[name] not in value.split("|")):
            return False
    return True
