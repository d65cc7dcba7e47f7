"""When decisions end, so that the time is told then and not up to a second later.  Pure.

A block in a switch ends by the firewall's word, and the firewall learns the time from the switch's state, which is
published once a second.
"""

import heapq
from typing import Final

from apps.messages import Decision

_MOST: Final = 100_000
"""Ends that are kept; a decision beyond them ends with the next state, as always."""
_US: Final = 1000


class DecisionEnds:
    """The ends of decisions in the order in which they come; lifted and extended ones may be among them."""

    def __init__(self) -> None:
        self._ends: list[int] = []
        self.next_us: int = 0
        """The next end, us; 0: none."""

    def add(self, decision: Decision) -> None:
        """Note the end of a decision, if it has one."""
        if decision.expires and not decision.action.startswith("un") and len(self._ends) < _MOST:
            heapq.heappush(self._ends, -(-decision.expires // _US))
            self.next_us = self._ends[0]

    def pass_until(self, time_us: int) -> bool:
        """Forget the ends up to a time; returns whether there were any."""
        passed = False
        while self._ends and self._ends[0] <= time_us:
            heapq.heappop(self._ends)
            passed = True
        self.next_us = self._ends[0] if self._ends else 0
        return passed
