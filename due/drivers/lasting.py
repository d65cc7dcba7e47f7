"""Items that retention deletes last: not measurements, which lose their worth, but what holds until further notice.

other keys      older than `before`, then the oldest until the archive is small enough
lasting keys    older than `Lasting.before`; by size only what exceeds half of the whole archive's limit
"""

from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

from due.errors import InvalidKey
from due.keys import Key

SHARE: Final = 2
"""Lasting items have room for the archive's limit divided by this."""


class Lasting(NamedTuple):
    """Which items last, and from which age not even they.

    Args:
        keys: patterns of their keys.
        before: ns since the epoch; None: they have no age.
    """

    keys: tuple[str, ...] = ()
    before: int | None = None

    def among(self, keys: Collection[str]) -> list[str]:
        """Those of the keys whose items last.

        Args:
            keys: concrete ones, as an archive has them; damaged ones do not last.

        Raises:
            InvalidKey: a pattern breaks the grammar.
        """
        patterns = [Key.parse(pattern) for pattern in self.keys]
        return [key for key in keys if _meets(key, patterns)]


def _meets(key: str, patterns: Sequence[Key]) -> bool:
    try:
        return any(pattern.matches(Key.parse(key)) for pattern in patterns)
    except InvalidKey:
        return False


NOTHING: Final = Lasting()
