"""Regular expressions of queries, by RE2: time grows with the length of the text alone, whatever the expression.

What cannot be done so (backreferences, lookaround, possessive and atomic groups, option x) is refused. As in
MongoDB \\w, \\d, \\s and \\b are ASCII; `$` means the very end of the text, or of a line with option m.
"""

import re
from typing import Any

from due.errors import InvalidQuery

_MOST_CHARACTERS = 1000
_MOST_MEMORY = 1 << 17
"""Bytes of a compiled expression, which bounds the work per character of a text."""
_FLAGS = {"i": re.IGNORECASE, "m": re.MULTILINE, "s": re.DOTALL}


class Expression:
    """A compiled expression.  Equal texts and options make equal expressions; raises InvalidQuery."""

    __slots__ = ("_search", "text")

    def __init__(self, field: str, pattern: str, options: str = "") -> None:
        unknown = set(options) - set(_FLAGS)
        if unknown:
            raise InvalidQuery(
                f"{field}: unknown $options {''.join(sorted(unknown))!r}; known are {', '.join(_FLAGS)}"
            )
        if len(pattern) > _MOST_CHARACTERS:
            raise InvalidQuery(
                f"{field}: $regex has {len(pattern)} characters; at most {_MOST_CHARACTERS}, use $in for lists"
            )
        letters = "".join(sorted(set(options)))
        self.text = f"(?{letters}){pattern}" if letters else pattern
        re2 = _re2(field)
        settings = re2.Options()
        settings.log_errors = False
        settings.max_mem = _MOST_MEMORY
        settings.never_capture = True
        try:
            # bytes: for str re2 would also compute character positions
            self._search = re2.compile(_bytes(self.text), settings).search
        except re2.error as error:
            raise InvalidQuery(
                f"{field}: $regex {pattern[:80]!r} is not a regular expression that runs in linear time "
                f"(no backreferences, no lookaround): {_said(error)}"
            ) from None

    def search(self, text: str) -> bool:
        """Whether it matches anywhere."""
        return self._search(_bytes(text)) is not None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Expression) and self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)

    def __repr__(self) -> str:
        return f"Expression({self.text!r})"


def expression(field: str, value: Any, options: Any = "") -> Expression:
    """The expression of `$regex` and `$options`, or of a pattern of Python's `re`."""
    if isinstance(value, re.Pattern):
        flags = value.flags & ~(re.UNICODE | re.ASCII)
        options = "".join(letter for letter, flag in _FLAGS.items() if flags & flag)
        if flags & ~(re.IGNORECASE | re.MULTILINE | re.DOTALL):
            raise InvalidQuery(f"{field}: of a pattern's flags only I, M and S are known, not {value.flags}")
        value = value.pattern
    if not isinstance(value, str) or not isinstance(options, str):
        raise InvalidQuery(
            f"{field}: $regex and $options take text, not {type(value).__name__} and {type(options).__name__}"
        )
    return Expression(field, value, options)


def _re2(field: str) -> Any:
    """The module, on demand: DUE does without it until somebody asks for an expression."""
    try:
        import re2
    except ImportError:
        raise InvalidQuery(f"{field}: $regex needs the package google-re2: install it") from None
    return re2


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "replace")


def _said(error: Exception) -> str:
    said = error.args[0] if error.args else ""
    return said.decode("utf-8", "replace") if isinstance(said, bytes) else str(said)
