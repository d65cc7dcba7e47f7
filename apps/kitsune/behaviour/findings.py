"""Findings: what a statistic counted beyond its baseline, weighed, and reported as far as it is new.  Pure.

sliding sums ──► Baseline ──nats──► FoundSoFar ──what is new──► Finding
"""

import math
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from apps.kitsune.behaviour.baseline import LEAST_SCALE, WINDOWS_S, Baseline, SlidingSums
from apps.kitsune.behaviour.rows import SenderId

Statistic = Literal[
    "contacts",
    "ports",
    "targets",
    "logins",
    "callbacks",
    "one_way",
    "claims",
    "thefts",
    "strangers",
    "scores",
    "threshold",
    "fingerprint",
]
HALF_LIFE_S: Final = 600.0
"""Seconds after which half of a finding is forgotten if nothing is added."""
LEAST_NATS: Final = 1.0
"""Less is not worth a message ..."""
LEAST_STEP: Final = 0.5
"""... nor is less than this beside what was said already ..."""
LEAST_SHARE: Final = 0.15
"""... nor, where more than `DECIDING_NATS` were said already, less than this share of it ..."""
DECIDING_NATS: Final = 20.0
MOST_NATS: Final = 50.0
"""... nor anything beyond, since it decides everything."""
LONGEST_SHARE: Final = 1 / 3
"""Of training: a count of ten minutes cannot be compared with five minutes of training."""
KEPT: Final = 65_536


class Finding(msgspec.Struct, frozen=True):
    """More than training saw; `nats` is what has been added since the last finding about the same subject."""

    statistic: Statistic
    sender: SenderId | None
    """None: strangers towards a victim."""
    victim: int
    """Address; 0: several."""
    service: int
    """As in `contacts`; -1: several."""
    nats: float
    total: float
    """With what was found before."""
    count: float
    """In the window that weighs most."""
    window_s: float
    usual: float
    """The highest of training."""
    begun: float
    """Capture time of the first packet that it rests on, seconds."""
    time: float
    arrival: int
    supporting: bool = False
    """Alone it proves nothing: a conversation that both sides want, or a sender that training knows."""


class FoundSoFar:
    """What was reported about each subject, fading with time."""

    def __init__(self) -> None:
        self._reported: dict[Any, tuple[float, float]] = {}
        """By subject the nats that were reported, and when, seconds."""

    def added(self, subject: Any, nats: float, time: float) -> float:
        """The part that is new, if it is worth a message; else 0."""
        former = self._reported.get(subject)
        faded = 0.0
        if former is not None:
            faded = former[0] * 0.5 ** (max(0.0, time - former[1]) / HALF_LIFE_S)
        nats = min(nats, MOST_NATS)
        least = LEAST_SHARE * faded if faded > DECIDING_NATS else LEAST_STEP
        if nats < LEAST_NATS or nats - faded < least:
            return 0.0
        if former is None and len(self._reported) >= KEPT:
            del self._reported[next(iter(self._reported))]
        self._reported[subject] = (nats, time)
        return nats - faded

    def until(self, subject: Any, nats: float) -> float:
        """Until when so many nats about a subject, `MOST_NATS` at least, are not worth another message; seconds."""
        former, time = self._reported.get(subject, (0.0, 0.0))
        half_lives = math.log2(max(1.0, former * (1 + LEAST_SHARE) / max(nats, MOST_NATS)))
        return time + half_lives * HALF_LIFE_S


class SeenCount(NamedTuple):
    """What a count adds: the part of a finding that comes from its statistic."""

    nats: float
    total: float
    events: float
    window_s: float
    usual: float
    begun: float


class StatisticCounter:
    """One statistic: sliding sums, their baseline, and what was reported."""

    def __init__(
        self,
        least_scale: float = LEAST_SCALE,
        windows: tuple[float, ...] = WINDOWS_S,
        *,
        own: bool = True,
        rates: bool = False,
    ) -> None:
        self.sums = SlidingSums(windows)
        self.baseline = Baseline(len(windows), least_scale, own=own, rates=rates)
        self.found = FoundSoFar()
        self.usable = len(windows)

    def trained(self, seconds: float) -> None:
        """Training has ended: of a longer window than a third of it too little is known."""
        self.usable = max(1, sum(window <= seconds * LONGEST_SHARE for window in self.sums.windows))

    def see(
        self, subject: Any, whose: Any, time: float, block: int, weight: float = 1.0, kind: Any = None
    ) -> SeenCount | None:
        """Count, and weigh the sums."""
        return self.weigh(whose, self.sums.add(subject, time, weight), time, block, kind)

    def weigh(
        self, whose: Any, sums: tuple[float, ...], time: float, block: int, kind: Any = None
    ) -> SeenCount | None:
        """Learn sums within the windows, or weigh them; None if nothing is worth a message."""
        if block >= 0:
            self.baseline.learn(whose, block, sums, kind)
            return None
        seen = self.measure(whose, sums, kind)
        added = self.found.added((whose, kind), seen.total, time) if seen.total >= LEAST_NATS else 0.0
        return seen._replace(nats=added) if added else None

    def measure(self, whose: Any, sums: tuple[float, ...], kind: Any) -> SeenCount:
        """Weigh sums, whatever was found before."""
        nats, which, usual = self.baseline.nats(whose, sums[: self.usable], kind)
        return SeenCount(0.0, nats, sums[which], self.sums.windows[which], usual, self.sums.begun[which])


def usual_score_of(scores: npt.NDArray[np.float64]) -> float:
    """The score that one benign packet in a hundred reaches, and never less than a tenth of the paper's threshold."""
    finite = scores[np.isfinite(scores) & (scores > 0)]
    if not len(finite):
        return 1.0
    return max(math.exp(float(np.quantile(np.log(finite), 0.99))), 0.1)
