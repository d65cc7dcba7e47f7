"""The faults of a run follow from its seed, and leave it time to settle."""

import pytest

from benchmarks.chaos_faults import ACTIONS
from benchmarks.chaos_probes import by_the_right_clock
from benchmarks.chaos_schedule import JUMP_S, KINDS, schedule


def test_a_seed_gives_the_same_faults_again():
    """A violation that was seen once can be looked for again."""
    assert schedule(7, 600, list(KINDS)) == schedule(7, 600, list(KINDS))
    assert schedule(7, 600, list(KINDS)) != schedule(8, 600, list(KINDS))


def test_every_kind_is_drawn_in_a_long_run_and_hits_whom_it_may():
    """No row of the table is dead."""
    faults = schedule(1, 7200, list(KINDS))
    assert {each.kind for each in faults} == set(KINDS)
    for each in faults:
        kind = KINDS[each.kind]
        assert set(each.targets) <= set(kind.targets)
        assert len(set(each.targets)) == kind.at_once
        assert each.seconds <= kind.seconds[1]


def test_kinds_that_cannot_be_done_are_not_drawn():
    """A machine without root leaves some out."""
    assert {each.kind for each in schedule(1, 3600, ["kill", "stop"])} == {"kill", "stop"}


def test_the_last_tenth_is_quiet():
    """What is judged at the end has had time to come back."""
    assert all(each.at + each.seconds <= 0.9 * 300 + 0.01 for each in schedule(3, 300, list(KINDS)))


def test_whatever_can_be_drawn_can_be_done():
    """Each kind has its action, and none is left without a row in the table."""
    assert set(ACTIONS) == set(KINDS)


@pytest.mark.parametrize("jump", [-JUMP_S, 0, JUMP_S])
@pytest.mark.parametrize("came", [100.0, 130.0])
def test_a_jump_does_not_change_when_an_item_was_written(jump, came):
    """Also where it came late: order is that of writing, whoever has the wrong clock."""
    assert by_the_right_clock(99.5 + jump, came) == 99.5
