"""Evidence leads to a block, a guard, or to a word why not."""

import time

import pytest
from msgspec import structs

from apps.evidence import TrainingState
from apps.firewall.policy.rules import Rules
from apps.messages import RateLimit
from due import Item
from tests.apps.firewall.alerts import CAMERA
from tests.apps.firewall.desk import ARP, NOW, Desk, FakeEngine
from tests.apps.firewall.policy.test_sequential_test import evidence
from tests.apps.firewall.rows import arp, records

SECOND = 1_000_000_000
AT = NOW // SECOND


def desk(rule="sequential", seconds=3_600.0, **settings):
    made = Desk(rule=rule, **settings)
    state = TrainingState(packets=9, wanted=9, done=True, seconds=seconds, senders=20, event_time=NOW)
    made.hand("network.training.kitsune", state.to_value(), pattern="network.training.*")
    return made


def hear(on, *heard, app="kitsune"):
    for each in heard:
        key = f"network.evidence.{app}.{each.source}"
        named = f"network.evidence.sonata_adapter.{each.source}"
        on.hand(
            key, each.to_value(), pattern=named if app == "sonata_adapter" else f"network.evidence.{app}.*"
        )


def test_a_strong_piece_of_evidence_blocks_the_sender_by_mac_and_port():
    on = desk()
    hear(on, evidence(20.0, AT))
    assert on.blocked == [CAMERA.mac]
    (decision,) = on.decisions
    assert decision.reason.startswith("evidence of 20.0 nats")
    assert decision.evidence[0].summary == "ports of a camera"


def test_weak_evidence_blocks_when_it_persists():
    on = desk()
    hear(on, *[evidence(3.0, AT + n) for n in range(2)])
    assert not on.blocked
    hear(on, evidence(3.0, AT + 2))
    assert on.blocked == [CAMERA.mac]


def test_evidence_that_overtakes_the_end_of_training_is_judged_after_it():
    """The two come under keys of their own; without training nothing is decided."""
    on = Desk(rule="sequential")
    hear(on, structs.replace(evidence(20.0, AT), number=2))
    assert not on.blocked
    state = TrainingState(
        packets=9, wanted=9, done=True, seconds=3_600.0, senders=20, event_time=NOW, number=1
    )
    on.hand("network.training.kitsune", state.to_value(), pattern="network.training.*")
    assert on.blocked == [CAMERA.mac]


