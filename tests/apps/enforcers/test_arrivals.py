"""What enforcers read from the archive."""

import logging

import msgspec

from apps.enforcers.arrivals import last_of_each
from apps.messages import Intake
from due import Item
from tests.apps.firewall.enforcement.test_eve import decision


def test_a_lift_is_the_last_word_whatever_clock_its_writer_had():
    """Of two blocks, one is extended, the other lifted by a firewall whose clock was an hour behind."""
    longer = decision(expires=decision().expires + 1)
    lifted = decision(id="d2", action="unblock")
    written = [
        (5, lifted),
        (10, decision()),
        (11, decision(id="d2")),
        (12, longer),
        (13, decision(id="d3", dry_run=True)),
    ]
    items = [
        Item("network.block.firewall.ipv4", msgspec.to_builtins(made), at, at, "firewall", "i", at)
        for at, made in written
    ]
    found = last_of_each(items, Intake(logging.getLogger("test")))
    assert {made.id: (made.action, made.expires) for made, _ in found} == {
        "d1": ("block", longer.expires), "d2": ("unblock", lifted.expires),
    }  # fmt: skip
