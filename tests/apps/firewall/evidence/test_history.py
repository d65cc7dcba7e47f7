"""What archived decisions and instructions come to."""

from apps.firewall.evidence.history import allowed_by, count_offences, decisions_in
from apps.messages import Decision, Instruction, Target
from due import Item
from tests.apps.firewall.enforcement.test_eve import decision

ADDRESS = Target(kind="ip", address="192.0.2.1")


def item(made: Decision, at: int) -> Item:
    return Item("network.block.firewall.ipv4", made.to_value(), at, at, "firewall", "i", at)


def test_decisions_are_read_in_the_order_of_writing():
    """Dry runs changed nothing and are left out."""
    items = [item(decision(action="unblock"), 2), item(decision(), 1), item(decision(dry_run=True), 3)]
    assert [each.action for each in decisions_in(items)] == ["block", "unblock"]


def test_offences_are_counted_by_decision():
    """An extension is no new offence, nor is what comes later or was a dry run."""
    later = decision(id="d9", event_time=2 * 10**18)
    items = [item(each, 1) for each in (decision(), decision(expires=9), decision(id="d2"), later)]
    items.append(item(decision(id="d3", dry_run=True), 1))
    assert count_offences(items, ADDRESS, 19 * 10**17) == 2


def test_allow_list_follows_from_what_people_said():
    """In the order they said it, on top of the settings."""
    said = [
        Instruction(id="1", verb="allow", subject="10.0.0.0/8"),
        Instruction(id="2", verb="block", subject="192.0.2.1"),
        Instruction(id="3", verb="allow", subject="192.0.2.9"),
        Instruction(id="4", verb="disallow", subject="10.0.0.0/8"),
    ]
    assert allowed_by(said, ["172.16.0.1"]) == ("172.16.0.1", "192.0.2.9")
