"""What a row says of a decision, and which button it has."""

import pytest

from apps.messages import Decision, Target
from sdnator.dashboard.texts import decision_row


@pytest.mark.parametrize(
    ("action", "expires", "button"), [("block", 0, "Undo"), ("protect", 9, "Release"), ("protect", 0, "")]
)
def test_blocks_are_undone_and_guards_released_but_those_of_the_settings_stay(action, expires, button):
    target = Target(kind="ip", address="192.0.2.1", port=443 if action == "protect" else None)
    one = Decision(
        id="d", action=action, switch="*", target=target, reason="r", event_time=1, expires=expires
    )
    row = decision_row(one, {"s1": "installed"})
    assert (row["undo"], row["said"]) == (button, "s1: installed")
    assert row["where"].startswith("all switches")
