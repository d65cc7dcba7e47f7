"""A switch is brought to its desired state whatever happened to it, and every decision is confirmed."""

import pytest

from apps.messages import Decision, RateLimit, TableCommand, TableUpdate, Target
from apps.p4runtime_ctrl.errors import Unreachable
from apps.p4runtime_ctrl.state.desired_state import DELETE, INSERT, MODIFY, EntrySet, is_standing
from apps.p4runtime_ctrl.state.desired_switch import DesiredSwitch, UpdateOutcome
from apps.p4runtime_ctrl.telemetry.classifier import TelemetryRequest
from sdnator.testing.product_program import program

PACKETS = TelemetryRequest(name="packets", bit=255)


class Held:
    """A transport that keeps entries in memory."""

    def __init__(self):
        self.loaded = False
        self.entries, self.standing = EntrySet(), EntrySet()
        self.batches = []
        self.refuse = {}
        self.broken = False

    def ensure_program(self):
        was, self.loaded = self.loaded, True
        return not was

    def ensure_copies(self):
        pass

    def ensure_digests(self):
        pass

    def read_entries(self):
        return list(self.entries)

    def read_standing(self, entries):
        found = [self.standing.get(entry) for entry in entries]
        return [entry for entry in found if entry is not None]

    def read_counters(self, table_id):
        return [entry for entry in self.entries if entry.table_id == table_id]

    def write(self, changes):
        if self.broken:
            raise Unreachable("gone")
        self.batches.append([program().describe(change.entry) for change in changes])
        return [self.one(change) for change in changes]

    def one(self, change):
        name = program().describe(change.entry)
        if name in self.refuse:
            return UpdateOutcome(*self.refuse[name])
        if is_standing(change.entry):
            self.standing.put(change.entry)
        elif change.kind == INSERT:
            if change.entry in self.entries:
                return UpdateOutcome(6, "it exists")
            self.entries.put(change.entry)
        elif change.kind == MODIFY:
            if change.entry not in self.entries:
                return UpdateOutcome(5, "there is no such entry")
            self.entries.put(change.entry)
        elif change.kind == DELETE and not self.entries.discard(change.entry):
            return UpdateOutcome(5, "there is no such entry")
        return UpdateOutcome()

    def names(self):
        return {program().describe(entry) for entry in self.entries}


def make(**options):
    return DesiredSwitch("s1", program(), lambda: (77, 5), **options)


def decision(number, action="block", address="10.0.0.1", **fields):
    target = Target(kind="ip", address=address)
    return Decision(
        id=f"d{number}",
        action=action,
        switch="s1",
        target=target,
        reason="",
        event_time=1,
        expires=0,
        **fields,
    )


def block_name(address):
    return f"ingress.block_src[is_ipv4=1,src={address}]"


def said(confirmations):
    return [(c.id, c.state) for c in confirmations]


def test_a_fresh_switch_gets_everything_and_a_second_time_nothing():
    held, switch = Held(), make(forward={1: 2, 2: 1})
    switch.want([PACKETS], None)
    report = switch.bring_up(held)
    assert report.program_loaded
    assert (report.inserted, report.removed, report.failed) == (2, 0, {})
    assert len(held.batches) == 1
    again = switch.bring_up(held)
    assert str(again) == "nothing to change"
    assert len(held.batches) == 1


def test_fail_open_puts_wires_first_and_fail_closed_last():
    for fail, place in (("open", 0), ("closed", -1)):
        held, switch = Held(), make(forward={1: 2}, fail=fail)
        switch.decide([decision(1)], None)
        switch.want([PACKETS], None)
        switch.bring_up(held)
        assert held.batches[0][place] == "ingress.forward_port[ingress_port=1]"
        switch.withdraw(held)
        assert ("ingress.forward_port[ingress_port=1]" in held.names()) == (fail == "open")


def test_decisions_are_installed_confirmed_and_undone():
    held, switch = Held(), make()
    switch.bring_up(held)
    first, second = switch.decide([decision(1), decision(2, address="10.0.0.2")], held)
    assert (first.state, first.handle, first.event_time, first.arrival) == (
        "installed", block_name("10.0.0.1"), 77, 5,
    )  # fmt: skip
    assert second.target == Target(kind="ip", address="10.0.0.2")
    assert len(held.batches[-1]) == 2
    assert said(switch.decide([decision(3)], held)) == [("d3", "exists")]
    assert switch.blocks == 2
    assert said(switch.decide([decision(4, "unblock")], held)) == [("d4", "removed")]
    assert said(switch.decide([decision(5, "unblock")], held)) == [("d5", "removed")]
    assert held.names() == {block_name("10.0.0.2")}


