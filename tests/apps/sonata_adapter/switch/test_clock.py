"""A switch's clock: heard of from time to time, guessed in between."""

import pytest

from apps.sonata_adapter.switch.clock import Clock

START_US = 1_700_000_000_000_000


def heard(*ticks):
    """A clock that was heard of at these (capture second, caller's second)."""
    clock = Clock()
    for capture_s, now in ticks:
        clock.hear(START_US + round(capture_s * 1e6))
        clock.look(now)
    return clock


def shown(clock, now):
    return ((clock.guess_us(now) or 0) - START_US) / 1e6


def test_nothing_is_known_before_it_is_heard_of():
    assert Clock().guess_us(5.0) is None
    assert Clock().was_us(5.0) is None


def test_it_runs_on_as_the_callers_clock_at_first():
    assert shown(heard((1, 10.0)), 12.5) == pytest.approx(3.5)


def test_it_runs_on_as_fast_as_it_ran():
    """A capture that is replayed eight times as fast as it was taken."""
    clock = heard((1, 10.0), (9, 11.0))
    assert shown(clock, 11.5) == pytest.approx(13)
    assert ((clock.was_us(10.5) or 0) - START_US) / 1e6 == pytest.approx(5)


def test_two_reports_of_one_batch_say_nothing_of_its_speed():
    clock = heard((1, 10.0), (4, 10.001))
    assert clock.rate == 1
    assert shown(clock, 11.001) == pytest.approx(5)


def test_it_does_not_go_back():
    clock = heard((5, 10.0), (3, 11.0))
    assert clock.heard_us == START_US + 5_000_000
    assert clock.idle_s(12.0) == pytest.approx(2)
