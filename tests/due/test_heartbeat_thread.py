"""The heartbeat thread wakes up often only where somebody may need it."""

import pytest

from due.heartbeat_thread import Rhythm

LONGEST = 0.5


@pytest.fixture
def rhythm():
    return Rhythm(LONGEST)


def test_it_rests_long_while_no_best_effort_payloads_come(rhythm):
    assert rhythm.rest(coming=False, slow=False) == LONGEST
    assert rhythm.rest(coming=True, slow=False) < LONGEST


def test_a_slow_callback_is_looked_after_at_once_while_payloads_are_found(rhythm):
    usual = rhythm.rest(coming=True, slow=False)
    quick = rhythm.rest(coming=True, slow=True)
    assert quick < usual
    for _ in range(10):
        rhythm.drained(some=False)
    assert quick < rhythm.rest(coming=True, slow=True) <= usual
    rhythm.drained(some=True)
    assert rhythm.rest(coming=True, slow=True) == quick


def test_where_cores_are_short_it_rests_longer_and_comes_back_to_its_pace(rhythm):
    usual = rhythm.rest(coming=True, slow=False)
    for _ in range(10):
        rhythm.got_up(late=True)
    assert rhythm.rest(coming=True, slow=False) == LONGEST
    for _ in range(100):
        rhythm.got_up(late=False)
    assert rhythm.rest(coming=True, slow=False) == usual


def test_it_never_rests_longer_than_a_stopped_process_may_stay_unnoticed():
    rhythm = Rhythm(0.02)
    rhythm.got_up(late=True)
    assert all(rhythm.rest(coming=coming, slow=slow) <= 0.02 for coming in (0, 1) for slow in (0, 1))