class CountingEngine(FakeEngine):
    """Counts the questions about earlier blocks of a MAC."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = 0

    def get(self, query: object, *, limit: int | None = None) -> list[Item]:
        self.asked += CAMERA.mac in str(query)
        return super().get(query, limit=limit)


def test_the_archive_is_asked_once_while_evidence_about_a_sender_goes_on():
    """A query would hold each piece up; after a decision the archive knows more, and is asked again."""
    engine = CountingEngine()
    on = desk(engine=engine)
    hear(on, *[evidence(1.5, AT + n) for n in range(5)])
    assert (engine.asked, on.blocked) == (1, [])
    hear(on, evidence(20.0, AT + 5, first_packet=7, sender=structs.replace(CAMERA, mac="02:00:00:00:00:77")))
    hear(on, evidence(1.0, AT + 6))
    assert engine.asked == 2


def test_a_foreign_app_can_speak_and_nobody_in_its_name():
    on = desk(evidence_apps=("honeypot",))
    hear(on, evidence(20.0, AT), app="honeypot")
    assert on.blocked == [CAMERA.mac]


def test_a_query_that_knows_only_an_address_counts_against_its_sender():
    """Alone, or with hardly anything else, it blocks nobody: the address may be forged, and its port is unknown."""
    query = structs.replace(evidence(20.0, AT, "port_scan"), sender=None, address=CAMERA.ip)
    alone = desk(evidence_queries=("port_scan",))
    hear(alone, query, app="sonata_adapter")
    assert not alone.blocked
    on = desk(evidence_queries=("port_scan",))
    hear(on, evidence(1.0, AT))
    hear(on, query, app="sonata_adapter")
    assert not on.blocked
    bound = on.service._handler.decider.test.bound
    hear(on, evidence(0.8 * bound - 1.0, AT))
    assert on.blocked == [CAMERA.mac]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"role": "gateway"}, "is a gateway"),
        ({"mac_addresses": 9, "training_rate": 5.0}, "anybody could have forged it"),
    ],
)
def test_who_is_not_blocked_is_named(changes, why):
    on = desk()
    hear(on, evidence(20.0, AT, **changes))
    assert not on.blocked
    assert any(why in value["text"] for key, value in on.engine.written if key.startswith("network.event."))


def test_who_is_not_blocked_is_named_again_after_the_clock_was_set_back():
    """That the same was told half an hour later is no reason to tell nothing for as long."""
    on = desk()
    for at in (AT + 1_800, AT, AT + 1):
        hear(on, evidence(20.0, at, role="gateway"))
    assert len(on.events) == 2


def test_training_that_is_too_short_blocks_nobody():
    on = desk(seconds=2.0)
    hear(on, evidence(40.0, AT))
    assert not on.blocked


def test_the_forger_of_an_address_is_blocked_and_its_owner_is_not():
    on = desk()
    hear(on, evidence(20.0, AT, mac_addresses=9, forged=True))
    assert on.blocked == [CAMERA.mac]


def test_the_role_of_a_multicast_speaker_does_not_spare_the_forger_of_its_address():
    """It is the owner's.  A gateway's spares whoever has its address, which may be its standby."""
    on = desk()
    hear(on, evidence(20.0, AT, forged=True, role="multicast"))
    assert on.blocked == [CAMERA.mac]
    for spared in (
        evidence(20.0, AT, role="multicast"),
        evidence(20.0, AT, forged=True, role="gateway"),
        evidence(20.0, AT, forged=True, role="dns"),
    ):
        on = desk()
        hear(on, spared)
        assert not on.blocked


def test_a_router_is_not_blocked_for_who_forges_an_inside_address_behind_it():
    """Everybody there can; nor is the address, which is another's."""
    for rules in (Rules(), Rules(block_unproven_addresses=True)):
        on = desk(rules=rules)
        hear(on, routed(forged=True))
        assert on.decisions == []
        assert any("belongs to another host, and anybody behind" in text for text in on.events)
    on = desk()
    hear(on, routed(forged=True, kind="flood", victims=("10.0.0.1",), service="tcp/80"))
    assert [(each.action, each.target.address) for each in on.decisions] == [("protect", "10.0.0.1")]


def test_a_router_is_not_blocked_for_an_address_that_arp_has_seen_elsewhere():
    on = desk()
    on.hand(ARP, records([arp(0, 1, 0x02_00_00_00_00_07, "10.0.0.7")]))
    moved = structs.replace(CAMERA, port=3, ip="10.0.0.7")
    hear(on, evidence(20.0, AT, sender=moved, mac_addresses=200, routed=True, forgeable=False))
    assert on.decisions == []
    assert any("belongs to another host, and its forger is behind" in text for text in on.events)


def test_a_handshake_proves_an_address_behind_a_router():
    on = desk()
    hear(on, evidence(20.0, AT, mac_addresses=9, training_rate=5.0, forgeable=False))
    assert on.blocked == [CAMERA.ip]


def routed(**changes):
    """A stranger behind the router, of whom anybody could have sent this."""
    stranger = structs.replace(CAMERA, ip="198.51.100.9")
    return evidence(20.0, AT, sender=stranger, mac_addresses=200, routed=True, **changes)


def test_nobody_gets_an_innocent_address_blocked_by_a_scan_in_its_name():
    """Nobody knows a stranger yet, but whoever is blocked cannot become a client; a handshake proves it."""
    on = desk()
    hear(on, routed())
    assert on.decisions == []
    assert any("198.51.100.9 is behind a router and has completed no handshake" in text for text in on.events)
    hear(on, structs.replace(routed(forgeable=False), event_time=NOW + SECOND))
    assert on.blocked == ["198.51.100.9"]


def test_an_operator_may_have_strangers_blocked_nevertheless():
    on = desk(rules=Rules(block_unproven_addresses=True))
    hear(on, routed())
    assert on.blocked == ["198.51.100.9"]


