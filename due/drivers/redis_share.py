"""Which streams one member of a group reads, and on which it still works.

    share(shards) ──► reads? ──► asked for ──► given to us ──► acknowledged
                        no          └────── held ──────┘

What is asked for counts as held until the answer is here, so that a stream that another member gets next is held by
nobody in between.
"""

import threading
from collections.abc import Iterable

from due.drivers.base import Delivery


class StreamShare:
    """Thread-safe: one thread reads, another one changes the share and looks at what is held."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._mine: frozenset[str] | None = None
        """None: every stream."""
        self._asked: set[str] = set()
        self._undone: dict[str, set[str]] = {}
        """By path the tokens of deliveries that are not acknowledged."""

    def change(self, shards: frozenset[str] | None, paths: Iterable[str]) -> list[str]:
        """From now on read these shards; returns which of `paths` were not read before."""
        with self._lock:
            gained = [path for path in paths if not self.reads(path) and (shards is None or path in shards)]
            self._mine = shards
            return gained

    def reads(self, path: str) -> bool:
        """Whether this member reads a stream."""
        return self._mine is None or path in self._mine

    def ask(self, path: str) -> bool:
        """Whether this member reads a stream; then a request for it follows."""
        with self._lock:
            if self._mine is not None and path not in self._mine:
                return False
            self._asked.add(path)
            return True

    def answered(self) -> None:
        """Nothing is asked for any more."""
        with self._lock:
            self._asked.clear()

    def given(self, deliveries: Iterable[Delivery]) -> None:
        """These are handed out."""
        with self._lock:
            for delivery in deliveries:
                self._undone.setdefault(delivery.path, set()).add(delivery.token)

    def done(self, delivery: Delivery) -> None:
        """It is acknowledged."""
        with self._lock:
            tokens = self._undone.get(delivery.path)
            if tokens is not None:
                tokens.discard(delivery.token)
                if not tokens:
                    del self._undone[delivery.path]

    def abandon(self, path: str) -> None:
        """What was handed out of a stream is another member's."""
        with self._lock:
            self._undone.pop(path, None)

    def held(self, paths: Iterable[str]) -> tuple[str, ...]:
        """Those of `paths` that are this member's, and all on which it still works."""
        with self._lock:
            mine = set(paths) if self._mine is None else self._mine.intersection(paths)
            return tuple(sorted({*mine, *self._asked, *self._undone}))
