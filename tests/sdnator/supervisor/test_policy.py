"""Pauses between restarts double up to a bound; a listener's own absence is not a part's silence."""

from hypothesis import given
from hypothesis import strategies as st

from sdnator.supervisor import RestartPolicy
from sdnator.supervisor.part import Silence


def test_pauses_double_up_to_the_longest():
    policy = RestartPolicy()
    assert [policy.pause_s(deaths) for deaths in range(1, 9)] == [0.5, 1, 2, 4, 8, 16, 30, 30]
    assert policy.pause_s(10**9) == 30


def test_the_switch_comes_back_at_once_but_not_for_ever():
    policy = RestartPolicy(at_once=True)
    assert [policy.pause_s(deaths) for deaths in (1, 2, 3)] == [0, 0.5, 1]
    assert policy.pause_s(3, ran_s=policy.quick_s) == 0
    assert RestartPolicy().pause_s(2, ran_s=3600) == 1


@given(st.lists(st.floats(min_value=0.0, max_value=1.0), max_size=100))
def test_a_part_that_beats_is_never_silent(gaps):
    silence, now = Silence(1.5), 0.0
    for gap in gaps:
        now += gap
        assert not silence.too_long(now, beaten=True)


def test_silence_adds_up_over_looks():
    silence = Silence(3.0)
    assert [silence.too_long(float(now), beaten=now == 2) for now in range(7)] == [False] * 5 + [True] * 2


def test_who_was_stopped_himself_does_not_count_the_time():
    silence = Silence(3.0)
    assert not silence.too_long(0.0, beaten=True)
    assert not silence.too_long(3_600.0, beaten=False)
    assert not silence.too_long(3_601.0, beaten=True)


def test_without_a_limit_silence_is_fine():
    silence = Silence(0.0)
    assert not any(silence.too_long(float(now), beaten=False) for now in range(100))