@pytest.mark.parametrize("training_rate", [0.0, 5.0])
def test_a_flood_in_the_name_of_a_stranger_has_its_victim_protected(training_rate):
    """Whoever sent it: the guard and the limit are towards the victim, at what training saw come to it."""
    flood = {"kind": "flood", "victims": ("10.0.0.1",), "training_rate": training_rate}
    on = desk()
    hear(on, routed(service="tcp/80", **flood))
    assert [(each.action, each.target.address) for each in on.decisions] == [("protect", "10.0.0.1")]
    on = desk()
    hear(on, routed(service="udp/5060", usual_rate=100.0, usual_sources=("192.0.2.7",), **flood))
    (made,) = on.decisions
    assert (made.action, made.target.address) == ("meter", "10.0.0.1")
    assert made.limit == RateLimit(kind="udp_to", port=5060, rate=200, spared=("192.0.2.7",), spared_rate=200)
    assert [each.sender for each in made.grounds] == [structs.replace(CAMERA, ip="198.51.100.9")]


def scanned(victim="10.0.0.1", service="tcp/8080", **changes):
    """A scan of many ports, and the one-way traffic that it consists of."""
    flood = routed(source="one_way", kind="flood", victims=(victim,), service=service, **changes)
    return structs.replace(flood, nats=1.0), routed(source="contacts", victims=(victim,), **changes)


def shake(on, service="10.0.0.1", port=443):
    said = {"source": "203.0.113.5", "service": service, "port": port, "at": NOW}
    on.hand("network.handshake.sonata.tcp", said)


def test_a_scan_in_the_name_of_a_stranger_is_slowed_down_and_no_service_is_hit():
    """Whoever sent it: only SYNs to ports where the victim has no service are limited, whoever sends them."""
    on = desk()
    shake(on)
    shake(on, "10.0.0.2", 80)
    hear(on, *scanned())
    (made,) = on.decisions
    assert (made.action, made.target.address) == ("meter", "10.0.0.1")
    assert made.limit == RateLimit(kind="syn", rate=5, open_ports=(443,))
    assert "anybody could have forged it; limited: SYNs to ports other than 443 to 5 packets/s" in made.reason
    assert not on.blocked


def test_a_scan_in_the_name_of_a_stranger_is_only_reported_where_nobody_knows_the_services():
    """Without handshakes a limit might hit clients; of datagrams nothing is known."""
    for on, heard in ((desk(), scanned()), (desk(), scanned(service="udp/161"))):
        if heard[0].service.startswith("udp"):
            shake(on)
        hear(on, *heard)
        assert on.decisions == []
        assert any("anybody could have forged it" in text for text in on.events)


def test_who_is_allowed_may_scan():
    on = desk(rules=Rules(allow=("198.51.100.0/24",)))
    shake(on)
    hear(on, *scanned())
    assert on.decisions == []


def test_a_scanner_that_has_proven_its_address_is_blocked():
    on = desk()
    shake(on)
    hear(on, *scanned(forgeable=False))
    assert on.blocked == ["198.51.100.9"]


def test_what_is_allowed_may_flood_its_victim():
    """The allow-list always wins; a rate limit would hit others, too."""
    on = desk(rules=Rules(allow=("198.51.100.0/24",)))
    hear(on, routed(kind="flood", victims=("10.0.0.1",), service="icmp"))
    assert on.decisions == []


def test_a_host_with_a_few_addresses_is_not_a_router():
    """Whoever sends under its MAC sits on its port; of its addresses the one that attacks is blocked."""
    on = desk()
    hear(on, evidence(20.0, AT, mac_addresses=3))
    assert on.blocked == [CAMERA.ip]


def test_a_flood_with_forged_sources_has_the_service_guarded():
    on = desk()
    hear(on, structs.replace(evidence(20.0, AT), sender=None, victims=("10.0.0.1",), service="tcp/80"))
    assert not on.blocked
    assert any(key.startswith("network.protect.firewall") for key, _ in on.engine.written)


