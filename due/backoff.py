"""When to try again: exponential back-off with jitter.  Pure: time is an argument (seconds, monotonic)."""

import random

LONGEST_S = 2.0
"""Somebody who lost a server tries again at least so often."""


class Backoff:
    """Delays of `first`, doubling up to `longest` seconds, each shortened by up to a half at random."""

    def __init__(self, first: float = 0.05, longest: float = LONGEST_S) -> None:
        self._first = first
        self._longest = longest
        self._delay = first
        self._at = 0.0

    def failed(self, now: float) -> float:
        """Note a failure; returns how long to wait, seconds."""
        delay = self._delay * random.uniform(0.5, 1.0)
        self._delay = min(self._delay * 2, self._longest)
        self._at = now + delay
        return delay

    def succeeded(self) -> None:
        """Start again with the first delay."""
        self._delay = self._first
        self._at = 0.0

    def due(self, now: float) -> bool:
        """Whether it is time to try."""
        return now >= self._at

    def wait(self, now: float) -> float:
        """Seconds until it is."""
        return max(0.0, self._at - now)
