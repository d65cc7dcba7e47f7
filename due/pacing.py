"""Limiting a key to its assigned rate without a thread per key.  Pure: time is an argument (ns).

`latest`: at most one item each period; a newer value replaces the one that waits.
`queue`: items leave in order, one each period; `full` makes the writer wait.
"""

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

_LONGEST_QUEUE = 10_000


class Pacer(Generic[T]):
    """The pace of one key."""

    def __init__(self, frequency: float, *, queue: bool = False) -> None:
        self.frequency = frequency
        self.queue = queue
        self.replaced = 0
        """Items that a newer one replaced."""
        self._period = int(1e9 / frequency)
        self._due = 0
        self._waiting: deque[T] = deque(maxlen=None if queue else 1)

    def offer(self, item: T, now: int) -> T | None:
        """The item if it may be sent now; None if it has to wait."""
        if not self._waiting and now >= self._due:
            self._due = (
                max(self._due + self._period, now + self._period // 2) if self._due else now + self._period
            )
            return item
        self.replaced += not self.queue and bool(self._waiting)
        self._waiting.append(item)
        return None

    def release(self, now: int) -> T | None:
        """The waiting item that is due; None if there is none."""
        if not self._waiting or now < self._due:
            return None
        self._due = max(self._due + self._period, now + self._period // 2)
        return self._waiting.popleft()

    def drain(self) -> list[T]:
        """Remove and return all waiting items."""
        items = list(self._waiting)
        self._waiting.clear()
        return items

    @property
    def full(self) -> bool:
        """Whether the queue is full, so that the writer has to wait."""
        return len(self._waiting) >= _LONGEST_QUEUE

    def due(self) -> int | None:
        """When the next waiting item may be sent; None if none waits."""
        return self._due if self._waiting else None
