"""The last pieces of evidence against each sender, for the decisions that cite them.  Pure."""

from collections import OrderedDict
from typing import Final

from apps.messages import Exhibit, Sender

EVIDENCE_KEPT: Final = 10
SENDERS_KEPT: Final = 10_000
EVIDENCE_HELD_S: Final = 1_800
"""Seconds of capture time after its last piece for which the evidence against a sender is kept."""
_SECOND: Final = 1_000_000_000


class Exhibits:
    """Bounded in three ways: pieces of a sender, senders, and time."""

    def __init__(self) -> None:
        self._by_sender: OrderedDict[Sender, tuple[tuple[Exhibit, ...], int]] = OrderedDict()
        """And the capture time of the last piece; the sender heard of last is the last."""

    def __len__(self) -> int:
        return len(self._by_sender)

    def add(self, sender: Sender, exhibit: Exhibit, now: int) -> None:
        """Keep a piece against a sender, heard of at a capture time, ns."""
        pieces, last = self._by_sender.pop(sender, ((), now))
        self._by_sender[sender] = (*pieces[1 - EVIDENCE_KEPT :], exhibit), max(last, now)
        while len(self) > SENDERS_KEPT or self._oldest() < now - EVIDENCE_HELD_S * _SECOND:
            self._by_sender.popitem(last=False)

    def of(self, sender: Sender) -> tuple[Exhibit, ...]:
        """The pieces against a sender, the oldest first."""
        pieces, _ = self._by_sender.get(sender, ((), 0))
        return pieces

    def _oldest(self) -> int:
        return next(iter(self._by_sender.values()))[1]
