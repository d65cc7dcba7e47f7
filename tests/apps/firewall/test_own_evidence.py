"""What the firewall itself finds is evidence that any app can read, and decides as the object that was written."""

import json

import pytest
from msgspec import structs

import apps.firewall.service as firewall
from apps.evidence import Evidence, TrainingState
from apps.firewall.syn.syn_policy import SynRules
from apps.incidents import Incident
from apps.messages import Decision, Instruction
from due import Item
from sdnator.blocks.decision_summary import five_lines
from sdnator.testing import AppRun, wait_for
from tests.apps.firewall.alerts import CAMERA, SECOND, alert
from tests.apps.firewall.desk import ALERT, ARP, NOW, SYNS, Desk, FakeEngine
from tests.apps.firewall.policy.test_sequential_test import evidence
from tests.apps.firewall.rows import arp, records
from tests.apps.firewall.syn.test_recent_syns import batch
from tests.apps.firewall.test_evidence import AT, desk, hear

OWN = "network.evidence.firewall"
VICTIM = "10.0.0.1"
OWNER, THIEF = 0x02_00_00_00_00_07, 0x02_00_00_00_00_66
TRAINED = [arp(0, 1, OWNER, "10.0.0.7"), arp(1, 3, THIEF, "10.0.0.66"), arp(599, 1, OWNER, "10.0.0.7")]
QUICK = {"copies": "all", "grace_ms": 0, "patience_ms": 0, "resets": 0}
TRAINING = TrainingState(packets=9, wanted=9, done=True, seconds=3_600.0, senders=20, event_time=NOW)
BOUND = 8.47
"""Nats that a decision takes after this training."""


def theft(at_s: float) -> list[dict[str, object]]:
    """A claim, and the owner's answer."""
    return [arp(at_s, 3, THIEF, "10.0.0.7"), arp(at_s + 0.1, 1, OWNER, "10.0.0.7")]


def running(**settings) -> AppRun:
    """The firewall, which is even told to hear its own evidence."""
    return AppRun(firewall, evidence_apps=["firewall"], **settings)


def switch(app: AppRun, at: int) -> None:
    app.feed("network.switch.p4runtime_ctrl.s1", {"switch": "s1", "primary": True, "event_time": at})


def pieces(app: AppRun, kind: str, count: int = 1) -> list[Evidence]:
    """Read as every app reads evidence: the app of the key must have written it."""
    return [Evidence.from_item(item) for item in app.wait_for(f"{OWN}.{kind}", count)]


def weighed(app: AppRun) -> int:
    """Pieces that the firewall has weighed, once it has judged one more of Kitsune's, which decides nothing."""
    app.feed("network.evidence.kitsune.ports", evidence(0.5, AT, victims=("10.0.0.9",)).to_value())
    app.wait_for("network.judged.firewall")
    return int(app.health()["evidence"])


def test_a_claim_of_anothers_address_is_written_and_blocked_by_what_is_written():
    with running() as app:
        switch(app, SECOND)
        app.feed(ARP, records([*TRAINED, *theft(700)]))
        (found,) = pieces(app, "spoofing")
        (block,) = (Decision.from_item(item) for item in app.wait_for("network.block.firewall.mac"))
        assert found.sender is not None
        assert (found.sender.mac, found.sender.port, found.sender.switch) == ("02:00:00:00:00:66", 3, "s1")
        assert (found.forged, found.forgeable, found.supporting) == (True, False, False)
        assert (found.victims, found.service, found.packets) == (("10.0.0.7",), "arp", 1)
        assert (found.since, found.event_time) == (700 * SECOND, round(700.1 * SECOND))
        assert found.nats > 5.0
        assert (block.target.address, block.target.port) == (found.sender.mac, found.sender.port)
        assert block.reason == found.text
        assert block.event_time == found.event_time
        first, then = app.written(f"{OWN}.*")[0], app.written("network.block.firewall.*")[0]
        assert first.timestamp <= then.timestamp, "written before what it decides"
        wait_for(lambda: app.archived(f"{OWN}.*"))
        assert [Evidence.from_item(item) for item in app.archived(f"{OWN}.*")] == [found]
        assert weighed(app) == 1
        assert len(app.written("network.block.firewall.*")) == 1


