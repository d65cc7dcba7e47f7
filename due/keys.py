"""Keys: their grammar, and which keys match which.

    key      = segment *("." segment) [":" spec *("," spec)]          at most 1,024 bytes
    segment  = one or more of A-Z a-z 0-9 _ -   | "*" (one segment)   | "**" (last only: any number)
    spec     = name "=" value       : , = % * | and white space in values are percent-encoded

A spec value may be `*` (any) or a list `a|b`: the values that a capability offers or an interest accepts.
No I/O.
"""

import re
from functools import lru_cache
from typing import Self
from urllib.parse import unquote_to_bytes

from due.errors import InvalidKey

MAX_BYTES = 1024
ANY = "*"
ANY_NUMBER = "**"

_SEGMENT = re.compile(r"[A-Za-z0-9_-]+")
_NAME = re.compile(r"[A-Za-z0-9_-]+")
_RESERVED = frozenset(":,=%*|")
_BAD_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2})")

Specs = dict[str, frozenset[str]]


class Key:
    """A parsed key.  Equal keys have the same canonical `text`.

    Args:
        text: a key in the grammar above.

    Raises:
        InvalidKey: the text breaks the grammar; the error names the position.
    """

    __slots__ = ("path", "segments", "specs", "text")

    text: str
    """Canonical form: specs sorted by name, lists sorted, percent-encoding only where needed."""
    path: str
    """The segments alone: what comes before the colon."""
    segments: tuple[str, ...]
    specs: Specs
    """Name to accepted values, percent-encoded; `{"*"}` accepts any."""

    def __init__(self, text: str) -> None:
        if not isinstance(text, str):
            raise InvalidKey(repr(text), 0, f"a key is a str, not {type(text).__name__}")
        path, colon, tail = text.partition(":")
        self.segments = _segments(text, path)
        self.path = path
        self.specs = _specs(text, tail, len(path) + 1) if colon else {}
        self.text = path + (":" + ",".join(map(_spec_text, sorted(self.specs.items()))) if self.specs else "")
        for form in (text, self.text):
            if len(form) > MAX_BYTES // 4 and len(form.encode("utf-8", "surrogatepass")) > MAX_BYTES:
                raise InvalidKey(text, MAX_BYTES, f"a key has at most {MAX_BYTES} bytes")

    @classmethod
    def parse(cls, key: "str | Key") -> "Key":
        """Parse a key, with a cache of recent texts.

        Args:
            key: text, or a Key, which is returned as it is.

        Returns:
            The parsed key.

        Raises:
            InvalidKey: the text breaks the grammar.
        """
        return key if isinstance(key, Key) else _parsed(key)

    @property
    def concrete(self) -> bool:
        """Whether items can be written under this key: it has no wildcard and no list."""
        return ANY not in self.path and all(len(v) == 1 and ANY not in v for v in self.specs.values())

    @property
    def exact_path(self) -> bool:
        """Whether no segment is a wildcard."""
        return ANY not in self.path

    def matches(self, item: "Key") -> bool:
        """Whether an observer of this key receives items of another.

        The segments must match, and the item's key must have every spec of this key. Fewer specs match more
        items.

        Args:
            item: the concrete key of an item.

        Returns:
            True if the observer receives the item.
        """
        if self.path != item.path and not _overlap(self.segments, item.segments):
            return False
        return _accepts(self.specs, item.specs)

    def matches_path(self, path: str) -> bool:
        """Whether the segments match a path.

        Args:
            path: a concrete path, without specs.

        Returns:
            True if they match.
        """
        return self.path == path or _overlap(self.segments, tuple(path.split(".")))

    def offers(self, interest: "Key") -> bool:
        """Whether a capability of this key can satisfy an interest.

        Args:
            interest: wildcards count on both sides.

        Returns:
            True if at least one concrete key belongs to both.
        """
        if not _overlap(self.segments, interest.segments):
            return False
        return _accepts(interest.specs, self.specs)

    def with_specs(self, **specs: str) -> Self:
        """This key with more specs.

        Args:
            specs: name to plain text, which gets percent-encoded.

        Returns:
            A new key.

        Raises:
            InvalidKey: a name breaks the grammar, or is given twice.
        """
        parts = [_spec_text(spec) for spec in self.specs.items()]
        parts += [f"{name}={encode(value)}" for name, value in specs.items()]
        return type(self)(f"{self.path}:{','.join(parts)}" if parts else self.path)

    def spec(self, name: str, default: str = "") -> str:
        """The value of a spec.

        Args:
            name: the name of the spec.
            default: returned if the key has no such spec.

        Returns:
            The decoded value; several values are joined by `|`.
        """
        values = self.specs.get(name)
        return default if values is None else decode("|".join(sorted(values)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Key) and self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"Key({self.text!r})"


def encode(value: str) -> str:
    """A spec value as it stands in a key: reserved characters and white space percent-encoded."""
    return "".join(_escape(c) if c in _RESERVED or c.isspace() else c for c in value)


def decode(value: str) -> str:
    """The inverse of `encode`."""
    return unquote_to_bytes(value).decode("utf-8", "replace") if "%" in value else value


def canonical(key: str) -> str:
    """The canonical spelling of a key.

    Args:
        key: a key in any spelling.

    Returns:
        Its canonical text.

    Raises:
        InvalidKey: the key breaks the grammar.
    """
    return Key.parse(key).text


def matches(pattern: str, item: str) -> bool:
    """Whether an observer of `pattern` receives items of the concrete key `item`."""
    return Key.parse(pattern).matches(Key.parse(item))


@lru_cache(maxsize=4096)
def _parsed(text: str) -> Key:
    return Key(text)


def _escape(char: str) -> str:
    return "".join(f"%{byte:02X}" for byte in char.encode("utf-8", "surrogatepass"))


def _segments(key: str, path: str) -> tuple[str, ...]:
    segments = tuple(path.split("."))
    position = 0
    for index, segment in enumerate(segments):
        if segment == ANY_NUMBER and index != len(segments) - 1:
            raise InvalidKey(key, position, "'**' may only be the last segment")
        if segment not in (ANY, ANY_NUMBER) and not _SEGMENT.fullmatch(segment):
            bad = _SEGMENT.match(segment)
            rule = "a segment is '*', '**' or one or more of A-Z a-z 0-9 _ -"
            raise InvalidKey(key, position + (bad.end() if bad else 0), rule)
        position += len(segment) + 1
    return segments


def _specs(key: str, tail: str, position: int) -> Specs:
    specs: Specs = {}
    for part in tail.split(","):
        name, equals, value = part.partition("=")
        if not _NAME.fullmatch(name):
            raise InvalidKey(key, position, "a spec is name=value, the name of A-Z a-z 0-9 _ -")
        if not equals:
            raise InvalidKey(key, position + len(name), f"the spec {name!r} has no '=value'")
        if name in specs:
            raise InvalidKey(key, position, f"the spec {name!r} is given twice")
        specs[name] = _values(key, value, position + len(name) + 1)
        position += len(part) + 1
    return specs


def _values(key: str, text: str, position: int) -> frozenset[str]:
    if text == ANY:
        return frozenset((ANY,))
    for index, char in enumerate(text):
        if char in ":=*" or char.isspace():
            raise InvalidKey(key, position + index, f"{char!r} in a value is written {_escape(char)}")
    bad = _BAD_ESCAPE.search(text)
    if bad:
        raise InvalidKey(key, position + bad.start(), "'%' is followed by two hexadecimal digits")
    try:
        return frozenset(_canonical_value(value) for value in text.split("|"))
    except UnicodeError:
        raise InvalidKey(key, position, "the percent-encoded value is not UTF-8") from None


def _canonical_value(value: str) -> str:
    return encode(unquote_to_bytes(value).decode()) if "%" in value else value


def _spec_text(spec: tuple[str, frozenset[str]]) -> str:
    return f"{spec[0]}={'|'.join(sorted(spec[1]))}"


def _overlap(left: tuple[str, ...], right: tuple[str, ...]) -> bool:
    for a, b in zip(left, right, strict=False):
        if ANY_NUMBER in (a, b):
            return True
        if a != b and ANY not in (a, b):
            return False
    if len(left) == len(right):
        return True
    longer, length = (left, len(right)) if len(left) > len(right) else (right, len(left))
    shorter = right if longer is left else left
    return shorter[-1] == ANY_NUMBER or longer[length:] == (ANY_NUMBER,)


def _accepts(wanted: Specs, offered: Specs) -> bool:
    for name, values in wanted.items():
        there = offered.get(name)
        if there is None:
            return False
        if ANY not in values and ANY not in there and values.isdisjoint(there):
            return False
    return True
