"""The time of a network of which parts come late: that of the switch that is furthest behind.  Pure.

    packets that Spark has read ─► the newest of each switch ─┐
    states, when all packets before them were read ───────────┴─► the least, of the switches that are not idle ─► Spark

Spark has one time for all windows, and drops packets that are behind it.  So packets do not move it: of two switches
one may be minutes behind the other on Kafka.  The driver moves it.
"""

from collections.abc import Iterable, Mapping
from typing import Final

_TELL_AGAIN_S: Final = 10.0
"""The topic of the times is short: what Spark could not read in time is told again."""


class SlowestSwitch:
    """The time that all switches have reached which are not idle.

    Args:
        switches: their names.
        now: monotonic time, s.
        idle_s: a switch whose time has stood still for so long, and of which nothing is left to read, holds no other
            switch up.
    """

    def __init__(self, switches: Iterable[str], now: float, idle_s: float) -> None:
        self._idle_s = idle_s
        self._reached = dict.fromkeys(switches, 0)
        self._moved = dict.fromkeys(self._reached, now)
        self._idle: set[str] = set()
        self._told = 0
        self._told_at = now

    @property
    def idle(self) -> list[str]:
        """Switches that hold no other one up."""
        return sorted(self._idle)

    def move(self, times: Mapping[str, int], now: float) -> None:
        """All packets of a switch that are older than this were read.

        Args:
            times: switch to capture time, us.
            now: monotonic time, s.
        """
        for switch, time_us in times.items():
            if time_us > self._reached.get(switch, time_us):
                self._reached[switch] = time_us
                self._moved[switch] = now
                self._idle.discard(switch)

    def all_read(self, noted: float) -> None:
        """Everything was read that had been written at this monotonic time, s."""
        self._idle = {name for name, moved in self._moved.items() if moved <= noted - self._idle_s}

    def next(self, now: float) -> int:
        """Capture time to be told, us: a later one, or the same again; 0 for none."""
        live = [time_us for switch, time_us in self._reached.items() if switch not in self._idle]
        reached = max(self._told, min(live) if live else max(self._reached.values(), default=0))
        if reached == self._told and now < self._told_at + _TELL_AGAIN_S:
            return 0
        self._told, self._told_at = reached, now
        return reached