def test_a_claim_that_goes_on_is_told_when_it_has_doubled_and_when_it_is_over():
    with running() as app:
        switch(app, SECOND)
        app.feed(ARP, records(TRAINED))
        for number in range(21):
            app.feed(ARP, records(theft(700 + number)))
        found = pieces(app, "spoofing", 5)
        assert [each.packets for each in found] == [1, 1, 2, 4, 8]
        assert {each.since for each in found} == {700 * SECOND}
        assert sum(each.nats for each in found) == pytest.approx(found[0].nats, rel=0.05), "told once"
        switch(app, 790 * SECOND)
        last = pieces(app, "spoofing", 6)[-1]
        assert (last.packets, last.nats) == (5, 0.0)
        assert last.text.startswith("over, after 20.1 s and 21 packets: 02:00:00:00:00:66")


def test_who_is_not_surely_the_attacker_is_told_without_weight():
    """A host that shares its port: one of its neighbours may have forged its MAC."""
    with running() as app:
        switch(app, SECOND)
        app.feed(ARP, records([*TRAINED, arp(650, 3, 0x02_00_00_00_00_55, "10.0.0.55"), *theft(700)]))
        (found,) = pieces(app, "spoofing")
        assert (found.nats, found.supporting, found.forgeable) == (0.0, True, True)
        assert "not blocked" in app.wait_for("network.event.firewall.arp")[0].value["text"]
        assert not app.written("network.block.firewall.*")


