"""Loss between exporter and collector, by the sequence numbers of what arrives."""

from typing import Final

_ROUND: Final = 1 << 32
_MOST_GAP: Final = 1 << 20
"""A larger gap is a restart of the exporter."""
_MOST_LATE: Final = 1 << 12
"""Numbers that lie further back are a restart, not a datagram that was overtaken."""


class SequenceGaps:
    """One stream of numbered units: datagrams (NetFlow v9, sFlow), records (IPFIX) or flows (NetFlow v5)."""

    def __init__(self) -> None:
        self.lost = 0
        """Units that never arrived."""
        self.reordered = 0
        """Messages that arrived after later ones."""
        self.restarts = 0
        """Jumps that no loss explains."""
        self._next: int | None = None

    def hear(self, sequence: int, units: int | None) -> None:
        """Note a message.

        Args:
            sequence: number of its first unit, 0 to 2^32 - 1.
            units: how many it holds; None: unknown, so that the next message says nothing about loss.
        """
        if self._next is not None:
            ahead = (sequence - self._next) % _ROUND
            if self._fills_gap(ahead, units or 0):
                return
            if ahead <= _MOST_GAP:
                self.lost += ahead
            else:
                self.restarts += 1
        self._next = None if units is None else (sequence + units) % _ROUND

    def _fills_gap(self, ahead: int, units: int) -> bool:
        """Whether it is a message that was overtaken, and counted as lost."""
        if not units or units > self.lost or _ROUND - ahead > _MOST_LATE:
            return False
        self.reordered += 1
        self.lost -= units
        return True
