"""What a row says of a decision, and which button it has."""

import pytest
from msgspec import structs

from apps.messages import Decision, Ground, Target
from sdnator.dashboard.texts import decision_row, incident_row
from tests.sdnator.incidents.samples import life


@pytest.mark.parametrize(
    ("action", "expires", "button"), [("block", 0, "Undo"), ("protect", 9, "Release"), ("protect", 0, "")]
)
def test_blocks_are_undone_and_guards_released_but_those_of_the_settings_stay(action, expires, button):
    target = Target(kind="ip", address="192.0.2.1", port=443 if action == "protect" else None)
    one = Decision(
        id="d", action=action, switch="*", target=target, reason="r", event_time=1, expires=expires
    )
    row = decision_row(one, {"switch s1": "installed"})
    assert (row["undo"], row["said"]) == (button, "in force: switch s1")
    assert row["where"].startswith("all switches")


def test_a_row_says_where_it_is_in_force_and_who_has_refused_it():
    """In words of operators: what a switch calls its own entry is no news."""
    one = Decision(
        id="d",
        action="block",
        switch="*",
        target=Target(kind="ip", address="192.0.2.1"),
        reason="r",
        event_time=1,
        expires=2,
    )
    answers = {
        "switch s1": "exists: table ingress.block_src already has an entry for (src=Exact(value=1))",
        "nftables gateway": "installed",
        "webhook_enforcer edge": "failed: it is our printer",
    }
    row = decision_row(one, answers)
    assert (
        row["said"]
        == "in force: nftables gateway, switch s1; webhook_enforcer edge refused it: it is our printer"
    )
    assert row["word"] == "block"
    waits = decision_row(one, {"switch s1": "pending: the switch is not connected"})
    assert (waits["said"], waits["word"]) == (
        "switch s1 has it pending: the switch is not connected",
        "would block",
    )
    assert decision_row(one, {"switch s1": "removed"})["said"] == "switch s1: removed"


def test_only_what_evidence_led_to_can_be_called_a_false_alarm():
    ground = Ground(source="kitsune.targets", nats=9.0)
    one = Decision(
        id="d",
        action="block",
        switch="s1",
        target=Target(kind="ip", address="192.0.2.1"),
        reason="r",
        event_time=1,
        expires=2,
        grounds=(ground,),
    )
    assert decision_row(one, {})["false_alarm"]
    assert not decision_row(structs.replace(one, grounds=()), {})["false_alarm"]


def test_an_incident_says_who_whom_and_what_was_done():
    *_, over = life()
    row = incident_row(over)
    assert row["target"] == "scan: 192.168.2.108"
    assert row["where"].endswith("against 192.168.2.50 tcp/22 · over")
    assert (row["reason"], row["said"]) == ("blocked 5c:cf:7f:05:f2:c6 port 1, over", "70 packets stopped")
