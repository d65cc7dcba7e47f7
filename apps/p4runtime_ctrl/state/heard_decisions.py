"""Decisions heard live, which the archive need not have yet.  Pure.

    block ─► block, extended ─► unblock     the last word about each is kept
                                  └─► for an hour: the archive has heard it by then, or never will

A lift is needed as long as the archive may have what it lifts, and not the lift itself.
"""

from collections import OrderedDict
from collections.abc import Iterator
from operator import itemgetter
from typing import Final

from apps.messages import Decision
from apps.p4runtime_ctrl.state.history import as_remembered
from apps.standing_decisions import STANDING

MOST: Final = 10_000
"""Decisions that stand, and as many that were lifted."""
LIFTS_HELD_S: Final = 3_600
"""Seconds of capture time for which a lift is kept."""
_SECOND: Final = 1_000_000_000

_Name = tuple[str, str]
"""Id and switch: a guard is told to each switch that comes, under the same id."""
_Heard = tuple[int, int, Decision]
"""Place in the order of hearing, and when it was written."""


class HeardDecisions:
    """The last word about each decision, without what led to it."""

    def __init__(self) -> None:
        self._standing: OrderedDict[_Name, _Heard] = OrderedDict()
        self._lifts: OrderedDict[_Name, _Heard] = OrderedDict()
        self._heard = 0

    def __len__(self) -> int:
        return len(self._standing) + len(self._lifts)

    def __iter__(self) -> Iterator[tuple[int, Decision]]:
        """When each was written, and the decision, in the order of hearing."""
        heard = sorted([*self._standing.values(), *self._lifts.values()], key=itemgetter(0))
        return ((at, decision) for _, at, decision in heard)

    def hear(self, decision: Decision, at: int = 0) -> None:
        """Take a decision.

        Args:
            decision: as it was heard.
            at: when it was written, wall time, ns.
        """
        self._heard += 1
        name = decision.id, decision.switch
        self._standing.pop(name, None)
        self._lifts.pop(name, None)
        kept = self._standing if decision.action in STANDING else self._lifts
        kept[name] = self._heard, at, as_remembered(decision)
        while len(kept) > MOST:
            kept.popitem(last=False)
        while self._lifts and _time(self._lifts) < decision.event_time - LIFTS_HELD_S * _SECOND:
            self._lifts.popitem(last=False)


def _time(lifts: OrderedDict[_Name, _Heard]) -> int:
    *_, oldest = next(iter(lifts.values()))
    return oldest.event_time
