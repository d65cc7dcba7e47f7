"""A live switch's time while no packet comes.  Pure.

The time of a switch comes with its packets only.  In between, the controller's clock advances it, so that blocks
end and seconds are closed on a silent network.
"""

from typing import Final, Literal

_EVERY_S: Final = 1.0
_SECOND_US: Final = 1_000_000
_UNDER_WAY_US: Final = 100_000
"""A packet may take so long from the switch to here without being older than a tick."""


class LiveClock:
    """Ticks once a second while no packet comes, and at a time that somebody waits for.

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

    def look(self, time_us: int, heard: int, now: float, awaited_us: int = 0) -> int | None:
        """Time that has passed silently, us; None: the packets tell it, or a tick is not due.

        Args:
            time_us: newest time of the switch.
            heard: how many packets it has sent so far.
            now: the caller's monotonic clock, seconds.
            awaited_us: a time at which a tick is due, us; 0: none.
        """
        if not self._ticks:
            return None
        if heard != self._heard:
            self._heard, self._ticked = heard, now
            time_us = time_us or self._started_us
            self._anchor = (time_us, now) if time_us else None
            return None
        if self._anchor is None:
            return None
        base_us, since = self._anchor
        passed_us = base_us + int((now - since) * _SECOND_US) - _UNDER_WAY_US
        if now - self._ticked < _EVERY_S and not 0 < awaited_us <= passed_us:
            return None
        self._ticked = now
        return passed_us
