"""Where a replay need not be held back: what a dry run saw, compared with a slow twin that asks packet by packet."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdnator.replay.quiet_stretches import AFTER_NS, BEFORE_NS, QuietStretches, laps

SECOND = 1_000_000_000
MINUTE = np.arange(60) * SECOND
"""A packet a second."""
TIMES = st.lists(st.integers(0, 120 * SECOND), max_size=40)


def quiet(found: QuietStretches, packets: int) -> list[int]:
    """The packets that may be sent freely, walked as the feeder does."""
    free, at = [], 0
    while at < packets:
        end = found.end(at)
        free += range(at, end)
        at = max(end, at + 1)
    return free


def test_no_packet_is_held_back_where_nothing_was_seen():
    assert QuietStretches(MINUTE, []).end(0) == 60
    assert QuietStretches(MINUTE, []).end(59) == 60


def test_packets_around_a_sign_are_held_back():
    """From ten seconds before to five seconds after it, and no others."""
    found = QuietStretches(MINUTE, [30 * SECOND])
    assert [found.end(at) for at in (0, 19, 20, 35, 36, 59)] == [20, 20, 20, 35, 60, 60]


def test_nothing_is_foretold_behind_the_first_decision():
    """The packets behind it differ from those of the dry run: some are blocked."""
    found = QuietStretches(MINUTE, [30 * SECOND], decided=30 * SECOND)
    assert quiet(found, 60) == list(range(20))


@pytest.mark.parametrize(("sign", "decision"), [(40 * SECOND, False), (30 * SECOND, True)])
def test_a_sign_that_was_not_foretold_ends_all_quiet(sign, decision):
    """So does a decision, wherever it is."""
    found = QuietStretches(MINUTE, [30 * SECOND])
    found.hear(29 * SECOND)
    assert found.end(0) == 20
    found.hear(sign, decision=decision)
    assert quiet(found, 60) == []


@given(times=TIMES, signs=TIMES, decided=st.none() | st.integers(0, 120 * SECOND))
def test_like_a_twin_that_looks_at_each_packet(times, signs, decided):
    """Whatever the order of times and signs."""

    def is_loud(at: int) -> bool:
        return any(sign - BEFORE_NS <= at <= sign + AFTER_NS for sign in signs)

    expected, is_behind = [], False
    for index, at in enumerate(times):
        is_behind = is_behind or (decided is not None and at >= decided - BEFORE_NS)
        if not is_behind and not is_loud(at):
            expected.append(index)
    found = QuietStretches(np.array(times, np.int64), signs, decided)
    assert quiet(found, len(times)) == expected


def test_a_lap_is_needed_for_each_half_second_that_has_packets():
    assert laps(np.array([], np.int64), SECOND // 2) == 0
    assert laps(np.array([1, 2, 3], np.int64), SECOND // 2) == 1
    assert laps(np.repeat(MINUTE, 100), SECOND // 2) == 60
