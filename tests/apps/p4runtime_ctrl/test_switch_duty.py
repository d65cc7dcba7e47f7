"""Of several controllers of a switch the one that is primary speaks for it."""

import pytest

from apps.messages import Confirmation
from apps.p4runtime_ctrl.duty import SwitchDuty


@pytest.fixture
def duty():
    return SwitchDuty(divided=True)


def confirmation(number):
    return Confirmation(id=f"d{number}", switch="s1", state="failed", action="block", event_time=1)


def test_where_nothing_is_divided_the_worker_always_speaks():
    assert SwitchDuty(divided=False).speaks(primary=False)


def test_while_no_controller_is_primary_the_one_that_was_given_the_switch_speaks(duty):
    assert not duty.speaks(primary=False)
    assert duty.speaks(primary=True)
    duty.granted = True
    assert duty.speaks(primary=False)
    duty.backup = True
    assert not duty.speaks(primary=False)


def test_the_owner_is_named_as_far_as_it_is_known(duty):
    assert duty.owner("other", "me") == "", "none is primary"
    duty.backup = True
    assert duty.owner("other", "me") == "other"
    assert duty.owner("me", "me") == duty.owner("", "me") == "another"


def test_refused_writes_are_failures_only_if_no_other_controller_turns_out_to_be_primary(duty):
    duty.withhold([confirmation(1)], 10.0)
    duty.withhold([confirmation(2)], 11.5)
    assert duty.overdue(11.9) == []
    assert [each.id for each in duty.overdue(12.1)] == ["d1", "d2"]
    assert duty.overdue(20.0) == []
    duty.withhold([confirmation(3)], 30.0)
    duty.settled()
    assert duty.overdue(40.0) == []
