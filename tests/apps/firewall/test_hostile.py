"""The firewall refuses what is no message, counts it, and goes on with what is one."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples

from apps.firewall.service import INTERESTS, SYN_INTERESTS
from apps.firewall.syn.suspect_samples import SuspectSamples
from apps.firewall.syn.syn_policy import SynRules
from apps.messages import Instruction
from due import Item
from tests.apps.firewall.alerts import CAMERA, SECOND, alert
from tests.apps.firewall.desk import ALERT, ARP, HANDSHAKE, NOW, SWITCH, SYN_ACKS, SYNS, Desk, FakeEngine
from tests.apps.firewall.enforcement.test_eve import decision
from tests.apps.firewall.policy.test_sequential_test import evidence
from tests.apps.firewall.rows import arp, records, syn_ack
from tests.apps.firewall.syn.test_recent_syns import batch
from tests.apps.hostile import carried, mutations, values

INSTRUCTION = "network.instruction.operator.firewall"
FLOOD = "network.traffic_query.sonata.syn_flood:threshold=100,window=200ms"
SURGE = "network.traffic_query.sonata.new_tcp:threshold=100,window=200ms"
SUSPECTS = {
    f"network.packets.p4runtime_ctrl.s1.{name}": f"network.packets.p4runtime_ctrl.*.{name}"
    for name in SuspectSamples.names()
}
CONFIRMATION = "network.confirmation.p4runtime_ctrl.s1"
SPOKEN = "network.evidence.kitsune.ports"
TRAINED = "network.training.kitsune"
HUNDRED_YEARS = 100 * 365 * 86_400 * SECOND
PATTERNS = {
    INSTRUCTION: "network.instruction.*.firewall",
    SWITCH: "network.switch.p4runtime_ctrl.*",
    CONFIRMATION: "network.confirmation.p4runtime_ctrl.*",
    SPOKEN: "network.evidence.kitsune.*",
    TRAINED: "network.training.*",
    **SUSPECTS,
}
GENUINE = {
    ALERT: alert(NOW // SECOND).to_value(),
    CONFIRMATION: {"id": "d", "switch": "s1", "state": "failed", "action": "block", "event_time": NOW},
    SWITCH: {
        "switch": "s1", "primary": True, "event_time": NOW, "blocks": [{"id": "d", "packets": 5, "bytes": 1}],
    },
    INSTRUCTION: Instruction(id="i", verb="block", subject="192.0.2.1").to_value(),
    HANDSHAKE: {"source": "10.0.0.1", "service": "10.0.0.2", "port": 80, "at": NOW},
    FLOOD: {"dst": "10.0.0.1", "count": 5, "window_start": NOW},
    SYNS: batch(*[(NOW // 1000, "10.1.0.1", "10.0.0.1", 80)] * 3),
    SURGE: {"dst": "10.0.0.1", "count": 5, "window_start": NOW},
    **{key: batch((NOW // 1000, "10.1.0.1", "10.0.0.1", 80)) for key in SUSPECTS},
    SYN_ACKS: records([syn_ack("77.0.0.1", 1, "10.0.0.1", 8, time_us=NOW // 1000)]),
    SPOKEN: evidence(4.0, NOW // SECOND).to_value(),
    TRAINED: {"packets": 9, "wanted": 9, "done": True, "seconds": 60.0, "senders": 5, "event_time": NOW},
    ARP: records([arp(NOW / 1e9, 1, 0x020000000001, "10.0.0.1")]),
}  # fmt: skip


def hand(desk, key, value, *, app="", event=NOW):
    named = key.partition(":")[0].split(".")[2]
    writer = app or ("sonata_adapter" if named == "sonata" else named)
    item = Item(key, carried(value), NOW, event, writer, "i1", 1)
    desk.engine.subjects[PATTERNS.get(key, key)].on_next(item)


def copies_for(key):
    """The setting with which the firewall listens to a key."""
    return "suspects" if key in (SURGE, *SUSPECTS) else "all"


def still_works(desk, number=99):
    """An instruction is carried out, and an alert leads to a block."""
    subject = f"203.0.113.{number}"
    hand(desk, INSTRUCTION, Instruction(id=f"n{number}", verb="block", subject=subject).to_value())
    assert subject in desk.blocked
    desk.service.tick()


def test_all_interests_are_tried():
    """A new interest of the firewall has to be fuzzed, too."""
    tried = {PATTERNS.get(key, key).partition(":")[0] for key in GENUINE}
    assert {each.key.partition(":")[0] for each in (*INTERESTS, *SYN_INTERESTS)} == tried


@pytest.mark.parametrize("key", GENUINE)
def test_hostile_values_are_refused_and_counted(key, caplog):
    """Every wrong value under every key leaves the firewall alive; the log stays short."""
    desk = Desk(syn=SynRules(grace_ms=0, patience_ms=0), copies=copies_for(key))
    number = 0
    for number, value in enumerate(mutations(GENUINE[key]), start=1):  # noqa: B007 - the last one is used
        hand(desk, key, value)
    still_works(desk)
    health = desk.service.health()
    assert health["refused_messages"] > number / 5
    assert sum(health["refused_by_cause"].values()) == health["refused_messages"]
    assert sum("refused a message" in record.message for record in caplog.records) < 20


@pytest.mark.parametrize("key", GENUINE)
def test_nobody_speaks_for_another_app(key):
    """A genuine message under another app's key does nothing, and is counted."""
    desk = Desk(switches=(), copies=copies_for(key))
    hand(desk, key, GENUINE[key], app="intruder")
    assert desk.service.health()["refused_by_cause"] == {"sender": 1}
    assert desk.engine.written == []