def test_a_block_and_its_undoing_in_one_go_keep_their_order():
    held, switch = Held(), make()
    switch.bring_up(held)
    done = switch.decide([decision(1), decision(2, "unblock"), decision(3)], held)
    assert said(done) == [("d1", "installed"), ("d2", "removed"), ("d3", "installed")]
    assert held.names() == {block_name("10.0.0.1")}


def test_dry_runs_leave_no_trace():
    held, switch = Held(), make()
    switch.bring_up(held)
    assert switch.decide([decision(1, dry_run=True)], held) == []
    assert switch.restore([decision(1, dry_run=True)]) == []
    assert not switch.blocks
    assert not held.names()


def test_a_refused_block_is_failed_with_its_name_and_not_tried_for_ever():
    held, switch = Held(), make()
    switch.bring_up(held)
    held.refuse[block_name("10.0.0.1")] = (8, "table is full")
    (answer,) = switch.decide([decision(1)], held)
    assert answer.state == "failed"
    assert answer.cause == f"{block_name('10.0.0.1')}: table is full"
    assert not switch.blocks
    (answer,) = switch.decide([decision(2, address="nonsense")], held)
    assert (answer.state, answer.cause) == ("failed", "target 'nonsense' is not an IP address")


def test_decisions_made_while_the_switch_is_away_are_carried_out_later():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([decision(1)], held)
    held.broken = True
    away = switch.decide([decision(2, address="10.0.0.2"), decision(3, "unblock")], held)
    away += switch.decide([decision(4, address="10.0.0.4")], None)
    assert {state for _, state in said(away)} == {"pending"}
    assert "is kept" in away[0].cause
    held.broken = False
    report = switch.bring_up(held)
    assert held.names() == {block_name("10.0.0.2"), block_name("10.0.0.4")}
    assert sorted(said(report.confirmations)) == [("d2", "installed"), ("d3", "removed"), ("d4", "installed")]
    assert str(report) == "2 inserted, 1 removed"


def test_what_the_switch_refuses_when_it_is_back_is_given_up():
    """The firewall does not hold it to be in force any more, so nobody would ever lift it."""
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([decision(1)], None)
    held.refuse[block_name("10.0.0.1")] = (8, "table is full")
    assert said(switch.bring_up(held).confirmations) == [("d1", "failed")]
    assert not switch.blocks
    held.refuse.clear()
    assert str(switch.bring_up(held)) == "nothing to change"
    assert not held.names()


def test_what_another_controller_will_have_confirmed_is_carried_out_and_not_confirmed():
    held, switch = Held(), make()
    switch.decide([decision(1)], None)
    switch.age_unconfirmed()
    switch.decide([decision(2, address="10.0.0.2")], None)
    switch.age_unconfirmed()
    assert said(switch.bring_up(held).confirmations) == [("d2", "installed")]
    assert held.names() == {block_name("10.0.0.1"), block_name("10.0.0.2")}


def test_a_restarted_switch_and_a_restarted_controller():
    held, switch = Held(), make(forward={1: 2})
    switch.bring_up(held)
    switch.decide([decision(1), decision(2, address="10.0.0.2"), decision(3, "unblock")], held)
    anew = Held()
    assert switch.bring_up(anew).program_loaded
    assert anew.names() == held.names()
    history = [decision(1), decision(2, address="10.0.0.2"), decision(3, "unblock")]
    heir = make(forward={1: 2})
    assert heir.restore(history) == []
    assert str(heir.bring_up(held)) == "nothing to change"
    assert counted(heir, held)[0]["id"] == "d2"


def test_entries_that_nobody_asked_for_are_removed():
    held = Held()
    other = make()
    other.bring_up(held)
    other.decide([decision(9, address="10.9.9.9")], held)
    report = make().bring_up(held)
    assert str(report) == "1 removed"
    assert not held.names()


