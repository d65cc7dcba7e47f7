"""Online detection of anomalies in the readings of one printer, trained on good prints of that printer.

    readings ──standardise──► CUSUM of the level, both ways ─┐
                          └─► CUSUM of the spread ───────────┴► alarm

Page, Continuous inspection schemes, Biometrika 1954.  Each printer has small errors of its own, so each has its own
mean and standard deviation.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from manufacturing.core import faults

TRAINING: Final = 480
"""Readings of good prints that a detector is trained on: four hours of printing."""
_SLACK: Final = 0.75
"""Of the level: a mean that moves by less than twice this many standard deviations is no anomaly."""
_SPREAD_SLACK: Final = 1.5
_CAP: Final = 12.0
"""What one reading may add, so that a single outlier raises no alarm."""
_BOUND: Final = 14.0
_SPREAD_BOUND: Final = 36.0
_COMMISSIONING: Final = 1_000_000_000
"""Numbers of the batches of readings of commissioning prints begin here."""


def commissioning_prints(seed: int, machine: int) -> NDArray[np.float64]:
    """Readings of the good prints with which a printer was commissioned, shape (`TRAINING`, 2)."""
    printed = np.arange(1, TRAINING + 1, dtype=np.float64) * 30.0
    return faults.readings(seed, machine, _COMMISSIONING, printed, None)


class AnomalyDetector:
    """The detector of one printer.

    Args:
        good: readings of good prints, shape (n, 2).
    """

    def __init__(self, good: NDArray[np.float64]) -> None:
        self._mean = good.mean(axis=0)
        self._spread = good.std(axis=0, ddof=1)
        self.reset()

    def reset(self) -> None:
        """Forget what was seen: the printer was maintained."""
        self._sums = [0.0] * 6

    def alarm(self, readings: Sequence[tuple[float, float]]) -> str:
        """What is wrong after further readings; empty for nothing."""
        if not readings:
            return ""
        standard = (np.asarray(readings) - self._mean) / self._spread
        for row in standard.tolist():
            for sensor, name in enumerate(("nozzle temperature", "filament flow")):
                found = self._add(sensor * 3, row[sensor])
                if found:
                    return f"{name} {found}"
        return ""

    def _add(self, at: int, deviation: float) -> str:
        sums = self._sums
        limited = max(-_CAP / 2, min(_CAP / 2, deviation))
        sums[at] = max(0.0, sums[at] + limited - _SLACK)
        sums[at + 1] = max(0.0, sums[at + 1] - limited - _SLACK)
        sums[at + 2] = max(0.0, sums[at + 2] + min(_CAP, deviation * deviation) - 1 - _SPREAD_SLACK)
        if sums[at] > _BOUND:
            return "too high"
        if sums[at + 1] > _BOUND:
            return "too low"
        return "erratic" if sums[at + 2] > _SPREAD_BOUND else ""
