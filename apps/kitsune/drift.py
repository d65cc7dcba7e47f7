"""Whether benign scores of the last day have left the distribution of training.  Pure.

    training   the score that one packet in a hundred exceeds; the share over it in each tenth of training, by the
               score of the other nine tenths
    afterwards the share over it in each half hour of the last day

Scores follow one another closely, so packets are no independent draws: tenths and half hours are the units, and are
resampled with replacement.  A notice is given when the mean share of the day, at the lower end of what resampling
yields (0.1 %), lies above the limit: five times the share of training, or twice the upper end (99.9 %) of what
resampling training yields, whichever is more.  The factors are there because a model scores what it learnt from better
than what follows.  The mean is over half hours, not packets, so that one loud backup does not make a day.

Source: the block bootstrap of Kuensch (The Annals of Statistics 17, 1989), with blocks that do not overlap
(Carlstein, 1986).
"""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]
QUANTILE: Final = 0.99
BLOCK_S: Final = 1_800
DAY_BLOCKS: Final = 48
LEAST_BLOCKS: Final = 12
"""Half hours with packets within the last day; with fewer nothing is said."""
LEAST_PACKETS: Final = 50
"""A half hour with fewer is left out."""
RESAMPLES: Final = 2_000
CONFIDENCE: Final = 0.001
_FACTOR: Final = 5.0
_TRAINING_FACTOR: Final = 2.0
TRAINING_BLOCKS: Final = 10
TRAINING_SAMPLE: Final = 500
"""Packets of each tenth of training, evenly spaced, whose scores stand for it."""
_MOST_LIMIT: Final = 0.9


@dataclass(frozen=True)
class DriftReading:
    """The last day against training."""

    drifted: bool
    share: float
    """Of packets over the threshold, averaged over half hours."""
    least: float
    """Lower end of what resampling yields."""
    limit: float
    blocks: int
    """Half hours that count."""


class Drift:
    """Follows benign scores after training.

    Args:
        threshold: the score that one packet of training in a hundred exceeds.
        limit: share over it that is still no drift.
    """

    def __init__(self, threshold: float, limit: float) -> None:
        self.threshold = threshold
        self.limit = limit
        self._blocks: OrderedDict[int, list[int]] = OrderedDict()
        """By half hour: packets, and those over the threshold."""
        self.reading: DriftReading | None = None
        """None until there are enough half hours."""

    @classmethod
    def of(cls, scores: _Array) -> Self | None:
        """What training teaches.

        Args:
            scores: of packets from all of training, by the trained model, in order.

        Returns:
            None if there are too few.
        """
        scores = scores[np.isfinite(scores)]
        if len(scores) < TRAINING_BLOCKS:
            return None
        blocks = np.array_split(scores, TRAINING_BLOCKS)
        left_out = []
        for number, block in enumerate(blocks):
            rest = np.concatenate([each for place, each in enumerate(blocks) if place != number])
            left_out.append(float(np.mean(block > np.quantile(rest, QUANTILE))))
        upper = _resampled(np.array(left_out), 1 - CONFIDENCE, len(scores))
        limit = max(_FACTOR * (1 - QUANTILE), _TRAINING_FACTOR * upper)
        return cls(float(np.quantile(scores, QUANTILE)), min(limit, _MOST_LIMIT))

    def count(self, number: int, packets: int, above: int) -> bool:
        """Count benign packets of one half hour: how many there are, and how many are above the threshold.

        Args:
            number: of the half hour, that of time 0 being 0.
            packets: how many.
            above: of them.

        Returns:
            Whether it has drifted, or no longer has, since the last call.
        """
        changed = False
        if number not in self._blocks:
            changed = self._close(number)
            self._blocks[number] = [0, 0]
        self._blocks[number][0] += packets
        self._blocks[number][1] += above
        return changed

    def add(self, scores: _Array, seconds: _Array) -> bool:
        """Take benign scores in order of time.

        Args:
            scores: of benign packets.
            seconds: their capture times.

        Returns:
            Whether it has drifted, or no longer has, since the last call.
        """
        if not len(scores):
            return False
        numbers = (seconds // BLOCK_S).astype(np.int64)
        changed = False
        for number in np.unique(numbers).tolist():
            here = scores[numbers == number]
            changed |= self.count(number, len(here), int(np.count_nonzero(~(here <= self.threshold))))
        return changed

    def _close(self, number: int) -> bool:
        """A half hour begins: weigh those before it."""
        for old in [old for old in self._blocks if old < number - DAY_BLOCKS]:
            del self._blocks[old]
        while len(self._blocks) > 2 * DAY_BLOCKS:  # times that jump
            self._blocks.popitem(last=False)
        counted = [(count, over) for count, over in self._blocks.values() if count >= LEAST_PACKETS]
        if len(counted) < LEAST_BLOCKS:
            return False
        shares = np.array([over / count for count, over in counted])
        drawn = np.random.default_rng(number & 0xFFFF_FFFF).integers(
            len(shares), size=(RESAMPLES, len(shares))
        )
        least = float(np.quantile(shares[drawn].mean(axis=1), CONFIDENCE))
        share = float(shares.mean())
        before = self.reading is not None and self.reading.drifted
        # once given, a notice holds until the share itself is within the limit
        drifted = least > self.limit or (before and share > self.limit)
        self.reading = DriftReading(drifted, share, least, self.limit, len(shares))
        return drifted != before

    def to_state(self) -> dict[str, Any]:
        """Plain values for the model file."""
        drifted = self.reading is not None and self.reading.drifted
        blocks = [[number, *counts] for number, counts in self._blocks.items()]
        return {"line": self.threshold, "limit": self.limit, "blocks": blocks, "drifted": drifted}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """The inverse of `to_state`.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        self = cls(float(state["line"]), float(state["limit"]))
        if not (np.isfinite(self.threshold) and 0 < self.limit <= _MOST_LIMIT):
            raise ValueError(f"drift: threshold {self.threshold}, limit {self.limit}")
        for number, count, over in state["blocks"]:
            self._blocks[int(number)] = [int(count), int(over)]
        if state["drifted"]:
            self.reading = DriftReading(True, 0.0, 0.0, self.limit, 0)
        return self


def _resampled(shares: _Array, quantile: float, seed: int) -> float:
    """A quantile of the means that drawing blocks with replacement yields; the same for the same seed."""
    drawn = np.random.default_rng(seed & 0xFFFF_FFFF).integers(len(shares), size=(RESAMPLES, len(shares)))
    return float(np.quantile(shares[drawn].mean(axis=1), quantile))