def test_commands_are_confirmed_update_by_update():
    held, switch = Held(), make()
    switch.bring_up(held)
    good = TableUpdate(
        kind="insert", table="allow", match={"src": "10.0.0.7"}, action="allow_frame", priority=3
    )
    bad = TableUpdate(kind="insert", table="block", match={"port": 5}, action="drop_frame", priority=1)
    (answer,) = switch.command(TableCommand(id="c1", updates=(good, bad)), held)
    assert (answer.id, answer.state, answer.action) == ("c1", "failed", "insert")
    assert "ingress.block: no match field 'port'" in answer.cause
    assert not held.names()
    gone = TableUpdate(kind="delete", table="allow", match={"src": "10.0.0.8"}, priority=3)
    answers = switch.command(TableCommand(id="c2", updates=(good, gone)), held)
    assert said(answers) == [("c2", "installed"), ("c2", "removed")]
    assert held.names() == {"ingress.allow[src=10.0.0.7]@3"}


def test_an_insert_never_changes_what_is_there():
    held, switch = Held(), make()
    switch.bring_up(held)

    def wire(kind, port):
        update = TableUpdate(
            kind=kind,
            table="forward_port",
            match={"ingress_port": 5},
            action="to_port",
            params={"port": port},
        )
        (answer,) = switch.command(TableCommand(id="c", updates=(update,)), held)
        return answer.state, answer.cause

    assert wire("insert", 6) == ("installed", "")
    assert wire("insert", 6) == ("exists", "it exists")
    state, cause = wire("insert", 7)
    assert (state, "use modify" in cause) == ("exists", True)
    assert str(switch.bring_up(held)) == "nothing to change"
    assert wire("modify", 7) == ("installed", "")


def test_a_command_may_not_touch_the_classifier():
    update = TableUpdate(
        kind="modify",
        table="telemetry_active",
        action="set_active",
        params={"active": 0, "copies": 0, "digests": 0},
    )
    (answer,) = make().command(TableCommand(id="c1", updates=(update,)), Held())
    assert "request packets instead" in answer.cause


def test_idle_entries_are_deleted_and_confirmed_once():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([decision(1)], held)
    idle = list(held.entries)
    assert said(switch.expire(idle, held)) == [("d1", "expired")]
    assert switch.expire(idle, held) == []
    assert not held.names()


def test_telemetry_follows_what_is_wanted():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.want([PACKETS], held)
    assert held.batches[-1][-1] == "ingress.telemetry_active[default]"
    switch.want([PACKETS], held)
    before = len(held.batches)
    switch.want([], held)
    assert held.batches[before][0] == "ingress.telemetry_active[default]"
    assert str(switch.bring_up(held)) == "nothing to change"


def test_while_demand_is_unknown_telemetry_is_left_as_it_is():
    held, switch = Held(), make()
    switch.want([PACKETS], None)
    switch.bring_up(held)
    heir = make()
    assert str(heir.bring_up(held)) == "nothing to change"
    before = len(held.batches)
    assert heir.want([PACKETS], held) == []
    assert len(held.batches) == before
    heir.want([], held)
    assert held.batches[before][0] == "ingress.telemetry_active[default]"


def counted(switch, transport):
    return switch.readings(
        entry for table in switch.counted_tables for entry in transport.read_counters(table)
    )


def test_counters_name_the_decision():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([decision(1)], held)
    assert counted(switch, held) == [{"id": "d1", "handle": block_name("10.0.0.1"), "packets": 0, "bytes": 0}]


def service(number, action, port, address="10.0.0.80"):
    target = Target(kind="ip", address=address, port=port)
    return Decision(
        id=f"p{number}", action=action, switch="s1", target=target, reason="", event_time=1, expires=0
    )


def test_a_protected_service_gets_its_meters_and_its_host():
    held, switch = Held(), make()
    switch.bring_up(held)
    answers = switch.decide([service(1, "protect", 80), service(2, "protect", 443)], held)
    assert said(answers) == [("p1", "installed"), ("p2", "installed")]
    assert answers[0].handle == "ingress.protect[is_ipv4=1,dst=10.0.0.80,dport=80]"
    host = "ingress.protected_hosts[is_ipv4=1,dst=10.0.0.80]"
    assert held.names() == {
        "ingress.protect[is_ipv4=1,dst=10.0.0.80,dport=80]",
        "ingress.protect[is_ipv4=1,dst=10.0.0.80,dport=443]",
        host,
    }
    slots = {
        entry.index.index for entry in held.standing if is_standing(entry) and hasattr(entry, "meter_id")
    }
    assert slots == {0, 1}
    assert switch.guards
    assert str(switch.bring_up(held)) == "nothing to change"
    assert said(switch.decide([service(3, "unprotect", 80)], held)) == [("p3", "removed")]
    assert host in held.names()
    assert said(switch.decide([service(4, "unprotect", 443)], held)) == [("p4", "removed")]
    assert not held.names()
    assert not switch.guards


