"""Measured rates: packets a second by condition of the classifier, from counters and copies.  Pure."""

from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

from apps.sonata_adapter.planner.cell_needs import CellNeeds

_SPAN_US: Final = 1_000_000
"""A rate is measured over at least this much capture time."""


class _Total(NamedTuple):
    packets: int
    time_us: int


class _Rate(NamedTuple):
    condition: str
    per_s: float


class MeasuredRates:
    """What the switches' packets have been like since the last look."""

    def __init__(self) -> None:
        self._totals: dict[tuple[str, str], _Total] = {}
        self._rates: dict[tuple[str, str], _Rate] = {}
        self.cells = CellNeeds()
        """How many keys are counted."""

    def note(self, switch: str, name: str, match: Mapping[str, Any], packets: int, time_us: int) -> None:
        """Take a total.

        Args:
            switch: whose packets they are.
            name: what counts them; each counts packets of one condition.
            match: the condition; none: every packet.
            packets: total; a smaller one than before begins anew.
            time_us: capture time of the total.
        """
        key = (switch, name)
        before = self._totals.get(key)
        if before is None or packets < before.packets or time_us < before.time_us:
            self._totals[key] = _Total(packets, time_us)
            return
        span_us = time_us - before.time_us
        if span_us >= _SPAN_US:
            self._totals[key] = _Total(packets, time_us)
            self._rates[key] = _Rate(_text(match), (packets - before.packets) / span_us * 1e6)

    def keep(self, names: Iterable[str]) -> None:
        """Forget what is counted by any other name."""
        kept = set(names)
        self._totals = {key: total for key, total in self._totals.items() if key[1] in kept}
        self._rates = {key: rate for key, rate in self._rates.items() if key[1] in kept}

    def of(self, match: Mapping[str, Any]) -> float | None:
        """Packets a second of a condition on all switches; None where nobody counts them."""
        condition = _text(match)
        found: dict[str, float] = {}
        for (switch, _), rate in self._rates.items():
            if rate.condition == condition:
                # behind a distinct an entry counts fewer than its condition has
                found[switch] = max(rate.per_s, found.get(switch, 0.0))
        return sum(found.values()) if found else None


def _text(match: Mapping[str, Any]) -> str:
    return repr(sorted(match.items()))
