"""BMv2 JSON as a document: what is refused before anybody asks what it means.

    bytes ── size ── json ── depth, number of values ──► dict ── program.py ──► tree

Every number that ends up in generated code has passed `whole` or `hexadecimal`, so that it is an `int`.

DataplaneError
└── ProgramError    not JSON, too large, too deep, a number out of range
"""

import json
from collections.abc import Collection, Hashable, Iterable
from typing import Any, NoReturn

from dataplane.errors import ProgramError

Json = dict[str, Any]

MAX_BYTES = 8 << 20
"""Size of the document; the product's program has 1 MB."""
MAX_DEPTH = 200
"""Levels of lists and objects; the product's program has 75."""
MAX_VALUES = 1 << 20
"""Lists, objects, texts and numbers; the product's program has 71,000."""
MAX_HEX_DIGITS = 4096
MAX_NAME = 1000
"""Characters of a name."""
MOST = {
    "header_types": 1024,
    "headers": 1024,
    "header_stacks": 256,
    "field_lists": 1024,
    "errors": 1024,
    "field_aliases": 4096,
    "meter_arrays": 1024,
    "counter_arrays": 1024,
    "register_arrays": 1024,
    "calculations": 1024,
    "learn_lists": 256,
    "actions": 8192,
    "checksums": 256,
    "parsers": 1,
    "deparsers": 1,
    "pipelines": 2,
}
"""How many of each a program may have; parts of it not named here are refused or not read."""
_HINT = "compile the program with p4c-bm2-ss"


def document(data: bytes | str) -> Json:
    """The document as Python has it, within the limits above.

    Raises ProgramError.
    """
    if len(data) > MAX_BYTES:
        raise ProgramError(f"BMv2 JSON of {len(data)} bytes; at most {MAX_BYTES} are taken")
    try:
        found = json.loads(data, object_pairs_hook=_object, parse_float=_no_float, parse_constant=_no_float)
    except (ValueError, RecursionError) as error:
        raise ProgramError(f"not BMv2 JSON: {error}; {_HINT}") from error
    _measure(found)
    if not isinstance(found, dict) or "pipelines" not in found:
        raise ProgramError(f"not BMv2 JSON: no pipelines in it; {_HINT}")
    for name, most in MOST.items():
        part = found.get(name, [])
        if not isinstance(part, list):
            raise ProgramError(f"malformed BMv2 JSON: {name} is not a list; {_HINT}")
        if len(part) > most:
            raise ProgramError(f"BMv2 JSON with {len(part)} {name}; at most {most} are taken")
    return found


def _object(pairs: list[tuple[str, Any]]) -> Json:
    made = dict(pairs)
    if len(made) != len(pairs):
        raise ValueError("an object has the same name twice")
    return made


def _no_float(text: str) -> NoReturn:
    raise ValueError(f"the number {text[:20]} is not an integer")


def _measure(found: Any) -> None:
    """Depth and number of values, without recursion."""
    level, depth, values = [found], 0, 1
    while level:
        depth += 1
        below: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                below += item.values()
            elif isinstance(item, list):
                below += item
        values += len(below)
        if depth > MAX_DEPTH + 1:
            raise ProgramError(f"BMv2 JSON nested deeper than {MAX_DEPTH} levels")
        if values > MAX_VALUES:
            raise ProgramError(f"BMv2 JSON of more than {MAX_VALUES} values")
        level = below


def whole(value: Any, low: int, high: int, what: str) -> int:
    """An integer of the document.  Raises ProgramError where it is none, or not within low..high."""
    if type(value) is not int or not low <= value <= high:
        shown = repr(value)[:40] if isinstance(value, int | str) else type(value).__name__
        raise ProgramError(f"{what} is {shown}, and not within {low}..{high}")
    return value


def hexadecimal(text: Any) -> int:
    """A number written like 0x1f.  Raises ProgramError."""
    if not isinstance(text, str) or len(text) > MAX_HEX_DIGITS:
        raise ProgramError(
            f"{repr(text)[:40]} is not a number of at most {MAX_HEX_DIGITS} hexadecimal digits"
        )
    return int(text, 16)


def once(items: Iterable[Json], by: str, what: str) -> list[Json]:
    """The items, each with another `by` (id or name).  Raises ProgramError."""
    listed = list(items)
    seen: set[Hashable] = set()
    for item in listed:
        if item[by] in seen:
            raise ProgramError(f"two {what} have the same {by} {item[by]!r:.60}")
        seen.add(item[by])
    return listed


def limited(items: Collection[Any], most: int, what: str) -> Collection[Any]:
    """The items, if they are not too many.  Raises ProgramError."""
    if len(items) > most:
        raise ProgramError(f"{len(items)} {what}; at most {most} are taken")
    return items
