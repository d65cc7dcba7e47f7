"""Where a replay stops to hear what is decided, while a block may take effect: by capture times alone.  Pure.

    capture time, in cells of the reaction time ──► laps of so many packets at most ──► a block holds from the next lap on

Neither the window nor the machine's speed moves the end of a lap, so two replays drop the same packets.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

REACTION_NS: Final = 500_000_000
"""Capture time that may pass from a packet to a remedy for it: more than that takes on a wire."""

LEAST_REACTION_S: Final = 0.001
MOST_REACTION_S: Final = 60.0


class Laps:
    """Laps through the loop: all packets of one are sent, and what they lead to holds from the next one on.

    Args:
        time_ns: capture time of each packet, in the order of the capture.
        reaction_ns: no packet of a lap is later than another of it by so much.
        most: packets of a lap.
    """

    def __init__(self, time_ns: NDArray[np.int64], reaction_ns: int, most: int) -> None:
        self._time_ns = time_ns
        cells = (time_ns - time_ns.min(initial=_LATEST)) // reaction_ns
        begins = np.flatnonzero(np.diff(cells, prepend=-1))
        lengths = np.diff(begins, append=len(time_ns))
        places = np.arange(len(time_ns)) - np.repeat(begins, lengths)
        self._begins = np.flatnonzero(places % most == 0)

    def __len__(self) -> int:
        return len(self._begins)

    def end(self, index: int, before_ns: int | None = None) -> int:
        """Where the lap that a packet is in ends.

        Args:
            index: of the packet.
            before_ns: if the lap has a packet of this capture time or later, it ends before it.

        Returns:
            Index of the first packet behind the lap, at least `index + 1`.
        """
        after = int(np.searchsorted(self._begins, index, side="right"))
        end = int(self._begins[after]) if after < len(self._begins) else len(self._time_ns)
        if before_ns is not None:
            late = self._time_ns[index:end] >= before_ns
            end = index + int(late.argmax()) if late.any() else end
        return max(end, index + 1)


_LATEST: Final = np.iinfo(np.int64).max
