"""Which keys cross a bridge in one direction: what is allowed and wanted.  Pure.

allowed a.**, wanted a.b.*   ─► receive a.b.*
allowed a.b.*, wanted a.**   ─► receive a.b.*
allowed a.*.c, wanted a.b.*  ─► receive a.*.c, and let a.b.c pass
"""

from collections.abc import Iterable
from typing import Final

from due.drivers.redis_rights import covers
from due.errors import InvalidOption
from due.keys import Key

_MOST_KNOWN: Final = 65_536
"""Paths whose answer is remembered."""


class BridgedKeys:
    """The keys of one direction.

    Args:
        allowed: key patterns; what they say behind a colon does not count.

    Raises:
        InvalidKey: one breaks the grammar.
    """

    def __init__(self, allowed: Iterable[str]) -> None:
        self.allowed = tuple(dict.fromkeys(Key.parse(Key.parse(key).path) for key in allowed))
        self.patterns: frozenset[str] = frozenset()
        """What has to be received."""
        self._wanted: tuple[Key, ...] = ()
        self._known: dict[str, bool] = {}

    def want(self, keys: Iterable[str]) -> None:
        """Replace what the other site wants; what is not allowed is left out."""
        wanted = tuple(dict.fromkeys(Key.parse(Key.parse(key).path) for key in keys))
        self._wanted = tuple(one for one in wanted if any(each.offers(one) for each in self.allowed))
        found = {_narrower(each, one) for one in self._wanted for each in self.allowed if each.offers(one)}
        # a message that two patterns match would be received twice
        self.patterns = frozenset(
            one for one in found if not any(other != one and covers(other, one) for other in found)
        )
        self._known = {}

    def may_cross(self, path: str) -> bool:
        """Whether frames of this path are both allowed and wanted."""
        answer = self._known.get(path)
        if answer is None:
            if len(self._known) >= _MOST_KNOWN:
                self._known = {}
            answer = self._known[path] = all(
                any(one.matches_path(path) for one in keys) for keys in (self.allowed, self._wanted)
            )
        return answer

    def check_apart(self, other: "BridgedKeys") -> None:
        """Raises InvalidOption if something could cross in both directions: it would go round for ever."""
        for here in self.allowed:
            for there in other.allowed:
                if here.offers(there):
                    raise InvalidOption(
                        f"{here} crosses in one direction and {there} in the other, and some keys belong to both: "
                        "they would go round for ever; narrow one of them"
                    )


def _narrower(allowed: Key, wanted: Key) -> str:
    return wanted.path if covers(allowed.path, wanted.path) else allowed.path
