"""Flows seen in a window, so that operators about flows receive only a few packets of each."""

from typing import Final

import numpy as np

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.host.key_tables import alike

_SLOTS: Final = 1 << 16


class SeenFlows:
    """The first packet of each flow in a window, and few others, however many flows there are.

    A flow (addresses, protocol, ports) is remembered by its 64 bits in the one slot that they point to,
    until another flow takes it.
    """

    def __init__(self) -> None:
        self._slots = np.zeros(_SLOTS, dtype=np.uint64)
        self._window = 0

    def begin(self, window: int) -> None:
        """Start a window; flows of another window are forgotten."""
        if window != self._window:
            self._window = window
            self.forget()

    def new(self, packets: PacketColumns) -> PacketColumns:
        """The packets without those of flows that are remembered; these are remembered from now on."""
        keys = packets.flows()
        home = (keys & np.uint64(_SLOTS - 1)).view(np.int64)
        (rest,) = (self._slots[home] != keys).nonzero()
        if not len(rest):
            return packets.at(rest)
        keys, home = keys[rest], home[rest]
        (kept,) = (alike(keys, _SLOTS) == np.arange(len(keys))).nonzero()
        self._slots[home[kept]] = keys[kept]
        return packets.at(rest[kept])

    def forget(self) -> None:
        """Forget all flows, for an operator that has not seen them yet."""
        self._slots[:] = 0
