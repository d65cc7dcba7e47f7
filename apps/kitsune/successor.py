"""A model that trains beside the one in use, and takes over if it is no worse.  Pure.

    packets ─► model in use ─► scores, evidence
       └─ those of senders without evidence against them ─► successor: trains, then scores the same packets as the other
                                                              ─► no worse: takes over;  worse: discarded

Both models are compared over a quarter as many packets as training had.  The successor is no worse if hardly more of
them are at or above its threshold; if the share above the score that one packet in a hundred of its training exceeds
would not count as drift, or is no larger than that of the other model; and if it accuses nobody whom the model in use
does not accuse.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from apps.kitsune.accused import LEAST_NATS
from apps.kitsune.detector import SCORED, Detector, DetectorSettings, Scored
from apps.kitsune.kernel import Kernel
from apps.messages import Sender
from due import RecordBatch

COMPARED_SHARE: Final = 0.25
"""Packets that both score, as a part of those of training."""
MORE_OVER: Final = 1e-4
"""Share of the packets that may be at or above the threshold in addition to those of the model in use."""


@dataclass(frozen=True)
class Comparison:
    """How both models scored the same packets."""

    no_worse: bool
    text: str


class Successor:
    """Trains on packets that the model in use considers benign.

    Args:
        settings: of both.
        working: the model in use; its statistics of packets serve both.
        kernel: as for the model in use.
    """

    def __init__(self, settings: DetectorSettings, working: Detector, kernel: Kernel) -> None:
        self.detector = Detector(settings, kernel=kernel)
        self.detector.afterimage = working.afterimage
        self.detector.senders.blocked = working.senders.blocked
        self.compared = 0
        """Packets that both have scored."""
        self._over = [0, 0]
        self._unusual = [0, 0]
        self._nats: dict[Sender, float] = {}

    @property
    def wanted(self) -> int:
        """Packets that both have to score."""
        return max(1, round(COMPARED_SHARE * self.detector.model.training_packets))

    def add(self, batch: RecordBatch, switch: str, working: Detector, scored: Scored) -> Comparison | None:
        """Take a batch that the model in use has just scored.

        Args:
            batch: its packets.
            switch: where they were seen.
            working: the model in use.
            scored: its result for the batch.

        Returns:
            The outcome, once enough packets were compared.
        """
        benign = working.accused.benign(batch, float(batch["time_us"][-1]) / 1e6)
        rows = np.arange(len(batch)) if benign is None else np.flatnonzero(benign)
        if not len(rows):
            return None
        part = batch if benign is None else batch.take(rows)
        mine, _ = self.detector.process(part, switch, scored.features[rows])
        both = (mine.state == SCORED) & (scored.state[rows] == SCORED)
        self._compare(0, working, scored.scores[rows][both])
        self._compare(1, self.detector, mine.scores[both])
        for evidence in self.detector.take_evidence():
            if evidence.sender is not None and not evidence.supporting:
                self._nats[evidence.sender] = self._nats.get(evidence.sender, 0.0) + evidence.nats
        self.compared += int(np.count_nonzero(both))
        return self._outcome() if self.compared >= self.wanted else None

    def _compare(self, which: int, model: Detector, scores: npt.NDArray[np.float64]) -> None:
        usual = model.drift.threshold if model.drift is not None else model.threshold
        self._over[which] += int(np.count_nonzero(~(scores < model.threshold)))
        self._unusual[which] += int(np.count_nonzero(~(scores <= usual)))

    def _outcome(self) -> Comparison:
        limit = self.detector.drift.limit if self.detector.drift is not None else 0.0
        accused = [sender for sender, nats in self._nats.items() if nats >= LEAST_NATS]
        no_worse = (
            not accused
            and self._over[1] <= self._over[0] + MORE_OVER * self.compared
            and self._unusual[1] <= max(self._unusual[0], limit * self.compared)
        )
        words = (
            f"of {self.compared:,} packets that both scored {self._over[1]:,} are at or above the threshold "
            f"({self._over[0]:,} by the model in use), {self._unusual[1] / self.compared:.1%} are unusual "
            f"({self._unusual[0] / self.compared:.1%})"
        )
        if accused:
            words += f", and it accuses {len(accused)} senders, such as {accused[0].ip or accused[0].mac}"
        return Comparison(no_worse, words)
