"""Where a pass with blocking may run freely: away from everything that a dry run of the same capture has shown.

    signs of the dry run ──► spans of capture time ──► packets at which the loop has to keep up; others go freely

Until the first decision both passes are the same, so nothing is decided where the dry run saw no sign.  After it they
differ, and the dry run tells nothing any more.  Pure; times are capture time, ns.
"""

from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

BEFORE_NS: Final = 10_000_000_000
"""Capture time before a sign in which the loop keeps up already: the switch's part in queries has to be as well."""
AFTER_NS: Final = 5_000_000_000
"""And after it: a flood's SYNs are sampled and examined after its report."""


class QuietStretches:
    """The stretches of a capture without a sign, as far as a dry run can tell, and whether it was right so far.

    Args:
        time_ns: capture time of each packet, in the order of the capture.
        signs: capture times of what may lead to a decision.
        decided: capture time of the first decision; None if there was none.
    """

    def __init__(
        self, time_ns: NDArray[np.int64], signs: Collection[int], decided: int | None = None
    ) -> None:
        at = np.unique(np.fromiter(signs, np.int64, len(signs)))
        apart = np.diff(at) > BEFORE_NS + AFTER_NS
        self._begins = at[np.concatenate(([True], apart))[: len(at)]] - BEFORE_NS
        self._ends = at[np.concatenate((apart, [True]))[: len(at)]] + AFTER_NS
        loud = self._is_loud(time_ns)
        if decided is not None:
            behind = time_ns >= decided - BEFORE_NS
            loud[int(behind.argmax()) if behind.any() else len(loud) :] = True
        self._edges = np.flatnonzero(np.diff(loud, prepend=False, append=True))
        """Indices at which quiet and loud packets take turns; those before the first are quiet."""
        self._over = False

    def end(self, index: int) -> int:
        """Where the quiet stretch that a packet is in ends.

        Args:
            index: of the packet.

        Returns:
            Index of the first packet behind the stretch; `index` itself if the packet is in none.
        """
        passed = int(np.searchsorted(self._edges, index, side="right"))
        return index if self._over or passed % 2 else int(self._edges[passed])

    def hear(self, time_ns: int, *, decision: bool = False) -> None:
        """Take a sign of this pass: behind a decision, or one that the dry run had not, no stretch is quiet any more."""
        if decision or not self._is_loud(np.array([time_ns], np.int64))[0]:
            self._over = True

    def _is_loud(self, time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        span = np.searchsorted(self._begins, time_ns, side="right") - 1
        found: NDArray[np.bool_] = span >= 0
        if len(self._ends):
            found &= time_ns <= self._ends[span]
        return found


def laps(time_ns: NDArray[np.int64], ahead_ns: int) -> int:
    """Rounds through the loop where nothing is sent that is later than the oldest packet in flight by more than this.

    Args:
        time_ns: capture time of each packet.
        ahead_ns: how much later.

    Returns:
        About as many rounds, however many packets may be in flight.
    """
    return int(np.count_nonzero(np.diff(time_ns // ahead_ns))) + 1 if len(time_ns) else 0
