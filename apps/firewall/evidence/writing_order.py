"""What an app has numbered → the order in which it wrote it.  Pure: time is an argument (seconds, monotonic).

    contacts   12 · · 15           evidence and training come under keys of their own,
    scores      · 13 · ·           and nothing orders one key with another
    training    · · 14 ·
    in order   12 13 14 15

A decision depends on this order: evidence that is judged before it is known that training is done decides nothing.
"""

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

PATIENCE_S: Final = 0.5
"""A missing number is waited for so long."""
MOST_WAITING: Final = 4_096
MOST_WRITERS: Final = 64

Piece = TypeVar("Piece")


@dataclass(slots=True)
class _Writer(Generic[Piece]):
    next: int = 1
    waiting: dict[int, tuple[float, Piece]] = field(default_factory=dict)
    """By number: when it came, and what it is."""


class WritingOrder(Generic[Piece]):
    """Puts pieces in order, each writer's for itself.  Not thread-safe.

    A number that does not come in time, such as one that was read before a restart, is given up; what has it and
    comes later still is passed on at once.
    """

    def __init__(self) -> None:
        self.missed = 0
        """Numbers that were given up."""
        self._writers: OrderedDict[str, _Writer[Piece]] = OrderedDict()

    def take(self, writer: str, number: int, piece: Piece, now: float) -> list[Piece]:
        """Add a piece.

        Args:
            writer: the instance that has numbered it, from 1 on.
            number: 0 for a piece without order.
            piece: what it is.
            now: monotonic time, seconds.

        Returns:
            What is next, in order: often this piece alone.
        """
        if not number:
            return [piece]
        if writer not in self._writers and len(self._writers) >= MOST_WRITERS:
            _, oldest = self._writers.popitem(last=False)
            found = [each for _, (_, each) in sorted(oldest.waiting.items())]
        else:
            found = []
        known = self._writers.setdefault(writer, _Writer())
        self._writers.move_to_end(writer)
        if number < known.next:
            return [*found, piece]
        known.waiting.setdefault(number, (now, piece))
        found += self._next(known)
        while len(known.waiting) > MOST_WAITING:
            found += self._give_up(known)
        return found

    def overdue(self, now: float) -> list[Piece]:
        """Pieces that have waited long enough for those before them."""
        found: list[Piece] = []
        for known in self._writers.values():
            while known.waiting and known.waiting[min(known.waiting)][0] + PATIENCE_S <= now:
                found += self._give_up(known)
        return found

    def _give_up(self, known: _Writer[Piece]) -> list[Piece]:
        first = min(known.waiting)
        self.missed += first - known.next
        known.next = first
        return self._next(known)

    def _next(self, known: _Writer[Piece]) -> list[Piece]:
        found: list[Piece] = []
        while known.next in known.waiting:
            found.append(known.waiting.pop(known.next)[1])
            known.next += 1
        return found
