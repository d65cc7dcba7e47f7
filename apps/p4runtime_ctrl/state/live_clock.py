"""A live switch's time while no packet comes.  Pure.

The switch tells its time with its packets only.  In between, the controller's clock carries it on, so that blocks
end and seconds are closed on a network where nobody says anything.
"""

from typing import Final, Literal

_EVERY_S: Final = 1.0
_SECOND_US: Final = 1_000_000
_UNDER_WAY_US: Final = 100_000
"""A packet may take so long from the switch to here without being older than a tick."""


class LiveClock:
    """Ticks once a second while no packet comes.

    Args:
        kind: "packets" never ticks; "heard" ticks after the first packet, "own" also before it.
        started_us: time of the switch when this object is made, us since the epoch; for "own".
    """

    def __init__(self, kind: Literal["packets", "heard", "own"], started_us: int = 0) -> None:
        self._ticks = kind != "packets"
        self._heard: int | None = None
        self._anchor: tuple[int, float] | None = None
        self._started_us = started_us if kind == "own" else 0
        self._ticked = float("-inf")

    def look(self, time_us: int, heard: int, now: float) -> int | None:
        """Time that has passed silently, us; None: the packets tell it, or a tick is not due.

        Args:
            time_us: newest time of the switch.
            heard: how many packets it has sent so far.
            now: the caller's monotonic clock, seconds.
        """
        if not self._ticks:
            return None
        if heard != self._heard:
            self._heard, self._ticked = heard, now
            time_us = time_us or self._started_us
            self._anchor = (time_us, now) if time_us else None
            return None
        if self._anchor is None or now - self._ticked < _EVERY_S:
            return None
        self._ticked = now
        base_us, since = self._anchor
        return base_us + int((now - since) * _SECOND_US) - _UNDER_WAY_US
