"""Attributes of objects as plain values for JSON, and back with every type checked.  Pure.

    dict ◄──► list of pairs     set, tuple, deque ◄──► list     numbers and texts as they are

Only the attributes that a table of kinds names are read or set, so what comes from outside makes no object of a class
that the table does not know.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Mapping
from types import UnionType
from typing import Any, Final, get_args, get_origin

MOST_DEPTH: Final = 8
MOST_ENTRIES: Final = 1 << 22
"""Of one container."""


class SubjectName:
    """The kind of what names a subject: a text, a number, None, or a tuple of such names."""


def plain(value: Any) -> Any:
    """A value with containers as lists.

    Args:
        value: numbers, texts, None and containers of them.
    """
    if isinstance(value, Mapping):
        return [[plain(key), plain(each)] for key, each in value.items()]
    if isinstance(value, list | tuple | set | frozenset | deque):
        return [plain(each) for each in value]
    return value


def built(value: Any, kind: Any, depth: int = 0) -> Any:
    """The inverse of `plain`.

    Args:
        value: as `plain` returned it, from anywhere.
        kind: what it should be: a type, a generic container, a union with None, or `SubjectName`.
        depth: of the containers around it.

    Raises:
        ValueError: it is of another kind.
    """
    if depth > MOST_DEPTH:
        raise ValueError("values are nested too deeply")
    if kind is SubjectName:
        return _name(value, depth)
    if isinstance(kind, UnionType):
        return None if value is None else built(value, get_args(kind)[0], depth)
    if (origin := get_origin(kind)) is not None:
        return _container(value, origin, get_args(kind), depth)
    if kind is float and type(value) is int:
        return value  # a number that began as 0
    if type(value) is not kind:
        raise ValueError(f"{type(value).__name__} in place of {kind.__name__}")
    return value


def _name(value: Any, depth: int) -> Any:
    if isinstance(value, list):
        return tuple(built(each, SubjectName, depth + 1) for each in _entries(value))
    if value is not None and type(value) not in (str, int, bool, float):
        raise ValueError(f"{type(value).__name__} as a name")
    return value


def _entries(value: Any) -> list[Any]:
    if not isinstance(value, list) or len(value) > MOST_ENTRIES:
        raise ValueError(f"{type(value).__name__} in place of a list of at most {MOST_ENTRIES:,}")
    return value


def _container(value: Any, origin: Any, kinds: tuple[Any, ...], depth: int) -> Any:
    entries = _entries(value)
    if origin in (dict, Counter, OrderedDict):
        of = kinds if origin is not Counter else (*kinds, int)
        pairs = [_fixed(pair, of, depth + 1) for pair in entries]
        return origin(dict(pairs))
    if origin is tuple and kinds[-1] is not Ellipsis:
        return _fixed(value, kinds, depth)
    return origin(built(each, kinds[0], depth + 1) for each in entries)


def _fixed(value: Any, kinds: tuple[Any, ...], depth: int) -> tuple[Any, ...]:
    entries = _entries(value)
    if len(entries) != len(kinds):
        raise ValueError(f"{len(entries)} values in place of {len(kinds)}")
    return tuple(built(each, kind, depth + 1) for each, kind in zip(entries, kinds, strict=True))


Kinds = Mapping[str, Any]
"""Attributes of an object, and the kind of each."""


def read(parts: Iterable[tuple[object, Kinds]]) -> list[list[Any]]:
    """The attributes of objects, in order.

    Args:
        parts: the objects, and which of their attributes.
    """
    return [[plain(getattr(each, name)) for name in kinds] for each, kinds in parts]


def restore(parts: Iterable[tuple[object, Kinds]], values: Any) -> None:
    """The inverse of `read`, for objects of the same classes.

    Args:
        parts: the objects, and which of their attributes.
        values: as `read` returned them, from anywhere.

    Raises:
        ValueError: they are of another kind.
    """
    parts = list(parts)
    if len(_entries(values)) != len(parts):
        raise ValueError(f"values of {len(values)} objects in place of {len(parts)}")
    for (each, kinds), found in zip(parts, values, strict=True):
        for name, value in zip(kinds, _fixed(found, tuple(kinds.values()), 0), strict=True):
            setattr(each, name, value)