def test_a_service_needs_a_port():
    (answer,) = make().decide([service(1, "protect", None)], Held())
    assert answer.cause == "protect 10.0.0.80: a service is an IP address and a TCP port"


def test_secrets_take_turns_and_survive_a_restart_of_the_switch():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.change_secret(1, 2, held)
    switch.change_secret(3, 4, held)
    anew = Held()
    switch.bring_up(anew)
    secrets = program().table("guard_secrets").id
    (entry,) = (e for e in anew.standing if getattr(e, "table_id", 0) == secrets)
    assert [int.from_bytes(p.value, "big") for p in entry.action.action.params] == [0, 3, 4, 1, 2]


def test_known_sources_are_metered():
    held, switch = Held(), make()
    switch.bring_up(held)
    update = TableUpdate(
        kind="insert", table="known_sources", match={"is_ipv4": 1, "src": "10.0.0.5"}, action="known"
    )
    assert said(switch.command(TableCommand(id="c", updates=(update,)), held)) == [("c", "installed")]
    (entry,) = held.entries
    assert entry.meter_config.cir == 20


def wire(kind, egress=0, ingress=5):
    given = {} if kind == "delete" else {"action": "to_port", "params": {"port": egress}}
    update = TableUpdate(kind=kind, table="forward_port", match={"ingress_port": ingress}, **given)
    return TableCommand(id=f"{kind}{egress}", updates=(update,))


@pytest.mark.parametrize(
    "commands",
    [
        [wire("insert", 6), wire("insert", 7)],
        [wire("modify", 7)],
        [wire("insert", 6), wire("modify", 7), wire("insert", 8)],
        [wire("insert", 6), wire("delete"), wire("modify", 7)],
        [wire("modify", 6), wire("insert", 7), wire("delete"), wire("insert", 8)],
    ],
)
def test_what_the_switch_had_refused_is_not_carried_out_after_a_restart(commands):
    held, switch = Held(), make()
    switch.bring_up(held)
    for each in commands:
        switch.command(each, held)
    heir = make()
    assert heir.restore(commands) == []
    assert str(heir.bring_up(held)) == "nothing to change"


def test_what_is_replayed_at_a_takeover_does_not_go_by_how_it_ended():
    history = [wire("modify", 7), wire("insert", 6)]
    held, heir = Held(), make()
    heir.bring_up(held)
    for each in history:
        heir.command(each, held)
    assert heir.restore(history) == []
    assert str(heir.bring_up(held)) == "nothing to change"


def test_an_entry_that_may_have_expired_is_inserted_again():
    """Nothing says when it did: the later insert is the better guess."""

    def known(rate):
        update = TableUpdate(
            kind="insert",
            table="smac",
            match={"vid": 0, "eth_src": 7},
            action="known_station",
            params={"port": rate},
            idle_timeout_ns=1_000,
        )
        return TableCommand(id="c", updates=(update,))

    held, switch = Held(), make()
    switch.bring_up(held)
    switch.command(known(1), held)
    switch.expire(list(held.entries), held)
    switch.command(known(2), held)
    heir = make()
    heir.restore([known(1), known(2)])
    assert str(heir.bring_up(held)) == "nothing to change"


def test_a_block_holds_against_a_command_that_had_deleted_the_one_before_it():
    held, switch = Held(), make()
    switch.bring_up(held)
    match = {"is_ipv4": 1, "src": "10.0.0.1"}
    unblock = TableCommand(id="c", updates=(TableUpdate(kind="delete", table="block_src", match=match),))
    switch.decide([decision(1)], held)
    switch.command(unblock, held)
    switch.decide([decision(2)], held)
    heir = make()
    heir.restore([unblock, decision(2)])
    assert str(heir.bring_up(held)) == "nothing to change"
    assert heir.blocks == 1


