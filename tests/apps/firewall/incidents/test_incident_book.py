"""What belongs together is one incident, told at the right moments, and bounded whatever comes."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from apps.firewall.incidents import incident_book
from apps.firewall.incidents.incident_book import IncidentBook
from apps.incidents import Incident
from apps.messages import Exhibit, Sender, Target
from tests.apps.firewall.alerts import CAMERA, SECOND, alert
from tests.apps.firewall.incidents.samples import BOUND, PHONE, SERVER, confirmation, decision, evidence


def opened(book: IncidentBook, **changes: object) -> Incident:
    """An incident of the camera, opened by a piece of evidence."""
    return book.hear_evidence(evidence(**changes), 6.0, BOUND)[0]  # type: ignore[arg-type]


def test_one_attacker_is_one_incident_from_first_evidence_to_end():
    """Evidence, alert, decision, confirmation and end speak of one id, and its begin is the first evidence's."""
    book = IncidentBook()
    assert book.hear_evidence(evidence(99.0, nats=2.0, first_packet=490), 2.0, BOUND) == []
    told = book.hear_evidence(evidence(100.0), 7.9, BOUND)
    told += book.hear_alert(alert(100))
    told += book.decided(decision(101.0))
    told += book.confirmed(confirmation(101.2))
    told += book.decided(decision(701.0, action="unblock", reason="the block ran out"))
    told += book.lapse(1400 * SECOND)
    assert [each.change for each in told] == ["opened", "decided", "confirmed", "decided", "over"]
    assert len({each.id for each in told}) == 1
    last = told[-1]
    assert (last.kind, last.state, last.attacker) == ("scan", "over", CAMERA)
    assert (last.begun, last.first_packet) == (round(98.5 * SECOND), 490)
    assert (last.victims, last.service) == ((SERVER,), "tcp/22")
    assert [each.source for each in last.evidence] == ["strangers", "strangers", "alert"]
    assert [(each.remedy, each.state) for each in last.actions] == [("block", "over")]
    assert last.mitigated_after_s == pytest.approx(2.7)
    assert last.mitigated
    assert len(book) == 0


def test_a_decision_carries_the_sum_and_whose_shares_it_is():
    """Shares add up to the sum, although what came earlier has faded meanwhile."""
    book = IncidentBook()
    book.hear_evidence(evidence(100.0, source="strangers", nats=6.0), 6.0, BOUND)
    book.hear_evidence(evidence(110.0, source="port_scan", nats=9.0), 12.0, BOUND)
    (told,) = book.decided(decision(110.0))
    (action,) = told.actions
    assert (action.nats, action.bound) == (12.0, BOUND)
    assert {each.source: round(each.nats, 6) for each in action.contributions} == {
        "port_scan": 9.0,
        "strangers": 3.0,
    }


def test_weak_evidence_is_no_incident():
    """Below half of the bound nothing is told, and a suspicion that has faded starts over."""
    book = IncidentBook()
    for at_s in range(100, 400, 10):
        assert book.hear_evidence(evidence(at_s, nats=2.0, first_packet=at_s), 2.0, BOUND) == []
    (told,) = book.hear_evidence(evidence(400.0, nats=9.0, first_packet=400), 9.0, BOUND)
    assert (told.change, told.first_packet) == ("opened", 400)


def test_a_distributed_flood_is_one_incident():
    """Many senders of one flood are one incident, also those that had one of their own before."""
    book = IncidentBook()
    own = book.hear_alert(alert(100, PHONE))[0]
    first = opened(book, kind="flood", source="syn_flood")
    told = book.hear_evidence(evidence(101.0, PHONE, kind="flood", source="syn_flood"), 6.0, BOUND)
    (ended,) = [each for each in told if each.state == "over"]
    last = book.decided(decision(102.0))[-1]
    assert len(book) == 1
    assert {ended.id, last.id} == {own.id, first.id}
    assert ended.joined == last.id
    assert last.attacker_count == 2
    assert "2 senders" in last.attacker_text


def test_bystanders_do_not_join_a_flood():
    """Who sends a little to the victim of a flood is no attacker."""
    book = IncidentBook()
    opened(book, kind="flood")
    assert book.hear_evidence(evidence(100.5, PHONE, kind="flood", nats=0.2), 0.2, BOUND) == []
    assert book.decided(decision(102.0))[0].attacker_count == 1


