"""The C library's heap, of which an app keeps what it ever needed at once: once a minute, what is free goes back.

Without that each new extreme of an app that allocates and frees all day stays: it grows, ever more slowly, for days.
glibc only; other C libraries keep less.
"""

import ctypes
from collections.abc import Callable
from typing import Final

EVERY_S: Final = 60.0


class HeapTrim:
    """Gives free pages back from time to time.

    Args:
        now: s, monotonic; the first time is `EVERY_S` later.
    """

    def __init__(self, now: float) -> None:
        self._due = now + EVERY_S
        self._trim = _malloc_trim()

    def tick(self, now: float) -> bool:
        """Do it when it is time; returns whether it was."""
        if self._trim is None or now < self._due:
            return False
        self._due = now + EVERY_S
        self._trim(0)
        return True


def _malloc_trim() -> Callable[[int], int] | None:
    try:
        found: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None
    return found