def of_ports(count):
    """With as many VLANs they fill the table of 256 entries: each pair overlaps."""
    return [TelemetryRequest(name=f"port{n}", bit=n, conditions={"ingress_port": n}) for n in range(count)]


def of_vlans(count):
    return [TelemetryRequest(name=f"vlan{n}", bit=100 + n, conditions={"vid": n}) for n in range(count)]


def test_telemetry_in_force_stays_when_more_is_asked_for_than_the_tables_hold():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.want(of_ports(15), held)
    asked = [*of_vlans(16), *of_ports(15), PACKETS]
    fit, left_out = switch.fitting(asked)
    assert fit == [each for each in asked if each.name != "vlan15"]
    assert list(left_out) == ["vlan15"]
    assert "has room for 256 conditions" in left_out["vlan15"]
    assert switch.want(fit, held) == []
    assert switch.fitting(asked[1:]) == (asked[1:], {})


def limit(number, address, action="meter", spared=()):
    rate = RateLimit(kind="udp", rate=100, spared=spared, spared_rate=50)
    return decision(number, action, address, limit=rate)


SPARED = "ingress.limit_spared[slot=0,is_ipv4=1,src=203.0.113.7]"


def limited(address):
    """What the switch calls the entry of a rate limit."""
    switch = make()
    (answer,) = switch.decide([limit(0, address)], None)
    return answer.handle


def test_of_a_rate_limit_that_fails_half_way_nothing_is_left_for_the_next_one():
    held, switch = Held(), make()
    switch.bring_up(held)
    held.refuse[limited("10.0.0.1")] = (8, "table is full")
    assert said(switch.decide([limit(1, "10.0.0.1", spared=("203.0.113.7",))], held)) == [("d1", "failed")]
    assert not held.names()
    assert said(switch.decide([limit(2, "10.0.0.2")], held)) == [("d2", "installed")]
    assert held.names() == {limited("10.0.0.2"), "ingress.limit_over[slot=0]"}


def test_a_slot_stays_taken_until_what_was_left_in_it_is_gone():
    held, switch = Held(), make()
    switch.bring_up(held)
    held.refuse[limited("10.0.0.1")] = (8, "table is full")
    take = held.one

    def keeps(change):
        if change.kind == DELETE and program().describe(change.entry) == SPARED:
            return UpdateOutcome(2, "not now")
        return take(change)

    held.one = keeps
    switch.decide([limit(1, "10.0.0.1", spared=("203.0.113.7",))], held)
    assert held.names() == {SPARED}
    switch.decide([limit(2, "10.0.0.2")], held)
    assert "ingress.limit_over[slot=1]" in held.names()
    held.one = take
    assert str(switch.bring_up(held)) == "1 removed"
    switch.decide([limit(3, "10.0.0.3")], held)
    assert "ingress.limit_over[slot=0]" in held.names()


def test_a_limit_in_force_outlives_the_refusal_of_more_spared_sources():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([limit(1, "10.0.0.1")], held)
    before = held.names()
    held.refuse[SPARED] = (8, "table is full")
    more = switch.decide([limit(2, "10.0.0.1", spared=("203.0.113.8", "203.0.113.7"))], held)
    assert said(more) == [("d2", "failed")]
    assert held.names() == before
    switch.decide([limit(3, "10.0.0.2")], held)
    assert "ingress.limit_over[slot=1]" in held.names()


def test_of_a_rate_limit_that_fails_when_the_switch_is_back_nothing_is_left():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([limit(1, "10.0.0.1", spared=("203.0.113.7",))], None)
    held.refuse[limited("10.0.0.1")] = (8, "table is full")
    assert said(switch.bring_up(held).confirmations) == [("d1", "failed")]
    assert not switch.blocks
    held.refuse.clear()
    assert not held.names()
    assert str(switch.bring_up(held)) == "nothing to change"


def test_a_protected_service_keeps_its_host_when_another_one_of_it_is_refused():
    held, switch = Held(), make()
    switch.bring_up(held)
    switch.decide([service(1, "protect", 80)], held)
    held.refuse["ingress.protect[is_ipv4=1,dst=10.0.0.80,dport=443]"] = (8, "table is full")
    before = held.names()
    for transport in (held, None):
        switch.decide([service(2, "protect", 443)], transport)
        switch.bring_up(held)
        assert held.names() == before
    assert str(switch.bring_up(held)) == "nothing to change"
