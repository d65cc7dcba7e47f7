"""A rate limit as entries of the switch program: what it matches, its slot, and what is refused."""

import pytest

from apps.messages import Decision, RateLimit, Target
from apps.p4runtime_ctrl.errors import EntryError
from apps.p4runtime_ctrl.state.entry_updates import EntryUpdates
from apps.p4runtime_ctrl.state.guard import GuardSettings
from apps.p4runtime_ctrl.state.limits import SLOTS
from sdnator.testing.product_program import program

VICTIM = "10.0.0.1"


def book():
    return EntryUpdates(program(), GuardSettings(), ())


def decision(action="meter", address=VICTIM, **limit):
    fields = {"kind": "udp_from", "port": 53, "rate": 40} | limit
    target = Target(kind="ip", address=address)
    return Decision(
        id="d", action=action, switch="s1", target=target, reason="", event_time=1, expires=0,
        limit=RateLimit(**fields),
    )  # fmt: skip


def handles(order):
    return [program().describe(change.entry).removeprefix("ingress.") for change in order.changes]


@pytest.mark.parametrize(
    ("limit", "match"),
    [
        ({}, "protocol=17,sport=53"),
        ({"kind": "udp_to", "port": 123}, "protocol=17,dport=123"),
        ({"kind": "udp", "port": None}, "protocol=17"),
        ({"kind": "tcp", "port": 443}, "protocol=6,dport=443,tcp_flags=0&0x2"),
        ({"kind": "syn", "port": None, "open_ports": (22,)}, "protocol=6,tcp_flags=2&0x12"),
        ({"kind": "icmp", "port": None}, "protocol=1,icmp_type=8"),
    ],
)
def test_it_matches_what_the_decision_says(limit, match):
    found = handles(book().of_decision(decision(**limit)))[-1]
    assert found == f"limit[is_ipv4=1,dst={VICTIM},{match}]@1000"


def test_pings_over_ipv6_have_another_protocol_and_type():
    order = book().of_decision(decision(address="2001:db8::1", kind="icmp", port=None))
    fields = {each.field_id: each.ternary.value for each in order.main.entry.match}
    assert {bytes([58]), bytes([128])} <= set(fields.values())


def test_all_parts_are_there_before_the_limit_and_go_after_it():
    updates = book()
    made = updates.of_decision(decision(spared=("192.0.2.53",), spared_rate=60))
    names = [each.partition("[")[0] for each in handles(made)]
    assert names == ["limit_over", "limit_spared", "limit", "limit"]  # the first for later fragments
    rates = [each.entry.meter_config.pir for each in made.changes]
    assert rates == [0, 60, 40, 40]
    lifted = updates.of_decision(decision("unmeter", spared=("192.0.2.53",), spared_rate=60))
    assert handles(lifted) == handles(made)[::-1]
    assert lifted.main.entry.match == made.main.entry.match


def test_open_ports_come_before_a_limit_of_syns_and_have_a_meter_that_nothing_exceeds():
    updates = book()
    scanned = {"kind": "syn", "port": None, "open_ports": (22, 443)}
    made = updates.of_decision(decision(**scanned))
    found = handles(made)
    assert [each.rpartition("@")[2] for each in found[1:]] == ["1001", "1001", "1000"]
    assert {"dport=22" in each for each in found[1:3]} == {True, False}
    rates = [each.entry.meter_config.pir for each in made.changes]
    assert rates == [0, 1 << 31, 1 << 31, 40]
    assert handles(updates.of_decision(decision("unmeter", **scanned))) == found[::-1]


def test_slots_are_kept_freed_and_end():
    updates = book()
    for number in range(SLOTS):
        updates.of_decision(decision(address=f"10.0.1.{number}"))
    with pytest.raises(EntryError, match="256 rate limits are in force already"):
        updates.of_decision(decision())
    updates.of_decision(decision("unmeter", address="10.0.1.7"))
    assert updates.of_decision(decision()).main.entry.action.action.params[0].value == bytes([7])
    updates.give_up(updates.of_decision(decision()))
    assert updates.of_decision(decision(port=123)).main.entry.action.action.params[0].value == bytes([7])


def test_what_is_not_in_force_cannot_be_lifted():
    with pytest.raises(EntryError, match="no rate limit of UDP from port 53"):
        book().of_decision(decision("unmeter"))


def test_a_prefix_can_be_a_victim():
    found = handles(book().of_decision(decision(address="10.0.0.0/24")))[-1]
    assert found == f"limit[is_ipv4=1,dst=10.0.0.0&0x{'f' * 30}00,protocol=17,sport=53]@1000"
