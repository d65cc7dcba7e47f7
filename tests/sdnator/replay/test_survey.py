"""What a replay must know of its capture is worked out once."""

from pathlib import Path
from typing import Any

import numpy as np

from sdnator.replay.survey import Survey

LENGTHS = (np.zeros(2, np.uint32), np.zeros(2, np.uint32), True)


class CountingTimes(np.ndarray[Any, np.dtype[np.int64]]):
    """Times that count how often somebody looks for the least of them."""

    looked = 0

    def min(self, *_args: Any, **_options: Any) -> Any:
        CountingTimes.looked += 1
        return np.asarray(self).min()


def test_the_start_is_looked_for_once_not_for_every_packet():
    """The feeder asks for it with each packet: a search each time would be quadratic in the capture."""
    times = np.array([7_900_000_000, 5_500_000_000], np.int64).view(CountingTimes)
    survey = Survey(Path("x"), times, np.zeros(2, np.uint64), np.zeros(2, np.uint32), 0, None, *LENGTHS)
    assert [survey.base_us for _ in range(100)] == [5_000_000] * 100
    assert CountingTimes.looked == 1
