"""What an app has freed goes back to the system."""

from pathlib import Path

import pytest

from due.heap import EVERY_S, HeapTrim


def anonymous_kb():
    status = Path("/proc/self/status").read_text()
    return int(status.partition("RssAnon:")[2].split()[0])


def test_what_is_freed_below_something_that_stays_is_given_back():
    trim = HeapTrim(0.0)
    if trim._trim is None:
        pytest.skip("this C library has no malloc_trim")
    pieces = [bytes(4_000 + number % 7) for number in range(20_000)]
    full = anonymous_kb()
    stays = pieces.pop()
    pieces.clear()
    assert not trim.tick(EVERY_S - 1)
    assert trim.tick(EVERY_S)
    assert anonymous_kb() < full - 40_000
    assert not trim.tick(EVERY_S + 1)
    assert len(stays) > 0
