"""Notation for the command line: addresses in keys, times such as `1h`, sizes in place of long values."""

import re
import time
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from sdnator.errors import BadInput

_UNITS_NS = {
    "ms": 10**6,
    "s": 10**9,
    "min": 60 * 10**9,
    "m": 60 * 10**9,
    "h": 3_600 * 10**9,
    "d": 86_400 * 10**9,
}
_DURATION = re.compile(r"(\d+(?:\.\d+)?)(ms|s|min|m|h|d)")
_MOST_DAYS = 36_500
_YEARS = range(1900, 2201)
"""Times in ns within and near them fit the archives' 64 bits."""


def typed_key(text: str) -> str:
    """The canonical form of a typed key: addresses in specs need not be encoded.  Raises BadInput."""
    from due.errors import InvalidKey
    from due.keys import Key, encode

    path, colon, specs = text.partition(":")
    encoded = []
    for spec in specs.split(",") if colon else ():
        name, equals, value = spec.partition("=")
        values = (
            one if one == "*" or re.search("%[0-9A-F]{2}", one) else encode(one) for one in value.split("|")
        )
        encoded.append(name + equals + "|".join(values))
    try:
        return Key.parse(path + colon + ",".join(encoded)).text
    except InvalidKey as error:
        raise BadInput(str(error)) from None


def duration_ns(text: str, option: str) -> int:
    """`30s`, `10m`, `1.5h`, `7d` as ns; raises BadInput."""
    found = _DURATION.fullmatch(text.strip())
    if found is None:
        raise BadInput(f"{option} {text}: give a time such as 30s, 10m, 1h or 7d")
    length = float(found[1]) * _UNITS_NS[found[2]]
    if length > _MOST_DAYS * _UNITS_NS["d"]:
        raise BadInput(f"{option} {text}: give at most {_MOST_DAYS}d")
    return round(length)


def instant_ns(text: str, now: int, option: str) -> int:
    """A time ago, or a point in time (local unless it names its zone), as ns since the epoch; raises BadInput."""
    if _DURATION.fullmatch(text.strip()):
        return now - duration_ns(text, option)
    try:
        when = datetime.fromisoformat(text.strip())
    except ValueError:
        raise BadInput(
            f"{option} {text}: give a time ago such as 1h, or one such as 2024-05-01T12:00"
        ) from None
    if when.year not in _YEARS:
        raise BadInput(f"{option} {text}: give a year from {_YEARS[0]} to {_YEARS[-1]}")
    return int(when.timestamp()) * 10**9 + when.microsecond * 1_000


def period_ns(since: str, until: str) -> tuple[int, int]:
    """Begin and end of a period as ns since the epoch, the end not included.

    Args:
        since: as for `instant_ns`.
        until: the same; empty: now.

    Raises:
        BadInput: one is no time, or the period is empty.
    """
    now = time.time_ns()
    begin, end = instant_ns(since, now, "--since"), instant_ns(until, now, "--until") if until else now + 1
    if begin >= end:
        raise BadInput(f"--since {since}: give a time before the end of the period")
    return begin, end


def local_time(time_ns: int, *, fraction: bool = False) -> str:
    """A time in this machine's time zone, which it names; to the second, or to the millisecond."""
    when = datetime.fromtimestamp(time_ns // 10**9).astimezone()
    part = f".{time_ns % 10**9 // 10**6:03d}" if fraction else ""
    return f"{when:%Y-%m-%d %H:%M:%S}{part} {when:%Z}"


def brief(value: Any) -> Any:
    """A value fit for one line of JSON: batches, arrays and bytes by their size."""
    import numpy as np

    from coordinator.views import value as as_json
    from due import RecordBatch

    if isinstance(value, RecordBatch):
        return f"{len(value)} records of {', '.join(value.columns)}"
    if isinstance(value, np.ndarray):
        return f"{value.size} of {value.dtype}"
    if isinstance(value, bytes | memoryview):
        return f"{len(value)} bytes"
    if isinstance(value, Mapping):
        return {str(name): brief(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [brief(part) for part in value]
    return as_json(value)
