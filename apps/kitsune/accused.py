"""Senders from which nothing is learnt for a while, because there is evidence against them.  Pure."""

from collections import OrderedDict
from typing import Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.kernel import Columns

LEAST_NATS: Final = 5.0
"""Evidence of this weight, or a block, makes a sender suspect: the firewall's bound is never lower."""
FOR_S: Final = 3_600.0
"""Seconds of capture time after the last sign."""
MOST: Final = 4_096
_FEW: Final = 16
"""Senders for whom one comparison each is quicker than a search."""


class Accused:
    """MAC addresses of senders that were accused lately."""

    def __init__(self) -> None:
        self._until: OrderedDict[int, float] = OrderedDict()
        self._sorted: npt.NDArray[np.uint64] | None = None

    def __len__(self) -> int:
        return len(self._until)

    def accuse(self, mac: int, now: float) -> None:
        """Note evidence against a sender at a capture time, s."""
        if mac not in self._until:
            self._sorted = None
        self._until[mac] = now + FOR_S
        self._until.move_to_end(mac)
        while len(self._until) > MOST:
            self._until.popitem(last=False)

    def macs(self, now: float) -> npt.NDArray[np.uint64]:
        """Those that are accused at a capture time, ascending."""
        while self._until and next(iter(self._until.values())) <= now:
            self._until.popitem(last=False)
            self._sorted = None
        if self._sorted is None:
            self._sorted = np.array(sorted(self._until), dtype=np.uint64)
        return self._sorted

    def benign(self, batch: Columns, now: float) -> npt.NDArray[np.bool_] | None:
        """The rows of a batch that neither come from one of them nor go to one; None: all."""
        if not len(self.macs(now)):
            return None
        source, target = batch["eth_src"], batch["eth_dst"]
        if len(self._until) <= _FEW:
            rows = np.ones(len(source), dtype=np.bool_)
            for mac in self._until:
                rows &= (source != mac) & (target != mac)
            return rows
        macs = np.array(list(self._until), dtype=np.int64)
        found: npt.NDArray[np.bool_] = ~(np.isin(source, macs) | np.isin(target, macs))
        return found
