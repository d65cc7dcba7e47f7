"""What the host knows of one window whose counts are read from the switch."""

from typing import Final

from apps.sonata_adapter.switch.register_tables import Key

MOST_KEYS: Final = 16_384
"""Keys of one window that are asked for; a result that would need more says that it is an estimate."""


class RegisterWindow:
    """What is known of one window."""

    def __init__(self) -> None:
        self.candidates: set[Key] = set()
        self.pending: dict[Key, None] = {}
        """Candidates of which nothing has been reported."""
        self.unasked: dict[bool, list[Key]] = {False: [], True: []}
        """Keys to be asked for: early, and when the window is over."""
        self.beyond = 0
        self.apart: dict[tuple[int, Key], int] = {}
        """By bit of the reduce: frames or bytes of keys without a cell."""
        self.tuples: dict[tuple[int, Key], set[Key]] = {}
        """By bit of the reduce: new tuples of the distinct before it that had no cell."""
        self.cells: dict[tuple[int, Key], int] = {}
        """By bit of the reduce: what was read, the largest of several answers."""
        self.reported: set[tuple[int, Key]] = set()
        self.waiting: set[int] = set()
        self.early: float | None = None
        """When cells were first asked for early."""
        self.early_counts = False
        """That was after the window's end, as what was heard since tells."""
        self.over: float | None = None
        """When the window was known to be over."""
        self.settled = False
        """No reports are under way any more."""
        self.doubtful: set[Key] = set()
        """Candidates with a count that is lost."""
        self.unsure: set[Key] = set()
        """Candidates whose counts came late, though what is known of them was still there."""
        self.errors: dict[str, None] = {}

    def remember(self, key: Key) -> None:
        if key in self.candidates:
            return
        if len(self.candidates) >= MOST_KEYS:
            self.beyond += 1
            return
        self.candidates.add(key)
        self.pending[key] = None
        for keys in self.unasked.values():
            keys.append(key)
