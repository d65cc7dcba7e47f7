"""Training says how far it is, where its packets come from, and when it will be done."""

import numpy as np
import pytest

from apps.kitsune.training_progress import TrainingProgress
from sdnator.testing.packet_rows import blank

SECOND = 1_000_000


def fed(progress, *, first_s, seconds, rate, port=1, switch="s1"):
    for second in range(first_s, first_s + seconds):
        times = second * SECOND + np.arange(rate) * SECOND // rate
        progress.see(blank(rate, time_us=times, port=np.full(rate, port)), switch, rate)


def test_packets_are_counted_by_switch_and_port():
    progress = TrainingProgress(1_000)
    fed(progress, first_s=0, seconds=3, rate=10)
    fed(progress, first_s=3, seconds=2, rate=10, port=2, switch="s2")
    assert progress.packets == 50
    assert dict(progress.ports) == {("s1", 1): 30, ("s2", 2): 20}


def test_the_rest_takes_as_long_as_packets_of_late_come():
    """A busy hour before does not count, and time without packets does."""
    progress = TrainingProgress(10_000)
    fed(progress, first_s=0, seconds=60, rate=100)
    fed(progress, first_s=600, seconds=200, rate=10)
    left = progress.seconds_left(800 * SECOND)
    assert left == pytest.approx((10_000 - 8_000) / 10, rel=0.1)
    assert (progress.seconds_left(1_000 * SECOND) or 0) > 1.5 * (left or 0)


def test_nobody_knows_before_anything_came():
    progress = TrainingProgress(100)
    assert progress.seconds_left(5) is None
    fed(progress, first_s=0, seconds=1, rate=10)
    assert progress.seconds_left(SECOND // 2) is None
    fed(progress, first_s=1, seconds=9, rate=10)
    assert progress.seconds_left(10 * SECOND) == 0.0
