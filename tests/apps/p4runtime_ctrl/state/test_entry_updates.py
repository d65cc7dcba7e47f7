"""Entry updates of one program: what stands for them, which slots they take, and what is refused."""

import pytest

from apps.messages import Decision, TableCommand, TableUpdate, Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.southbound.values import number
from apps.p4runtime_ctrl.state.entry_updates import EntryUpdates
from apps.p4runtime_ctrl.state.guard import SLOTS, GuardSettings
from sdnator.testing.product_program import program


def book(reserved=()):
    return EntryUpdates(program(), GuardSettings(), reserved)


def decision(action, address, port=80):
    target = Target(kind="ip", address=address, port=port)
    return Decision(id="d", action=action, switch="s1", target=target, reason="", event_time=1, expires=0)


def slot(update):
    return number(update.main.entry.action.action.params[0].value)


def test_slots_are_given_kept_and_freed():
    updates = book()
    first, second = (updates.of_decision(decision("protect", f"10.0.0.{n}")) for n in (1, 2))
    assert [slot(first), slot(second)] == [0, 1]
    assert slot(updates.of_decision(decision("protect", "10.0.0.2"))) == 1
    updates.of_decision(decision("unprotect", "10.0.0.1"))
    assert slot(updates.of_decision(decision("protect", "10.0.0.3"))) == 0
    refused = updates.of_decision(decision("protect", "10.0.0.4"))
    updates.give_up(refused)
    assert slot(updates.of_decision(decision("protect", "10.0.0.5"))) == 2


def test_slots_end():
    updates = book()
    for port in range(SLOTS):
        updates.of_decision(decision("protect", "10.0.0.1", 1 + port))
    with pytest.raises(EntryError, match="256 services are protected already"):
        updates.of_decision(decision("protect", "10.0.0.1", 9999))


def test_the_service_stands_for_its_protection_and_release():
    updates = book()
    for action in ("protect", "unprotect"):
        update = updates.of_decision(decision(action, "10.0.0.1"))
        assert program().describe(update.main.entry) == "ingress.protect[is_ipv4=1,dst=10.0.0.1,dport=80]"


def test_commands_are_checked_update_by_update():
    good = TableUpdate(kind="insert", table="block_src", match={"is_ipv4": 1, "src": 1}, action="drop_src")
    wrong = TableUpdate(kind="insert", table="block_src", match={"src": 1}, action="drop_src")
    updates, refused = book().of_command(TableCommand(id="c", updates=(good, wrong)))
    assert [program().describe(update.main.entry) for update in updates] == [
        "ingress.block_src[is_ipv4=1,src=0.0.0.1]"
    ]
    assert [(owner.id, "is_ipv4" in reason) for owner, reason in refused] == [("c", True)]
    reserved = {program().table("block_src").id}
    _, refused = book(reserved).of_command(TableCommand(id="c", updates=(good,)))
    assert "which all requests share" in refused[0][1]
