"""When the SYNs towards a suspected host are examined: at a capture time, whatever the speed of the pipeline.

    suspicion ─► waits for its capture time ─► first examination: guard ─► waits again ─► second: block

Capture time is taken from the newest SYN.  If no more SYNs come, silence decides: as long as the wait
itself on a live switch, and after a tick of the switch's clock where it stands between packets, as in a replay.
Pure; times are capture time in ns and the caller's monotonic clock in seconds.
"""

from dataclasses import dataclass
from typing import Final

from apps.firewall.syn.flood_evidence import Suspicion

HOSTS_WATCHED: Final = 64
AGAIN_MS: Final = 10
"""From a look that came too early to the next: a flood of 5,000 SYNs a second fills the sample within that."""
_SECOND: Final = 1_000_000_000
_SET_BACK: Final = 3600 * _SECOND
"""A SYN that is this far behind the newest one means that a clock was set back."""


@dataclass(frozen=True)
class Examination:
    """The SYNs of `suspicion` up to `at`; `sure`: handshakes have had time to complete."""

    suspicion: Suspicion
    at: int
    sure: bool


@dataclass(frozen=True)
class _Waiting:
    examination: Examination
    patience_s: float
    since: float


class Examinations:
    """Suspicions that wait, at most `most` for each of both examinations."""

    def __init__(self, grace_ms: int, patience_ms: int, most: int = HOSTS_WATCHED) -> None:
        self.live = True
        """Whether capture time advances while no packets arrive."""
        self._grace_s = grace_ms / 1000
        self._patience_s = patience_ms / 1000
        self._most = most
        self._first: dict[tuple[str, int], _Waiting] = {}
        self._second: dict[str, _Waiting] = {}
        self._reached = 0
        """Capture time of the newest SYN."""
        self._ticked = 0
        """Capture time that the switch's clock has reached."""
        self._heard = float("-inf")

    def __len__(self) -> int:
        return len(self._first) + len(self._second)

    def suspect(self, suspicion: Suspicion, now: float) -> float | None:
        """Examine after the grace period; returns it, s, or None where too many wait, or this one does."""
        at = suspicion.now + round(self._grace_s * _SECOND)
        key = suspicion.host, at
        if key in self._first or len(self._first) >= self._most:
            return None
        self._first[key] = _Waiting(Examination(suspicion, at, sure=False), self._grace_s, now)
        return self._grace_s

    def again(self, examined: Examination, now: float, *, soon: bool) -> float | None:
        """Examine once more after a look that came before there was enough to look at.

        Args:
            examined: that look.
            now: monotonic time, s.
            soon: SYNs to the host are being copied; else it may take a grace period until they are.

        Returns:
            How soon, s; None where it waits already or too many do.
        """
        wait_s = min(AGAIN_MS / 1000, self._grace_s) if soon else self._grace_s
        at = max(examined.at + round(wait_s * _SECOND), self._reached if soon else 0)
        key = examined.suspicion.host, at
        if key in self._first or len(self._first) >= self._most:
            return None
        self._first[key] = _Waiting(Examination(examined.suspicion, at, sure=False), wait_s, now)
        return wait_s

    def doubt(self, examined: Examination, now: float) -> None:
        """Examine again when handshakes have had time to complete."""
        host = examined.suspicion.host
        if len(self._second) < self._most and host not in self._second:
            again = Examination(
                examined.suspicion, examined.at + round(self._patience_s * _SECOND), sure=True
            )
            self._second[host] = _Waiting(again, self._patience_s, now)

    def hear(self, until: int, now: float) -> None:
        """SYNs have come, the newest of this capture time."""
        if until < self._reached - _SET_BACK:
            self._reached = self._ticked = until
        self._reached = max(self._reached, until)
        self._heard = now

    def tick(self, until: int) -> None:
        """The switch's clock has reached this capture time."""
        self._ticked = max(self._ticked, until)

    def due(self, now: float) -> list[Examination]:
        """Examinations whose time has come, in order of capture time; they no longer wait."""
        first = {key: each for key, each in self._first.items() if self._is_due(each, now)}
        second = {host: each for host, each in self._second.items() if self._is_due(each, now)}
        for key in first:
            del self._first[key]
        for host in second:
            del self._second[host]
        found = [each.examination for each in (*first.values(), *second.values())]
        return sorted(found, key=lambda each: (each.at, each.sure, each.suspicion.host))

    def _is_due(self, waiting: _Waiting, now: float) -> bool:
        at = waiting.examination.at
        if self._reached >= at:
            return True
        # a tick may overtake SYNs that are still under way
        wait = waiting.patience_s if self.live else self._grace_s
        silent = max(waiting.since, self._heard) + wait <= now
        return silent and (self.live or self._ticked >= at)