def test_a_flood_is_written_and_guarded_by_what_is_written():
    """Forged sources: nobody is accused, victim and service are named."""
    with running(syn=QUICK) as app:
        switch(app, NOW)
        app.feed(SYNS, batch(*[(NOW // 1000, f"77.0.{n // 256}.{n % 256}", VICTIM, 80) for n in range(600)]))
        (found,) = pieces(app, "flood")
        (guard,) = (Decision.from_item(item) for item in app.wait_for("network.protect.firewall.ipv4"))
        assert (found.sender, found.address, found.forgeable) == (None, "", True)
        assert (found.victims, found.service, found.packets) == ((VICTIM,), "tcp/80", 600)
        assert (guard.target.address, guard.target.port) == (VICTIM, 80)
        assert guard.reason.startswith(found.text)
        assert weighed(app) == 1
        assert len(app.written("network.protect.firewall.*")) == 1
        assert len(app.written(f"{OWN}.*")) == 1


def test_a_source_that_is_blocked_for_its_syns_is_named_and_may_be_forged():
    with running(syn=QUICK) as app:
        switch(app, NOW)
        app.feed(SYNS, batch(*[(NOW // 1000, "77.0.0.1", VICTIM, 80)] * 600))
        guarded, source = pieces(app, "flood", 2)
        (block,) = (Decision.from_item(item) for item in app.wait_for("network.block.firewall.ipv4"))
        assert (guarded.address, source.address) == ("", "77.0.0.1")
        assert (source.forgeable, source.victims, source.service) == (True, (VICTIM,), "tcp/80")
        assert "which others may have forged, sent 600 SYNs" in source.text
        assert block.target.address == source.address
        incidents = [Incident.from_item(item) for item in app.wait_for("network.incident.firewall.flood", 3)]
        assert len({each.id for each in incidents}) == 1, "guard and block are about one flood"
        assert "77.0.0.1" in incidents[-1].attacker_text


def test_a_flood_that_goes_on_is_told_when_it_has_doubled():
    """One message for each window would be five a second."""
    on = Desk(syn=SynRules(grace_ms=0, patience_ms=0, resets=0))
    for number in range(20):
        at = NOW // 1000 + number * 200_000
        on.hand(SYNS, batch(*[(at, f"77.0.{n // 256}.{n % 256}", VICTIM, 80) for n in range(600)]))
    assert len(on.guarded) == 1
    assert [each["packets"] for each in on.written(f"{OWN}.flood")] == [600, 600, 1200, 2400, 4800]
    on.switch(at=NOW + 90 * SECOND)
    last = on.written(f"{OWN}.flood")[-1]
    assert (last["nats"], last["packets"], last["text"][:5]) == (0.0, 2400, "over,")


def test_a_guard_that_was_lifted_by_hand_is_set_again_by_evidence_that_is_written():
    on = Desk(syn=SynRules(grace_ms=0, patience_ms=0, resets=0))
    syns = batch(*[(NOW // 1000, f"77.0.{n // 256}.{n % 256}", VICTIM, 80) for n in range(600)])
    on.hand(SYNS, syns)
    said = Instruction(id="i1", verb="unblock", subject=VICTIM).to_value()
    on.hand("network.instruction.operator.firewall", said, pattern="network.instruction.*.firewall")
    more = batch(*[(NOW // 1000 + 250_000, f"77.1.0.{n}", VICTIM, 80) for n in range(120)])
    on.hand(SYNS, more)
    assert [each.action for each in on.decisions] == ["protect", "unprotect", "protect"]
    assert [each["packets"] for each in on.written(f"{OWN}.flood")] == [600, 120]


def instruct(app: AppRun, verb: str, subject: str) -> None:
    said = Instruction(id=f"{verb}-{subject}", verb=verb, subject=subject)  # type: ignore[arg-type]
    app.feed("network.instruction.operator.firewall", said.to_value())


def test_the_second_block_of_a_sender_rests_on_its_first_one_too():
    """Seven nats of 8.5 decide only with the two that the earlier block adds."""
    with running(rules={"rule": "sequential"}) as app:
        switch(app, NOW)
        app.feed("network.training.kitsune", TRAINING.to_value())
        app.feed("network.evidence.kitsune.ports", evidence(20.0, AT).to_value())
        first = Decision.from_item(app.wait_for("network.block.firewall.mac")[0])
        assert not app.written(f"{OWN}.*")
        instruct(app, "unblock", first.id)
        wait_for(lambda: len(app.archived("network.block.firewall.mac")) == 2)
        app.feed("network.evidence.kitsune.ports", evidence(7.0, AT + 60).to_value())
        (found,) = pieces(app, "offence")
        second = Decision.from_item(app.wait_for("network.block.firewall.mac", 3)[-1])
        assert (second.action, second.level) == ("block", 1)
        assert (found.kind, found.sender, found.supporting, found.nats) == ("offence", CAMERA, True, 2.0)
        assert (found.since, found.event_time) == (first.event_time, second.event_time)
        assert found.text == f"{CAMERA.mac} has 1 earlier block"
        assert f"evidence of 9.0 nats, 8.5 needed, 2.0 of it because {found.text}: " in second.reason
        last = Incident.from_item(app.written("network.incident.firewall.*")[-1])
        (action,) = [each for each in last.actions if each.decision == second.id]
        assert (action.nats, action.bound) == (pytest.approx(9.0), pytest.approx(BOUND, abs=0.01))
        assert [(each.source, each.nats) for each in action.contributions] == [
            ("ports", 7.0),
            ("offence", 2.0),
        ]
        assert last.kind == "scan"
        assert last.begun == first.event_time
        why = list(five_lines(second, second, last))
        assert why[0] == "sum: 9.0 nats of evidence; the bound was 8.5"
        assert f"offence 2.0 nats ({found.text})" in why[1]


def blocked_before(on: Desk, times: int = 1) -> Desk:
    """The archive has earlier blocks of the camera."""
    for number in range(times):
        earlier = desk()
        hear(earlier, evidence(20.0, AT - 1_000 * (number + 1)))
        (made,) = earlier.decisions
        item = Item("network.block.firewall.mac", made.to_value(), NOW, NOW, "firewall", f"i{number}", 1)
        on.engine.archived.append(item)
    return on


@pytest.mark.parametrize(
    ("times", "nats", "blocked"),
    [(0, 8.4, False), (1, 6.4, False), (1, 6.5, True), (2, 4.99, False), (2, 5.01, True), (9, 4.99, False)],
)
def test_what_must_come_from_now_is_the_bound_without_two_nats_for_each_earlier_block(times, nats, blocked):
    """And five nats at least."""
    on = blocked_before(desk(), times)
    hear(on, evidence(nats, AT))
    assert bool(on.blocked) is blocked
    assert bool(on.written(f"{OWN}.offence")) is (blocked and times > 0)


def test_on_probation_the_earlier_block_is_told_though_it_adds_nothing():
    """So little is needed then that all of it must come from now."""
    on = desk()
    hear(on, evidence(20.0, AT))
    (first,) = on.decisions
    on.engine.archived.append(
        Item("network.block.firewall.mac", first.to_value(), NOW, NOW, "firewall", "i1", 1)
    )
    hear(on, evidence(6.0, AT + 700))
    again = on.decisions[-1].reason
    assert again.startswith(f"evidence of 6.0 nats, 5.0 needed, and {CAMERA.mac} has 1 earlier block: ")


def test_an_archive_that_does_not_answer_knows_no_offence():
    on = blocked_before(desk())
    on.engine.archive_away = True
    hear(on, evidence(20.0, AT))
    assert "history unknown" in on.decisions[0].reason
    assert on.decisions[0].level == 0
    assert not on.written(f"{OWN}.")


def test_an_offence_that_only_makes_a_block_longer_weighs_nothing():
    """The rule of seconds has no sum, nor has that of SYNs."""
    on = blocked_before(desk("seconds"))
    on.hand(ALERT, structs.replace(alert(anomalous_seconds=5), event_time=NOW).to_value())
    (found,) = on.written(f"{OWN}.offence")
    assert (on.decisions[0].level, found["nats"]) == (1, 0.0)
    assert on.written("network.incident.firewall.")[-1]["evidence"][-1]["source"] == "offence"


def test_a_source_of_syns_that_was_blocked_before_is_blocked_for_longer():
    """By address, since that is all that is known of it; the flood alone decides."""
    quick = SynRules(grace_ms=0, patience_ms=0, resets=0)
    archived: list[Item] = []
    for number in range(2):
        engine, at = FakeEngine(), NOW + number * 1_000 * SECOND
        engine.archived = archived
        on = Desk(syn=quick, engine=engine)
        on.switch(at=at)
        on.hand(SYNS, batch(*[(at // 1000, "77.0.0.1", VICTIM, 80)] * 600))
        on.tick_until(lambda on=on: on.blocked)
        block = on.decisions[-1]
        assert (block.target.address, block.level) == ("77.0.0.1", number)
        archived.append(
            Item("network.block.firewall.ipv4", block.to_value(), at, at, "firewall", "i1", number)
        )
    (found,) = on.written(f"{OWN}.offence")
    assert (found["address"], found["sender"], found["nats"]) == ("77.0.0.1", None, 0.0)
    assert (found["since"], found["forgeable"]) == (NOW, True)


def test_who_is_only_reported_is_reported_with_its_offences():
    """Its incident and a foreign app see why the bound was reached."""
    on = blocked_before(desk())
    hear(on, evidence(7.0, AT, role="gateway"))
    assert not on.blocked
    (found,) = on.written(f"{OWN}.offence")
    assert found["role"] == "gateway"
    (action,) = on.written("network.incident.firewall.")[-1]["actions"]
    assert (action["remedy"], action["nats"]) == ("alert", pytest.approx(9.0))
    hear(on, evidence(1.0, AT + 1, role="gateway"))
    assert len(on.written(f"{OWN}.offence")) == 1
    assert on.service.health()["evidence"] == 2


def test_operators_and_siems_read_it_with_the_incident(tmp_path):
    eve = tmp_path / "eve.json"
    on = Desk(switches=(), eve_file=str(eve), arp="tell")
    on.switch(at=SECOND)
    on.hand(ARP, records([*TRAINED, *theft(700), *theft(701)]))
    on.service.stop()
    opened, reported = (json.loads(line) for line in eve.read_text().splitlines() if "9100104" in line)
    assert opened["ether"]["src_mac"] == "02:00:00:00:00:66"
    assert opened["dest_ip"] == "10.0.0.7"
    (said,) = opened["alert"]["metadata"]["evidence"]
    assert said.startswith("spoofing: 02:00:00:00:00:66 on port 3 claims 10.0.0.7")
    assert reported["alert"]["metadata"]["remedy"] == ["alert"]
    assert len(on.written("network.incident.firewall.spoofing")[-1]["actions"]) == 1