def test_scans_of_one_host_by_two_senders_are_two_incidents():
    """A victim that scans have in common says nothing about who scans."""
    book = IncidentBook()
    assert opened(book).id != opened(book, sender=PHONE).id


def test_a_host_that_speaks_arp_and_ip_is_one_attacker():
    """An ARP frame has no address, and an IPv6 address is another one: the MAC tells."""
    book = IncidentBook()
    first = opened(book)
    arp = structs.replace(CAMERA, ip="")
    book.hear_evidence(evidence(100.2, arp, kind="spoofing", service="arp"), 6.0, BOUND)
    book.hear_evidence(evidence(100.4, structs.replace(CAMERA, ip="fe80::1"), mac_addresses=2), 6.0, BOUND)
    (last,) = book.decided(decision())
    assert (last.id, last.attacker_count, last.service) == (first.id, 1, "")


def test_forged_sources_have_no_name():
    """Evidence without a sender makes an incident of the victim, and a guard belongs to it."""
    book = IncidentBook()
    (told,) = book.hear_evidence(evidence(sender=None, kind="flood"), 20.0, BOUND)
    assert (told.attacker, told.attacker_count) == (None, 0)
    guard = decision(action="protect", target=Target(kind="ip", address=SERVER, port=22))
    (after,) = book.decided(guard)
    assert (after.id, after.actions[0].remedy) == (told.id, "guard")
    (counted,) = book.lapse(102 * SECOND) or book.count("d1", 400, 103 * SECOND)
    assert counted.cost.challenged == 400


def test_an_innocent_whose_address_was_forged_gets_no_part_of_it():
    """The same address behind another MAC is another incident."""
    book = IncidentBook()
    forger = Sender(switch="s1", port=9, mac="02:00:00:00:00:66", ip=CAMERA.ip)
    assert opened(book, sender=forger).id != opened(book).id


@pytest.mark.parametrize(
    ("target", "fits"),
    [
        (Target(kind="ip", address="192.168.2.108"), True),
        (Target(kind="ip", address="192.168.2.0/24"), True),
        (Target(kind="ip", address="192.168.3.0/24"), False),
        (Target(kind="mac", address=CAMERA.mac, port=1), True),
        (Target(kind="mac", address=PHONE.mac, port=1), False),
    ],
)
def test_a_block_belongs_to_the_incident_of_what_it_stops(target, fits):
    book = IncidentBook()
    told = opened(book, mac_addresses=9)
    assert (book.decided(decision(target=target))[-1].id == told.id) is fits


def test_what_people_and_settings_decide_opens_nothing():
    """A block by hand, and a guard without evidence, are no incidents; with one there, they belong to it."""
    book = IncidentBook()
    said = (Exhibit(key="network.instruction.operator.firewall", timestamp=1, summary="block"),)
    assert book.decided(decision(evidence=said)) == book.decided(decision(evidence=())) == []
    opened(book)
    assert book.decided(decision(evidence=said))[0].actions[0].remedy == "block"


def test_a_decision_without_evidence_before_it_opens_one():
    """ARP claims and floods are decided by other parts; what comes later about the same sender joins."""
    book = IncidentBook()
    arp = (Exhibit(key="network.traffic_capture.sonata.arp", timestamp=1, summary="claims 192.168.2.1"),)
    (told,) = book.decided(decision(evidence=arp))
    assert (told.kind, told.attacker_text, told.change) == ("spoofing", CAMERA.mac, "decided")
    assert book.decided(decision(102.0, id="d2"))[0].id == told.id
    book.hear_evidence(evidence(103.0), 6.0, BOUND)
    assert len(book) == 1


