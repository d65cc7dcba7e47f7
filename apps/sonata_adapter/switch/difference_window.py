"""The host's knowledge of one window of a difference that the switch counts."""

from collections.abc import Iterator
from typing import Final

from apps.sonata_adapter.switch.register_tables import Key

MOST_KEYS: Final = 16_384
"""Keys without a cell that are counted in one window; beyond, its results say that they are estimates."""


class DifferenceWindow:
    """The state of one window."""

    def __init__(self) -> None:
        self.told: dict[Key, int] = {}
        """Counts reported by the switch at the window's end."""
        self.ready = 0.0
        """When the reported counts are not held back any more."""
        self.apart: dict[Key, int] = {}
        """Frames or bytes without a cell; subtracted ones are negative."""
        self.unheard: set[Key] = set()
        """Keys that reached the threshold when there was no room to wait in the switch."""
        self.over: float | None = None
        """When the window was found to be over."""
        self.waiting: set[int] = set()
        """Requests about it without an answer."""
        self.read: dict[Key, int] = {}
        self.unsure: set[Key] = set()
        """Keys whose cells were read too late, or not at all."""
        self.done: set[Key] = set()
        """Keys that have been decided."""
        self.errors: dict[str, None] = {}

    def count(self, key: Key, amount: int) -> None:
        """A frame whose key has no cell."""
        if key in self.apart or len(self.apart) < MOST_KEYS:
            self.apart[key] = self.apart.get(key, 0) + amount
        else:
            self.errors[f"more than {MOST_KEYS} keys had no cell in the switch"] = None

    def candidates(self, threshold: int) -> Iterator[Key]:
        """Keys that may be results though the switch has not told them: by what has no cell, as they have at
        most `threshold - 1` in theirs, or because there was no room for them to wait."""
        yield from (
            key
            for key, amount in self.apart.items()
            if threshold - 1 + amount >= threshold and key not in self.done
        )
        yield from (key for key in self.unheard if self.apart.get(key, 0) <= 0 and key not in self.done)

    @property
    def is_open(self) -> bool:
        """Whether it may yield a result without further input."""
        undecided = any(key not in self.done for key in self.told)
        return bool(self.waiting or undecided or (self.over is None and (self.apart or self.unheard)))

    def whole(self) -> Iterator[Key]:
        """Keys that the switch alone has counted."""
        return (key for key in self.told if key not in self.apart and key not in self.done)

    def split(self) -> Iterator[Key]:
        """Keys that the host has counted in part, once the window is over."""
        keys = {**self.apart, **dict.fromkeys(self.unheard)}
        return (
            key
            for key in keys
            if key not in self.done and (key in self.told or key in self.read or key in self.unsure)
        )

    def total(self, key: Key) -> int:
        """The count of a key as far as it is known."""
        cell = self.told.get(key, self.read.get(key, 0))
        return cell + self.apart.get(key, 0)
