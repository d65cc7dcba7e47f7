"""Rates by second and the line of blocks that shows them."""

import numpy as np

from due import RecordBatch
from sdnator.cli.item_rates import SECONDS, Rates, headline, sparkline


def test_seconds_are_counted_apart():
    """Records of batches count, silent seconds are zero, the last minute is kept."""
    rates = Rates(100.2)
    assert not rates.pass_time(100.9)
    rates.add({"count": 1})
    rates.add(RecordBatch({"time_us": np.arange(7)}))
    assert rates.pass_time(101.1)
    assert rates.last == 8
    assert rates.pass_time(103.5)
    assert rates.last == 0
    assert rates.line() == "█▁▁"
    assert (rates.items, rates.records) == (2, 8)
    assert round(rates.mean(104.2), 3) == 2.0
    rates.pass_time(1e6)
    assert rates.line() == "▁" * SECONDS


def test_blocks_go_from_nothing_to_the_largest():
    """What is there is seen, however small."""
    assert sparkline([0, 1, 1000]) == "▁▂█"
    assert sparkline([0, 0]) == "▁▁"
    assert sparkline([]) == ""


def test_headlines_say_what_a_result_is():
    """Fields of a result without its times; the size of a batch."""
    assert (
        headline({"dst": "10.0.0.1", "count": 40, "window_start": 1, "exact": True})
        == "dst 10.0.0.1  count 40"
    )
    assert headline(RecordBatch({"a": np.arange(3)})) == "3 records"
    assert headline(5) == "5"
