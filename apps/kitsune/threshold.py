"""The threshold between normal and anomalous scores: fixed, or from the tail of benign scores.

Benign scores are close to log-normal (as the published example suggests), so the threshold that a given
number of packets per hour exceed by chance follows from the mean and spread of their logarithms.
"""

import math
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]
_UPPER = 0.99
_TINY = 1e-300
_MOST_LOG = 700.0


@dataclass(frozen=True, slots=True)
class Benign:
    """The distribution of benign scores."""

    packets: int
    log_mean: float
    log_spread: float
    packets_per_hour: float

    @classmethod
    def of(cls, scores: _Array, seconds: float) -> "Benign":
        """Fits scores that were seen within some seconds of capture time; `ValueError` for less than two.

        The spread is the larger of the standard deviation and that of the upper hundredth,
        because the threshold depends on the upper tail, which is often heavier.
        """
        logs = np.log(scores[np.isfinite(scores) & (scores > 0)])
        if len(logs) < 2:
            raise ValueError(f"a fit needs at least 2 positive scores, not {len(logs)}")
        middle, upper = np.quantile(logs, (0.5, _UPPER))
        spread = max(float(logs.std()), float(upper - middle) / NormalDist().inv_cdf(_UPPER))
        rate = len(scores) / max(seconds, 1.0) * 3600
        return cls(len(scores), float(logs.mean()), spread, rate)

    def threshold(self, false_alarms_per_hour: float) -> float:
        """The score that this many benign packets an hour exceed; raises `ValueError` unless it is above 0."""
        if not false_alarms_per_hour > 0:
            raise ValueError(f"false_alarms_per_hour={false_alarms_per_hour}: must be greater than 0")
        tail = min(false_alarms_per_hour / self.packets_per_hour, 0.5)
        return math.exp(min(self.log_mean - NormalDist().inv_cdf(tail) * self.log_spread, _MOST_LOG))

    def drift(self, scores: _Array) -> float:
        """Shift of the median of other benign scores, in spreads; 0 = none."""
        finite = scores[np.isfinite(scores)]
        if not len(finite):
            return 0.0
        moved = math.log(max(float(np.median(finite)), _TINY)) - self.log_mean
        return moved / max(self.log_spread, 1e-9)

    def to_state(self) -> dict[str, Any]:
        """Plain values, for the model file; `Benign(**state)` is the inverse."""
        return asdict(self)


class Calibration:
    """Collects the first scores after training and fits them once there are enough."""

    def __init__(self, packets: int, benign: Benign | None = None) -> None:
        if packets < 2:
            raise ValueError(f"calibration_packets={packets}: must be at least 2")
        self.benign = benign
        self._wanted = packets
        self._scores: list[_Array] = []
        self._count = 0
        self._begun = 0.0

    def add(self, scores: _Array, seconds: _Array) -> bool:
        """Takes scores and their capture times; True when this completed the fit."""
        if self.benign is not None or not len(scores):
            return False
        if not self._scores:
            self._begun = float(seconds[0])
        share = scores[: self._wanted - self._count]
        self._scores.append(share)
        self._count += len(share)
        if self._count < self._wanted:
            return False
        self.close(float(seconds[len(share) - 1]))
        return True

    def close(self, now: float) -> None:
        """Fits the scores so far, if they are enough."""
        scores = np.concatenate(self._scores) if self._scores else np.zeros(0)
        if self.benign is None and (np.isfinite(scores) & (scores > 0)).sum() > 1:
            self.benign = Benign.of(scores, abs(now - self._begun))
        self._scores = []
