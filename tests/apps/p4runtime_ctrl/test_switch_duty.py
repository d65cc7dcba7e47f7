"""Of several controllers of a switch the one that is primary speaks for it."""

import pytest

from apps.messages import Confirmation
from apps.p4runtime_ctrl.arrivals import SwitchTold
from apps.p4runtime_ctrl.duty import SwitchDuty


@pytest.fixture
def duty():
    return SwitchDuty(lambda: "me", divided=True)


def confirmation(number):
    return Confirmation(id=f"d{number}", switch="s1", state="failed", action="block", event_time=1)


def told(*, primary):
    return SwitchTold(switch="s1", primary=primary)


def test_where_nothing_is_divided_the_worker_always_speaks():
    duty = SwitchDuty(lambda: "me", divided=False)
    assert duty.speaks(0.0, primary=False)
    assert duty.owner(0.0, primary=True) == ""


def test_while_no_controller_is_primary_the_one_that_was_given_the_switch_speaks(duty):
    assert not duty.speaks(0.0, primary=False)
    assert duty.speaks(0.0, primary=True)
    duty.give(granted=True)
    assert duty.speaks(0.0, primary=False)
    duty.give(granted=False)
    assert duty.speaks(0.0, primary=False), "the switch is away, and nobody has it"
    duty.stand_back()
    assert not duty.speaks(0.0, primary=False)
    duty.backup = False
    assert not duty.speaks(0.0, primary=False), "another one had it since"


def test_one_without_a_connection_is_silent_while_another_one_says_that_it_has_the_switch(duty):
    duty.give(granted=True)
    duty.heard(told(primary=True), "other", 10.0)
    assert not duty.speaks(12.9, primary=False)
    assert duty.speaks(13.1, primary=False), "the other one has not said so for three seconds"
    duty.heard(told(primary=True), "other", 20.0)
    duty.heard(told(primary=False), "third", 20.0)
    assert duty.elsewhere(20.1) == "other"
    duty.heard(told(primary=False), "other", 20.2)
    assert duty.speaks(20.3, primary=False)


def test_the_owner_is_named_as_far_as_it_is_known(duty):
    assert duty.owner(0.0, primary=True) == "me"
    assert duty.owner(0.0, primary=False) == "", "none is primary"
    duty.stand_back()
    assert duty.owner(0.0, primary=False) == "another"
    duty.heard(told(primary=True), "other", 1.0)
    assert duty.owner(2.0, primary=False) == "other"


def test_refused_writes_are_failures_only_if_no_other_controller_turns_out_to_be_primary(duty):
    duty.withhold([confirmation(1)], 10.0)
    duty.withhold([confirmation(2)], 11.5)
    assert duty.overdue(11.9) == []
    assert [each.id for each in duty.overdue(12.1)] == ["d1", "d2"]
    assert duty.overdue(20.0) == []
    duty.withhold([confirmation(3)], 30.0)
    duty.settled()
    assert duty.overdue(40.0) == []