@examples(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(values)
def test_any_plain_value_under_any_key(value):
    """Whatever values hypothesis makes, no callback raises."""
    for copies in ("all", "suspects"):
        desk = Desk(copies=copies)
        for key, genuine in GENUINE.items():
            hand(desk, key, value)
            if isinstance(genuine, dict) and isinstance(value, dict):
                hand(desk, key, {**genuine, **value})
        still_works(desk)


def test_a_time_far_ahead_ends_no_block():
    """One alert, state, SYN, handshake or flood from the year 2123 lifts nothing, and real time goes on."""
    desk = Desk(syn=SynRules(grace_ms=0, patience_ms=0))
    hand(desk, ALERT, GENUINE[ALERT])
    assert len(desk.blocked) == 1
    later = NOW + HUNDRED_YEARS // 2
    hand(desk, ALERT, alert(later // SECOND, CAMERA).to_value())
    hand(desk, SWITCH, {**GENUINE[SWITCH], "event_time": later})
    hand(desk, SYNS, batch((later // 1000, "10.1.0.1", "10.0.0.1", 80)), event=later)
    hand(desk, HANDSHAKE, {**GENUINE[HANDSHAKE], "at": later})
    hand(desk, ALERT, GENUINE[ALERT])
    desk.service.tick()
    assert [each.action for each in desk.decisions] == ["block"]
    assert desk.service.health()["times_doubted"] >= 3
    hand(desk, SWITCH, {**GENUINE[SWITCH], "event_time": NOW + 700 * SECOND})
    assert [each.action for each in desk.decisions] == ["block", "unblock"]


def test_surges_are_seen_after_a_packet_from_the_future():
    """Its window does not stay the newest one."""
    desk = Desk(syn=SynRules(grace_ms=0, patience_ms=0))
    flood = [(NOW // 1000, f"77.0.{n // 256}.{n % 256}", "10.0.0.1", 80) for n in range(600)]
    hand(desk, SYNS, batch(*flood[:5]))
    hand(desk, SYNS, batch(((NOW + HUNDRED_YEARS) // 1000, "10.1.0.1", "10.0.0.1", 80)))
    hand(desk, SYNS, batch(*flood))
    desk.service.tick()
    assert desk.guarded == ["10.0.0.1"]


class Counted(FakeEngine):
    """An engine that notes how much it has told."""

    read = 0

    def get(self, query, *, limit=None):
        found = super().get(query, limit=limit)
        self.read += len(found)
        return found


def test_of_many_archived_decisions_only_recent_ones_are_read(monkeypatch):
    """100,000 decisions of two years: what is older than the longest block is not read."""
    monkeypatch.setattr("apps.firewall.evidence.archived_state.time.time_ns", lambda: NOW)
    engine, step = Counted(), 2 * 365 * 86_400 * SECOND // 100_000
    value = decision(event_time=1, expires=2).to_value()
    engine.archived = [
        Item("network.block.firewall.ipv4", value, NOW - step * age, 1, "firewall", "f", age)
        for age in range(100_000, 0, -1)
    ]
    last = decision(id="last", target=decision().target, event_time=NOW, expires=NOW + SECOND).to_value()
    engine.archived.append(Item("network.block.firewall.ipv4", last, NOW - 1, 1, "firewall", "f", 0))
    desk = Desk(engine=engine, switches=())
    within = (31 * 86_400 * SECOND) // step
    assert within <= engine.read <= within + 50
    assert desk.service.health()["archive_items_read"] == engine.read
    assert desk.service.health()["blocks"] == 1


@pytest.mark.parametrize("value", [None, np.ones(3), {"id": []}, {"source": "x"}, b"\xff"])
def test_archived_items_are_checked_as_well(value, monkeypatch):
    """What was archived by somebody else, or damaged, does not keep the firewall from starting."""
    monkeypatch.setattr("apps.firewall.evidence.archived_state.time.time_ns", lambda: NOW)
    engine = FakeEngine()
    keys = (
        "network.block.firewall.ipv4", "network.protect.firewall.ipv4", "network.block_prefix.firewall.ipv4",
        HANDSHAKE, INSTRUCTION, "network.answer.firewall.operator", "network.p4_command.firewall_kept.s1",
    )  # fmt: skip
    named = {HANDSHAKE: "sonata_adapter", INSTRUCTION: "operator"}
    for number, key in enumerate(keys, start=1):
        engine.archived.append(Item(key, value, NOW, NOW, named.get(key, "firewall"), "i", number))
    desk = Desk(engine=engine)
    still_works(desk)
    assert desk.service.health()["refused_messages"] >= len(keys) - 1
