"""Where only copies are seen, decisions say what they would do, and nothing claims that anything was stopped."""

import pytest

from apps.firewall.enforcement.eve import decision_event
from apps.firewall.enforcement.mirrors import COPIES, MOST_MIRRORS, Mirrors
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Instruction
from tests.apps.firewall.alerts import alert
from tests.apps.firewall.desk import ALERT, Desk
from tests.apps.firewall.enforcement.test_eve import decision
from tests.apps.firewall.test_service import INSTRUCTION, INSTRUCTIONS, flood, spoofed

QUICK = SynRules(grace_ms=0, patience_ms=0, reset_after_ms=0)


def test_block_of_an_attacker_on_a_mirror_is_a_would_be_block():
    desk = Desk(switches=())
    desk.switch(mirror=True)
    desk.hand(ALERT, alert(anomalous_seconds=5).to_value())
    (block,) = desk.decisions
    assert (block.action, block.dry_run) == ("block", True)
    assert block.reason.endswith(COPIES)
    health = desk.service.health()
    assert (health["blocks"], health["would_block"]) == (0, 1)
    event = decision_event(block)["alert"]
    assert (event["action"], event["metadata"]["dry_run"]) == ("allowed", ["yes"])


def test_guard_on_a_mirror_challenges_nobody_and_resets_nothing():
    desk = Desk(switches=(), syn=QUICK)
    desk.switch(mirror=True)
    flood(desk, *spoofed())
    assert [(each.action, each.dry_run) for each in desk.decisions] == [("protect", True)]
    desk.service.tick()
    assert desk.written("network.packet_out") == []


def test_block_by_hand_on_a_mirror_and_its_end_are_no_more():
    desk = Desk(switches=())
    desk.switch(mirror=True)
    for number, verb in enumerate(("block", "unblock")):
        said = Instruction(id=str(number), verb=verb, subject="10.0.0.9", reason="by hand")
        desk.hand(INSTRUCTION, said.to_value(), pattern=INSTRUCTIONS)
    assert [(each.action, each.dry_run) for each in desk.decisions] == [("block", True), ("unblock", True)]


@pytest.mark.parametrize(
    ("switch", "connected", "mirrors", "dry"),
    [
        ("s1", ("s1",), ("s1",), True),
        ("*", ("s1",), ("s1",), True),
        ("*", ("s1", "s2"), ("s1",), False),
        ("*", ("s1", "s2"), ("s1", "s2"), True),
        ("s2", ("s1", "s2"), ("s1",), False),
        ("*", (), (), False),
    ],
)
def test_decision_for_all_switches_is_carried_out_where_one_sees_more_than_copies(
    switch, connected, mirrors, dry
):
    known = Mirrors()
    for each in connected:
        known.note(each, mirror=each in mirrors)
    marked = known.marked(decision(switch=switch), connected)
    assert marked.dry_run is dry
    assert known.marked(marked, connected) == marked


def test_mirrors_that_came_and_went_are_forgotten():
    """Whatever names switches are given over the months."""
    mirrors = Mirrors()
    for number in range(3 * MOST_MIRRORS):
        mirrors.note(f"s{number}", mirror=True)
    assert len(mirrors) == MOST_MIRRORS
    assert f"s{3 * MOST_MIRRORS - 1}" in mirrors
    assert "s0" not in mirrors
