"""What the other site wants, held for a while after it is wanted no more.  Pure.

An app that restarts, or a Coordinator that is replaced, withdraws for a moment what it wants; forgetting it at once
would forget how far the bridge is with the streams of this site, too.
"""

from collections.abc import Iterable, Mapping
from typing import Final

from due.keys import Key
from due.messages import Assignment

HELD_S: Final = 60.0


class RemoteInterests:
    """Keys and their rates, by the assignments of the other site's Coordinator."""

    def __init__(self) -> None:
        self._rates: dict[str, float | None] = {}
        self._until: dict[str, float] = {}
        """Of keys that are wanted no more: when they are forgotten."""

    def assign(self, assignments: Iterable[Assignment], now: float) -> None:
        """Take up the current assignments.  `now`: s, monotonic."""
        rates: dict[str, float | None] = {}
        for one in assignments:
            before = rates.get(one.key, 0.0)
            rates[one.key] = None if before is None or one.frequency is None else max(before, one.frequency)
        for key in self._rates:
            if key not in rates:
                self._until.setdefault(key, now + HELD_S)
        for key in rates:
            self._until.pop(key, None)
        self._rates = {key: rate for key, rate in self._rates.items() if key not in rates} | rates

    def wanted(self, now: float) -> Mapping[str, float | None]:
        """Keys and rates, Hz (None: every item), without those whose time is over."""
        for key in [key for key, until in self._until.items() if until <= now]:
            del self._until[key], self._rates[key]
        return self._rates


def rate_of(pattern: str, wanted: Mapping[str, float | None]) -> float | None:
    """The highest rate of the wanted keys that a pattern serves; None: every item."""
    parsed = Key.parse(pattern)
    rates = [rate for key, rate in wanted.items() if parsed.offers(Key.parse(Key.parse(key).path))]
    known = [rate for rate in rates if rate is not None]
    return max(known, default=None) if len(known) == len(rates) else None
