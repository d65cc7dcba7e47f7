"""How far training is, where its packets came from, and how long it will go on.  Pure."""

from collections import Counter, deque
from typing import Final

import numpy as np

from apps.kitsune.kernel import Columns

RECENT_US: Final = 120_000_000
"""Capture time whose packet rate says how long training will go on."""
MOST_PORTS: Final = 64
"""Ports counted one by one; packets of others count in the whole only."""
_SAMPLE_US: Final = 1_000_000
_LEAST_US: Final = 2_000_000


class TrainingProgress:
    """Counts packets of training.

    Args:
        wanted: packets of a whole training.
    """

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.packets = 0
        self.ports: Counter[tuple[str, int]] = Counter()
        """Packets by switch and ingress port."""
        self._samples: deque[tuple[int, int]] = deque()
        """Capture time, and packets before it: one a second."""

    def see(self, batch: Columns, switch: str, trained: int) -> None:
        """Take a batch whose first `trained` packets, one at least, were training."""
        newest = int(batch["time_us"][trained - 1])
        if not self._samples or newest - self._samples[-1][0] >= _SAMPLE_US:
            self._samples.append((int(batch["time_us"][0]), self.packets))
        self.packets += trained
        numbers, counts = np.unique(batch["port"][:trained], return_counts=True)
        for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
            if (switch, number) in self.ports or len(self.ports) < MOST_PORTS:
                self.ports[switch, number] += count
        while len(self._samples) > 2 and self._samples[1][0] <= newest - RECENT_US:
            self._samples.popleft()

    def seconds_left(self, now_us: int) -> float | None:
        """Seconds until training is done if packets go on to come as they did lately; None if nobody can say.

        Args:
            now_us: capture time, which advances while no packets arrive.
        """
        if self.packets >= self.wanted:
            return 0.0
        if not self._samples:
            return None
        begun, before = self._samples[0]
        passed, seen = now_us - begun, self.packets - before
        if passed < _LEAST_US or not seen:
            return None
        return (self.wanted - self.packets) * passed / seen / 1e6