def victims(service, **fields):
    made = structs.replace(evidence(20.0, AT), sender=None, victims=("10.0.0.1",), service=service)
    return structs.replace(made, kind="flood", **fields)


def test_a_flood_without_a_remedy_is_reported_once():
    on = desk()
    hear(on, victims("ip"), victims("ip"), victims("ip"))
    told = [value for key, value in on.engine.written if key.startswith("network.event.")]
    assert len(told) == 1
    assert "no remedy" in told[0]["text"]


def test_answers_of_reflectors_are_limited_towards_their_victim():
    """The limit, its rate and its reason are in the decision; a switch's counters make the incident's cost."""
    on = desk()
    hear(on, victims("from-udp/53", training_rate=30.0, usual_sources=("192.0.2.53",), usual_share=0.5))
    (made,) = on.decisions
    assert (made.action, made.target.address) == ("meter", "10.0.0.1")
    assert made.limit == RateLimit(kind="udp_from", port=53, rate=30, spared=("192.0.2.53",), spared_rate=60)
    assert "limited: UDP from port 53 to 30 packets/s (training saw 30 at most)" in made.reason
    assert [key for key, _ in on.engine.written if ".meter." in key] == ["network.meter.firewall.ipv4"]
    on.confirm(made)
    counted = {"switch": "s1", "primary": True, "event_time": NOW + SECOND}
    counted["blocks"] = [{"id": made.id, "packets": 900, "seen": 1_000}]
    on.hand("network.switch.p4runtime_ctrl.s1", counted, pattern="network.switch.p4runtime_ctrl.*")
    on.service.stop()
    incident = on.written("network.incident.firewall.flood")[-1]
    assert (incident["actions"][0]["remedy"], incident["cost"]["metered"]) == ("meter", 900)


def test_a_limit_is_lifted_when_the_flood_is_over():
    on = desk(rules=Rules(limit_s=30))
    hear(on, victims("tcp-ack/443"))
    on.switch(at=NOW + 29 * SECOND)
    assert [each.action for each in on.decisions] == ["meter"]
    on.switch(at=NOW + 31 * SECOND)
    assert [each.action for each in on.decisions] == ["meter", "unmeter"]
    assert on.service.health()["rate_limits"] == 0


def test_where_only_copies_are_seen_it_would_limit():
    on = desk(switches=())
    on.switch(mirror=True)
    hear(on, victims("icmp"))
    (made,) = on.decisions
    assert made.dry_run
    assert made.doing == "would rate limit"


def test_a_flood_of_syns_is_guarded_not_limited():
    on = desk()
    hear(on, victims("tcp/80"))
    assert [each.action for each in on.decisions] == ["protect"]


def test_a_restarted_firewall_lifts_what_it_has_limited():
    before = desk()
    hear(before, victims("from-udp/53"))
    (made,) = before.decisions
    engine = FakeEngine()
    at = time.time_ns()
    engine.archived.append(Item("network.meter.firewall.ipv4", made.to_value(), at, at, "firewall", "i0", 1))
    on = desk(engine=engine)
    on.switch(at=made.expires + 1)
    assert [(each.action, each.id) for each in on.decisions] == [("unmeter", made.id)]


def test_the_rule_of_the_paper_blocks_at_the_first_packet_over_the_threshold():
    on = desk("paper")
    hear(on, evidence(20.0, AT), evidence(0.0, AT, "threshold", supporting=True))
    assert on.blocked == [CAMERA.mac]
    assert on.decisions[0].reason.startswith("first packet at or above the threshold")


def test_a_budget_has_to_be_possible():
    with pytest.raises(ValueError, match="false_blocks_per_day"):
        Rules(false_blocks_per_day=0)


def test_no_other_app_can_say_that_training_is_done():
    """A longer training than there was would lower the bound for all."""
    on = desk(seconds=2.0, evidence_apps=("honeypot",))
    state = TrainingState(packets=9, wanted=9, done=True, seconds=1e9, senders=1, event_time=NOW)
    on.hand("network.training.honeypot", state.to_value(), pattern="network.training.*")
    hear(on, evidence(40.0, AT))
    assert not on.blocked
    assert on.service.health()["refused_by_cause"] == {"sender": 1}
