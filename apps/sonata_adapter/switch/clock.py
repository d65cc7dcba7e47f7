"""A switch's clock: its reports, and an estimate in between.  Pure.

The switch reports its time with what it sends; between two reports it is assumed to run as fast
as before.  An estimate is good enough to request counts early, but not to declare a window over.
"""

from typing import Final

_SPAN_S: Final = 0.25
"""The rate is measured over so long at least: reports come in batches."""


class Clock:
    """One switch's clock; `now` is in seconds of the caller's clock."""

    def __init__(self) -> None:
        self.heard_us: int | None = None
        """The latest time that the switch has reported."""
        self._since: float | None = None
        self._anchor: tuple[int, float] | None = None
        self.rate = 1.0
        """Seconds of the switch's clock in one of the caller's."""

    def hear(self, now_us: int) -> None:
        """Note a time report of the switch."""
        if self.heard_us is None or now_us > self.heard_us:
            self.heard_us = now_us
            self._since = None

    def look(self, now: float) -> None:
        """To be called soon after `hear`: what was heard, was heard now."""
        if self._since is not None or self.heard_us is None:
            return
        self._since = now
        if self._anchor is None:
            self._anchor = (self.heard_us, now)
        elif now - self._anchor[1] >= _SPAN_S:
            self.rate = (self.heard_us - self._anchor[0]) / 1e6 / (now - self._anchor[1])
            self._anchor = (self.heard_us, now)

    def idle_s(self, now: float) -> float:
        """Seconds since the clock was heard of."""
        return 0.0 if self._since is None else now - self._since

    def guess_us(self, now: float) -> int | None:
        """Estimate of the clock now, us; None before the first report."""
        return None if self.heard_us is None else self.heard_us + round(self.idle_s(now) * self.rate * 1e6)

    def was_us(self, at: float) -> int | None:
        """What it showed at an earlier `at`, as what was heard since tells."""
        if self.heard_us is None or self._since is None:
            return None
        return self.heard_us - round((self._since - at) * self.rate * 1e6)
