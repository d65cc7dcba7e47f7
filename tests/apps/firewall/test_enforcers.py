"""Blocks in several places: what the firewall makes of several enforcers' answers."""

import json
from functools import partial

import pytest

from apps.enforcement import AllowedEntries, EnforcementReport, HeldBlock
from apps.firewall.arrivals import report_in
from apps.firewall.service import ENFORCER_INTERESTS
from apps.firewall.settings import Settings
from apps.messages import Confirmation, Instruction, MessageError
from due import Item
from tests.apps.firewall.alerts import SECOND, alert
from tests.apps.firewall.desk import ALERT, NOW, Desk
from tests.apps.hostile import carried, mutations

BOTH = ("p4runtime_ctrl", "nftables")
INSTRUCTION = "network.instruction.operator.firewall"


def instruct(desk, verb, subject, number=1):
    value = Instruction(id=f"i{number}", verb=verb, subject=subject).to_value()
    desk.hand(INSTRUCTION, value, pattern="network.instruction.*.firewall")


def answer(desk, decision, state, app="nftables", place="gateway"):
    said = Confirmation(id=decision.id, switch=place, state=state, action=decision.action, event_time=NOW)
    key = f"network.confirmation.{app}"
    desk.hand(f"{key}.{place}", said.to_value(), pattern=f"{key}.*")


def report(desk, *blocks, problem="", place="gateway"):
    said = EnforcementReport(
        enforcer="nftables", place=place, working=not problem, problem=problem, blocks=blocks, event_time=NOW
    )
    desk.hand(f"network.enforced.nftables.{place}", said.to_value(), pattern="network.enforced.nftables.*")


def in_force(desk):
    return desk.service.health()["blocks"]


def block(desk, subject="192.0.2.1"):
    instruct(desk, "block", subject)
    return desk.decisions[-1]


def test_one_that_refuses_does_not_end_what_another_carries_out():
    desk = Desk(enforcers=BOTH)
    made = block(desk)
    answer(desk, made, "failed")
    assert in_force(desk) == 1  # the switch has not answered
    desk.confirm(made)
    assert in_force(desk) == 1
    desk.confirm(made, "failed")
    assert in_force(desk) == 0


def test_what_a_controller_keeps_for_later_is_lifted_as_any_other():
    """Its switch is away: the entry comes when the switch is back, and somebody has to know of it."""
    desk = Desk()
    made = block(desk)
    desk.confirm(made, "pending")
    assert in_force(desk) == 1
    instruct(desk, "unblock", "192.0.2.1", 2)
    assert (desk.decisions[-1].action, desk.decisions[-1].id) == ("unblock", made.id)
    assert in_force(desk) == 0


def test_a_refusal_elsewhere_does_not_end_what_a_controller_keeps_for_later():
    desk = Desk(enforcers=("nftables",))
    made = block(desk)
    desk.confirm(made, "pending")
    answer(desk, made, "failed")
    assert in_force(desk) == 1
    desk.confirm(made, "failed")
    assert in_force(desk) == 0


def test_an_enforcer_s_own_clock_does_not_end_a_block():
    """The firewall extends or lifts it: only it knows whether the attack goes on."""
    desk = Desk(enforcers=("nftables",))
    made = block(desk)
    answer(desk, made, "installed")
    answer(desk, made, "expired")
    assert in_force(desk) == 1


def test_the_switch_alone_is_as_before():
    """The default: one refusal ends it, and no allow-list is written for others."""
    desk = Desk()
    made = block(desk)
    answer(desk, made, "installed")  # nobody has declared it
    desk.confirm(made, "failed")
    assert in_force(desk) == 0
    assert not desk.written("network.allowed")


def test_a_mirror_is_no_dry_run_where_the_host_can_stop_it():
    """Guards stay what they are: only switches set them."""
    plain, helped = Desk(), Desk(enforcers=BOTH)
    for desk in (plain, helped):
        desk.switch(mirror=True)
        block(desk)
    assert plain.decisions[-1].dry_run
    assert not helped.decisions[-1].dry_run