def test_earlier_blocks_are_a_part_of_the_sum_and_say_nothing_of_what_happens():
    """They neither make the incident older nor name it; what comes next is added to the test's own sum."""
    book = IncidentBook()
    begun = opened(book, kind="unlike_training", nats=5.0).begun
    offence = evidence(100.1, kind="offence", source="offence", since=1, nats=4.0, packets=0)
    book.hear_own(offence, 4.0, BOUND)
    (told,) = book.decided(decision())
    (action,) = told.actions
    assert [(each.source, each.nats) for each in action.contributions] == [
        ("strangers", 6.0),
        ("offence", 4.0),
    ]
    assert (action.nats, action.bound, told.peak_nats) == (10.0, BOUND, 10.0)
    assert (told.kind, told.begun, told.packets) == ("unlike_training", begun, 20)
    (more,) = book.hear_evidence(evidence(103.0, nats=1.0), 7.0, BOUND)
    shares = more.contributions
    assert [(each.source, each.nats) for each in shares] == [("strangers", 7.0), ("offence", 4.0)]


def test_a_rule_that_decides_by_itself_opens_an_incident():
    """Who is named by an address alone is named after those whom nobody can name."""
    book = IncidentBook()
    nameless = evidence(100.0, None, kind="flood", source="flood", nats=BOUND)
    (told,) = book.hear_own(nameless, BOUND, BOUND)
    assert (told.change, told.kind, told.nats, told.attacker) == ("opened", "flood", BOUND, None)
    book.hear_own(structs.replace(nameless, address="192.0.2.66"), BOUND, BOUND)
    (blocked,) = book.decided(decision(target=Target(kind="ip", address="192.0.2.66")))
    assert (blocked.id, len(book)) == (told.id, 1)
    assert blocked.attacker_text == "forged or too many addresses, and 192.0.2.66"
    after = IncidentBook()
    after.restore([blocked])
    after.hear_own(nameless, BOUND, BOUND)
    assert after.flush()[-1].attacker_text == blocked.attacker_text


def test_nothing_enforced_is_nothing_mitigated():
    """Dry runs, failures and mere alerts are no mitigation."""
    book = IncidentBook()
    opened(book)
    book.decided(decision(dry_run=True))
    assert not book.confirmed(confirmation(state="exists"))[0].mitigated
    book.decided(decision(id="d2"))
    assert book.confirmed(confirmation(name="d2", state="pending")) == []
    (refused,) = book.confirmed(confirmation(name="d2", state="failed"))
    assert refused.actions[1].state == "failed"
    (spared,) = book.spared(evidence(103.0), 12.0, BOUND, "it is the gateway")
    assert (spared.actions[-1].remedy, spared.actions[-1].reason) == ("alert", "it is the gateway")
    assert not spared.mitigated
    assert book.spared(evidence(103.1), 13.0, BOUND, "it is the gateway") == []


def test_news_waits_for_a_second_but_decisions_do_not():
    """Ten pieces of evidence in a second are one update; a decision is told at once."""
    book = IncidentBook()
    opened(book)
    told = [each for at in range(10) for each in book.hear_evidence(evidence(100.1 + at / 20), 7.0, BOUND)]
    assert told == []
    assert [each.change for each in book.decided(decision(100.7))] == ["decided"]
    assert book.hear_evidence(evidence(100.8), 8.0, BOUND) == []
    (update,) = book.lapse(102 * SECOND)
    assert (update.change, update.packets) == ("more", 240)
    assert book.hear_evidence(evidence(102.1), 8.0, BOUND) == []
    assert [each.packets for each in book.flush()] == [260]
    assert book.flush() == []


def test_a_block_in_force_keeps_it_open_and_drops_are_signs_of_it():
    """The attack goes on as long as packets are dropped; ten minutes after the last it is over."""
    book = IncidentBook()
    opened(book)
    book.decided(decision(expires=5000 * SECOND))
    book.confirmed(confirmation())
    assert not book.lapse(1000 * SECOND)
    (drops,) = book.count("d1", 70, 4900 * SECOND)
    assert (drops.cost.dropped, drops.last) == (70, 4900 * SECOND)
    assert not book.lapse(5100 * SECOND)
    assert book.lapse(5501 * SECOND)[0].change == "over"


def test_what_comes_after_the_pause_is_another_incident():
    book = IncidentBook()
    first = opened(book)
    again = book.hear_evidence(evidence(900.0), 6.0, BOUND)
    assert [each.id == first.id for each in again if each.change == "opened"] == [False]


