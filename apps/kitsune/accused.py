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

    def __len__(self) -> int:
        return len(self._until)

    def accuse(self, mac: int, now: float) -> None:
        """Note evidence against a sender at a capture time, s."""
        self._until[mac] = now + FOR_S
        self._until.move_to_end(mac)
        while len(self._until) > MOST:
            self._until.popitem(last=False)

    def benign(self, batch: Columns, now: float) -> npt.NDArray[np.bool_] | None:
        """The rows of a batch that neither come from one of them nor go to one; None: all."""
        while self._until and next(iter(self._until.values())) <= now:
            self._until.popitem(last=False)
        if not self._until:
            return None
        if len(self._until) <= _FEW:
            rows = np.ones(len(batch["eth_src"]), dtype=np.bool_)
            for mac in self._until:
                rows &= (batch["eth_src"] != mac) & (batch["eth_dst"] != mac)
            return rows
        macs = np.array(list(self._until), dtype=np.int64)
        found: npt.NDArray[np.bool_] = ~(np.isin(batch["eth_src"], macs) | np.isin(batch["eth_dst"], macs))
        return found