def test_the_allow_list_is_told_whenever_it_changes():
    desk = Desk(enforcers=BOTH)
    instruct(desk, "allow", "192.0.2.0/24", 1)
    instruct(desk, "block", "198.51.100.1", 2)
    instruct(desk, "disallow", "192.0.2.0/24", 3)
    told = [AllowedEntries.from_value(value).entries for value in desk.written("network.allowed")]
    assert told == [(), ("192.0.2.0/24",), ()]


def test_eve_names_the_places_of_an_incident(tmp_path):
    """And a SIEM reads `blocked` once one of them has confirmed."""
    eve = tmp_path / "eve.json"
    desk = Desk(enforcers=BOTH, eve_file=str(eve))
    for second in range(6):
        desk.hand(ALERT, alert(NOW // SECOND + second, anomalous_seconds=second).to_value())
    (made,) = [each for each in desk.decisions if each.action == "block"]
    answer(desk, made, "installed")
    desk.confirm(made)
    desk.service.stop()
    lines = [json.loads(line)["alert"] for line in eve.read_text().splitlines()]
    confirmed = [each for each in lines if each["metadata"]["event"] == ["confirmed"]]
    assert [each["metadata"]["enforcers"] for each in confirmed] == [
        ["nftables gateway"],
        ["nftables gateway", "p4runtime_ctrl s1"],
    ]
    assert {each["action"] for each in confirmed} == {"blocked"}


def test_eve_names_the_places_of_a_block_by_hand(tmp_path):
    """It belongs to no incident: one line when it is decided, one for each place, none for a repetition."""
    eve = tmp_path / "eve.json"
    desk = Desk(enforcers=BOTH, eve_file=str(eve))
    made = block(desk)
    for _ in range(2):
        answer(desk, made, "installed")
    desk.confirm(made)
    answer(desk, made, "failed")
    desk.service.stop()
    said = [json.loads(line)["alert"]["metadata"].get("enforcers") for line in eve.read_text().splitlines()]
    assert said == [None, ["nftables gateway"], ["nftables gateway", "p4runtime_ctrl s1"]]


def test_trouble_of_an_enforcer_is_told_once():
    desk = Desk(enforcers=BOTH)
    for _ in range(3):
        report(desk, problem="no right")
    assert desk.events == ["enforcer nftables gateway: no right"]
    assert desk.service.health()["enforcers_failing"] == 1
    report(desk)
    assert desk.service.health()["enforcers_failing"] == 0


def test_drops_of_all_places_count():
    """An attack that a host drops goes on, whatever the switch sees of it."""
    desk = Desk(enforcers=BOTH)
    made = block(desk)
    held = partial(HeldBlock, id=made.id, target=made.target)
    desk.switch(at=NOW + SECOND)
    report(desk, held(packets=10))
    desk.switch(at=NOW + 2 * SECOND)
    report(desk, held(packets=30))
    report(desk, held(packets=5), place="second")
    (standing,) = desk.service._lifecycle.blocks.values()
    assert standing.readings[-1][1] == 30
    desk.switch(at=NOW + 3 * SECOND)
    report(desk, held(packets=40), place="second")
    assert standing.readings[-1][1] == 70


def test_hostile_reports_raise_one_error():
    """Whatever an enforcer sends."""
    genuine = EnforcementReport(
        enforcer="nftables", place="gateway", working=True, event_time=NOW, blocks=()
    ).to_value()
    key = "network.enforced.nftables.gateway"
    for value in mutations(genuine):
        try:
            report_in(Item(key, carried(value), NOW, NOW, "nftables", "i", 1))
        except MessageError:
            continue
    with pytest.raises(MessageError, match="is about"):
        report_in(Item(key, genuine | {"place": "elsewhere"}, NOW, NOW, "nftables", "i", 1))
    with pytest.raises(MessageError, match="not the app"):
        report_in(Item(key, genuine, NOW, NOW, "kitsune", "i", 1))
    assert {each.key for each in ENFORCER_INTERESTS} == {"network.confirmation.*.*", "network.enforced.*.*"}


@pytest.mark.parametrize("enforcers", [(), ("nftables", "nftables"), ("a.b",), ("Up",)])
def test_wrong_enforcers_are_named(enforcers):
    with pytest.raises(ValueError, match=r"enforcers|not the name"):
        Settings(enforcers=enforcers)
