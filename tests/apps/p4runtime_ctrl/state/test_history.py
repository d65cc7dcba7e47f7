"""Decisions come out of the archive in order, once, for the right switch, and none from before."""

import logging

from msgspec import structs

from apps.messages import Decision, Exhibit, Ground, Intake, Target
from apps.p4runtime_ctrl.state.history import as_remembered, commands_of, decisions_for
from due import Item


def intake():
    return Intake(logging.getLogger("test"))


def decision(number, switch="s1", action="block"):
    target = Target(kind="ip", address=f"10.0.0.{number}")
    return Decision(
        id=f"d{number}", action=action, switch=switch, target=target, reason="", event_time=1, expires=0
    )


def item(value, timestamp, key="network.block.firewall.ipv4"):
    return Item(
        key=key,
        value=value,
        timestamp=timestamp,
        event_time=1,
        app_id="firewall",
        instance_id="i",
        sequence=timestamp,
    )


def test_order_identity_and_age():
    archived = [item(decision(n).to_value(), 100 - n) for n in range(5)]
    recent = [decision(3), decision(9)]
    found = decisions_for("s1", archived, recent, since=96, intake=intake())
    assert [each.id for each in found] == ["d3", "d2", "d1", "d0", "d9"]


def test_what_led_to_a_decision_is_not_kept_with_it():
    """Ten thousand decisions are remembered, and their evidence is most of what they weigh."""
    exhibits = (Exhibit(key="network.evidence.kitsune.ports", timestamp=1, summary="700 ports"),)
    plain = decision(3)
    heard = structs.replace(
        plain, reason="700 ports", evidence=exhibits, grounds=(Ground(source="kitsune.ports", nats=9.0),)
    )
    assert as_remembered(heard) == plain
    archived = [item(heard.to_value(), 50), item(decision(4).to_value(), 51)]
    assert decisions_for("s1", archived, [as_remembered(heard)], 0, intake()) == [plain, decision(4)]


def test_what_was_lifted_does_not_come_back():
    """Neither where the archive has no lift yet, nor where a clock that was behind put it first."""
    lift, block = decision(3, action="unblock"), decision(3)
    archived = [item(block.to_value(), 50)]
    assert decisions_for("s1", archived, [lift], 0, intake()) == [lift]
    assert decisions_for("s1", [item(lift.to_value(), 7), *archived], [], 0, intake()) == [lift]


def test_other_switches_and_all_switches():
    names = ("s1", "s2", "", "*")
    archived = [item(decision(n, name).to_value(), n + 1) for n, name in enumerate(names)]
    assert [each.switch for each in decisions_for("s1", archived, [], 0, intake())] == ["s1", "", "*"]


def test_what_cannot_be_read_is_left_out(caplog):
    heard = intake()
    assert heard.read("decision", Decision.from_item, item({"id": 5}, 1)) is None
    assert "(fields): Decision:" in caplog.text
    good = {"id": "c1", "updates": [{"kind": "delete", "table": "t"}]}
    key = "network.p4_command.firewall.s1"
    archived = [item({"no": 1}, 1, key), item(good, 2, key), item(good, 0, key)]
    assert [command.id for command in commands_of(archived, 1, heard)] == ["c1"]
    assert heard.health()["refused_by_cause"] == {"fields": 1}
