"""Decisions come out of the archive in order, once, for the right switch, and none from before."""

import logging

from msgspec import structs

from apps.messages import Decision, Exhibit, Ground, Intake, Target
from apps.p4runtime_ctrl.state.history import as_remembered, commands_of, decisions_for, in_order
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
    recent = [(97, decision(3)), (120, decision(9))]
    found = decisions_for("s1", archived, recent, since=96, intake=intake())
    assert [(at, each.id) for at, each in found] == [
        (97, "d3"), (98, "d2"), (99, "d1"), (100, "d0"), (120, "d9"),
    ]  # fmt: skip


def test_what_led_to_a_decision_is_not_kept_with_it():
    """Ten thousand decisions are remembered, and their evidence is most of what they weigh."""
    exhibits = (Exhibit(key="network.evidence.kitsune.ports", timestamp=1, summary="700 ports"),)
    plain = decision(3)
    heard = structs.replace(
        plain, reason="700 ports", evidence=exhibits, grounds=(Ground(source="kitsune.ports", nats=9.0),)
    )
    assert as_remembered(heard) == plain
    archived = [item(heard.to_value(), 50), item(decision(4).to_value(), 51)]
    found = decisions_for("s1", archived, [(50, as_remembered(heard))], 0, intake())
    assert found == [(50, plain), (51, decision(4))]


def test_what_was_lifted_does_not_come_back():
    """Neither where the archive has no lift yet, nor where a clock that was behind put it first."""
    lift, block = decision(3, action="unblock"), decision(3)
    archived = [item(block.to_value(), 50)]
    assert decisions_for("s1", archived, [(60, lift)], 0, intake()) == [(60, lift)]
    assert decisions_for("s1", [item(lift.to_value(), 7), *archived], [], 0, intake()) == [(7, lift)]


def test_other_switches_and_all_switches():
    names = ("s1", "s2", "", "*")
    archived = [item(decision(n, name).to_value(), n + 1) for n, name in enumerate(names)]
    assert [each.switch for _, each in decisions_for("s1", archived, [], 0, intake())] == ["s1", "", "*"]


def test_what_cannot_be_read_is_left_out(caplog):
    heard = intake()
    assert heard.read("decision", Decision.from_item, item({"id": 5}, 1)) is None
    assert "(fields): Decision:" in caplog.text
    good = {"id": "c1", "updates": [{"kind": "delete", "table": "t"}]}
    key = "network.p4_command.firewall.s1"
    archived = [item({"no": 1}, 1, key), item(good, 2, key), item(good, 0, key)]
    assert [(at, command.id) for at, command in commands_of(archived, 1, heard)] == [(2, "c1")]
    assert heard.health()["refused_by_cause"] == {"fields": 1}


def command_item(name, timestamp):
    value = {"id": name, "updates": [{"kind": "delete", "table": "t"}]}
    return item(value, timestamp, "network.p4_command.firewall.s1")


def test_decisions_and_commands_are_told_in_the_order_in_which_they_were_written():
    """A command that deleted the entry of a block does not undo a block decided after it."""
    again = structs.replace(decision(3), id="d9")
    archived = [
        item(each.to_value(), at) for each, at in ((decision(3), 10), (again, 2000), (decision(4), 3000))
    ]
    decisions = decisions_for("s1", archived, [], 0, intake())
    commands = commands_of([command_item("c1", 1000), command_item("c2", 2500)], 0, intake())
    heard_too = commands[-1:]
    told = in_order(decisions, [*commands, *heard_too])
    assert [each.id for each in told] == ["c1", "d9", "c2", "d4"]


def test_a_decision_that_was_said_again_counts_from_then():
    archived = [item(decision(3).to_value(), at) for at in (10, 2000)]
    decisions = decisions_for("s1", archived, [], 0, intake())
    told = in_order(decisions, commands_of([command_item("c1", 1000)], 0, intake()))
    assert [each.id for each in told] == ["c1", "d3"]


def test_what_stands_comes_behind_the_lifts_of_its_target_whatever_the_clocks():
    """A firewall whose clock was set back writes a block "before" the lift of the one before it."""
    block = structs.replace(decision(3), id="d9", event_time=2)
    archived = [item(decision(3, action="unblock").to_value(), 90), item(block.to_value(), 30)]
    decisions = decisions_for("s1", archived, [], 0, intake())
    told = in_order(decisions, commands_of([command_item("c1", 60)], 0, intake()))
    assert [each.id for each in told] == ["c1", "d3", "d9"]