def test_open_incidents_come_back_after_a_restart():
    """What was open goes on under its id, with its decisions."""
    book = IncidentBook()
    told = [opened(book), *book.decided(decision()), *book.confirmed(confirmation())]
    after = IncidentBook()
    after.restore(Incident.from_value(each.to_value()) for each in told)
    (update,) = after.count("d1", 9, 200 * SECOND)
    assert (update.id, update.cost.dropped) == (told[0].id, 9)
    assert after.hear_evidence(evidence(300.0), 8.0, BOUND)[0].id == told[0].id
    assert after.lapse(5000 * SECOND)[0].state == "over"


def test_the_idlest_is_closed_when_there_are_too_many():
    book = IncidentBook(most=3)
    told = [each for number in range(5) for each in book.hear_alert(alert(100 + number, host(number)))]
    ended = [each.attacker for each in told if each.state == "over"]
    assert len(book) == 3
    assert ended == [host(0), host(1)]


def test_one_sender_with_many_names_opens_no_flood_of_incidents():
    """Openings within a second are limited, and those put off are counted."""
    book = IncidentBook()
    told = [each for number in range(500) for each in book.hear_alert(alert(100, host(number)))]
    assert len(told) == incident_book.OPENINGS
    assert book.left_out == 500 - incident_book.OPENINGS


def host(number: int) -> Sender:
    """One of 65,536 hosts."""
    high, low = divmod(number, 256)
    return Sender(switch="s1", port=1, mac=f"02:00:00:00:{high:02x}:{low:02x}", ip=f"10.0.{high}.{low}")


STEPS = st.tuples(
    st.sampled_from(["evidence", "alert", "block", "guard", "lift", "confirm", "count", "spared", "lapse"]),
    st.integers(0, 5),
    st.floats(0, 400),
    st.floats(0, 30),
    st.sampled_from(["scan", "flood", "guessing", "unlike_training"]),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(STEPS, max_size=60))
def test_any_order_of_events_makes_whole_incidents(steps):
    """Ids begin once and end once, at most once a second between; times and bounds hold; all is over in the end."""
    book, now, told = IncidentBook(idle_s=60, most=4), 1_000.0, []
    for step, number, pause, nats, kind in steps:
        now += pause / 10
        told += after(book, step, number, now, nats, kind)
    told += book.lapse(round((now + 10_000) * SECOND))
    assert len(book) == 0
    seen: dict[str, list[Incident]] = {}
    for each in told:
        assert Incident.from_value(each.to_value()) == each
        assert sum(share.nats for share in each.contributions) <= 31 + each.peak_nats
        seen.setdefault(each.id, []).append(each)
    for reports in seen.values():
        assert reports[0].change in ("opened", "decided")
        assert [each.state for each in reports].count("over") == reports[-1].state.count("over") == 1
        times = [each.event_time for each in reports]
        assert times == sorted(times)
        updates = [(a, b) for a, b in pairwise(reports) if b.change == "more"]
        assert all(b.event_time >= a.event_time + SECOND for a, b in updates)


def after(book: IncidentBook, step: str, number: int, now: float, nats: float, kind: str) -> list[Incident]:
    """What the book tells after one step."""
    at, sender = round(now * SECOND), None if number == 5 else host(number)
    piece = evidence(now, sender, nats=nats, kind=kind, victims=(f"10.9.0.{number % 2}",))
    if step in ("evidence", "spared"):
        told = book.hear_evidence(piece, nats + number, BOUND)
        return told + (book.spared(piece, nats + number, BOUND, "a reason") if step == "spared" else [])
    if step == "alert":
        return book.hear_alert(structs.replace(alert(1, host(number)), event_time=at))
    if step == "lapse":
        return book.lapse(at)
    if step == "confirm":
        return book.confirmed(confirmation(now, f"d{number}", ["installed", "failed", "removed"][number % 3]))
    if step == "count":
        return book.count(f"d{number}", round(nats * 10), at)
    action = {"block": "block", "guard": "protect", "lift": "unblock"}[step]
    address = f"10.9.0.{number % 2}" if step == "guard" else f"10.0.0.{number}"
    target = Target(kind="ip", address=address, port=80 if step == "guard" else None)
    return book.decided(decision(now, id=f"d{number}", action=action, target=target))
