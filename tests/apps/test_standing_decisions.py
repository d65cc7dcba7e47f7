"""Which decisions stand, also where the clocks of their writers jumped."""

import msgspec
import pytest

from apps.messages import Target
from apps.standing_decisions import in_force
from tests.apps.firewall.enforcement.test_eve import decision

BLOCK = decision()
LIFT = msgspec.structs.replace(BLOCK, action="unblock", event_time=BLOCK.event_time + 9)
LATER = msgspec.structs.replace(BLOCK, id="d4", event_time=BLOCK.event_time + 20)


def test_newest_decision_for_a_target_counts():
    """Extended blocks count once, lifted ones not at all, guards beside blocks."""
    extended = decision(expires=2)
    other = decision(id="d2", target=Target(kind="ip", address="192.0.2.2"))
    guard = decision(id="d3", action="protect", target=Target(kind="ip", address="192.0.2.1", port=80))
    assert in_force([decision(expires=1), extended, other, guard]) == [extended, other, guard]
    assert in_force([BLOCK, other, LIFT]) == [other]
    assert in_force([BLOCK, LIFT, LATER]) == [LATER]


@pytest.mark.parametrize("written", [(LIFT, BLOCK), (BLOCK, LIFT), (LIFT, BLOCK, LIFT)])
def test_what_was_lifted_stays_lifted(written):
    """A firewall with a clock an hour behind wrote the lift before the block."""
    assert in_force(written) == []


def test_a_block_is_no_older_because_a_clock_was_behind():
    """It stands in front of the block that it followed, and of its lift."""
    assert in_force([LATER, BLOCK, LIFT]) == [LATER]


def test_an_extension_counts_wherever_it_stands():
    longer = msgspec.structs.replace(BLOCK, expires=BLOCK.expires + 1, event_time=BLOCK.event_time + 1)
    assert in_force([longer, BLOCK]) == in_force([BLOCK, longer]) == [longer]


def test_a_lift_ends_what_the_switch_had_refused_before():
    """A block that failed is not lifted, but replaced by the next one; it does not come back with its end."""
    gone = msgspec.structs.replace(LATER, action="unblock", event_time=LATER.event_time + 1)
    assert in_force([BLOCK, LATER, gone]) == []
