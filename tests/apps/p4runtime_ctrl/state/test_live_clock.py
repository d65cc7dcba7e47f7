"""A live switch's time goes on while nobody sends; a replay's stands."""

import pytest

from apps.p4runtime_ctrl.state.live_clock import LiveClock

SECOND_US = 1_000_000
NOW_US = 1_700_000_000 * SECOND_US


def ticks(clock, heard_us, looks):
    """Times that the clock tells at each look: (packets so far, monotonic seconds)."""
    return [clock.look(heard_us if packets else 0, packets, now) for packets, now in looks]


def test_it_ticks_once_a_second_after_the_last_packet():
    looks = [(5, 10.0), (5, 10.5), (5, 11.0), (5, 11.1), (5, 12.0), (6, 13.0), (6, 13.5)]
    found = ticks(LiveClock("heard"), NOW_US, looks)
    passed = [None if each is None else each - NOW_US for each in found]
    assert passed == [None, None, 900_000, None, 1_900_000, None, None]


@pytest.mark.parametrize(("kind", "begins"), [("packets", None), ("heard", None), ("own", NOW_US + 900_000)])
def test_only_a_switch_of_ours_has_a_time_before_its_first_packet(kind, begins):
    assert ticks(LiveClock(kind, NOW_US), 0, [(0, 10.0), (0, 11.0)])[-1] == begins


def test_a_replay_stands_between_packets():
    assert ticks(LiveClock("packets", NOW_US), NOW_US, [(5, 10.0), (5, 1000.0)]) == [None, None]


def test_a_time_that_is_waited_for_is_told_when_it_comes():
    """Not at the next whole second: a block in a switch ends by it."""
    clock = LiveClock("heard")
    found = [clock.look(NOW_US, 5, now, NOW_US + 300_000) for now in (10.0, 10.25, 10.5)]
    passed = [None if each is None else each - NOW_US for each in found]
    assert passed == [None, None, 400_000]
