"""What senders do: scans, guessing, floods and claims are found, and what both sides want is not."""

import json
import math

import numpy as np
import pytest

from apps.kitsune.behaviour.behaviour import CONTACTS, Behaviour
from apps.kitsune.behaviour.contacts import ARP, UNANSWERED
from apps.kitsune.behaviour.native import NativeBehaviour
from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import load_kernel
from apps.messages import Target
from due import RecordBatch
from sdnator.testing.packet_rows import blank
from tests.apps.firewall.enforcement.test_eve import decision

HOST, SERVER, STRANGER = 0x0A000005, 0x0A000001, 0x0A0000C8
FIN, SYN, SYN_ACK, ACK, RST = 0x01, 0x02, 0x12, 0x10, 0x04
BASE_US = 1_600_000_000_000_000


def packet(at_s, source, target, sport=40_000, dport=80, flags=0, **columns):
    """One packet; TCP unless other columns are named."""
    row = {
        "time_us": BASE_US + round(at_s * 1e6),
        "port": source & 0xFF,
        "eth_src": source,
        "eth_dst": target,
    }
    if "arp_op" in columns:
        return {**row, "arp_src_ip": source, "arp_dst_ip": target, **columns}
    row |= {"ip_version": 4, "ip_src_lo": source, "ip_dst_lo": target}
    if columns:
        return {**row, **columns}
    return {**row, "tcp_sport": sport, "tcp_dport": dport, "tcp_flags": flags}


def handshake(at_s, source, target, sport, dport):
    return [
        packet(at_s, source, target, sport, dport, SYN),
        packet(at_s + 0.001, target, source, dport, sport, SYN_ACK),
        packet(at_s + 0.002, source, target, sport, dport, ACK),
    ]


def batch(rows):
    names = {name for row in rows for name in row}
    empty = blank(1)
    columns = {name: np.array([row.get(name, empty[name][0]) for row in rows]) for name in names}
    return blank(len(rows), **columns)


BOUND = math.log(2 * 86_400 / (600 * 0.1))
"""Nats that decide in the quiet network: two senders in ten minutes, 0.1 false blocks a day."""


def quiet_network():
    """Ten minutes in which a host talks to a server, and nothing fails."""
    rows = [row for at in range(0, 600, 10) for row in handshake(at, HOST, SERVER, 30_000 + at, 80)]
    rows += [packet(at + 0.5, HOST, SERVER, arp_op=1) for at in range(0, 600, 60)]
    rows += [packet(at + 0.501, SERVER, HOST, arp_op=2) for at in range(0, 600, 60)]
    rows.sort(key=lambda row: row["time_us"])
    behaviour = Behaviour(len(rows))
    assert feed(behaviour, rows, trained=len(rows)) == []
    return behaviour


def feed(behaviour, rows, trained=0, **more):
    traffic = batch(rows) if rows else RecordBatch({})
    return behaviour.add(traffic, "s1", np.zeros(len(rows)), trained, lambda: np.zeros(0), **more)


def total(found, *statistics):
    return sum(each.nats for each in found if each.statistic in statistics)


def test_a_scan_is_found_by_its_failed_contacts_within_a_second():
    behaviour = quiet_network()
    rows = [packet(700 + n / 50, STRANGER, SERVER, 50_000, 1_000 + n, SYN) for n in range(50)]
    found = feed(behaviour, rows)
    assert total(found, *CONTACTS) > 12
    assert {each.sender[3] for each in found if each.sender} == {STRANGER}
    assert found[0].time < BASE_US / 1e6 + 701


def test_a_finding_begins_with_its_first_packet_and_not_with_its_window():
    """How long an attack went on unstopped is counted from there."""
    rows = [packet(700 + n / 50, STRANGER, SERVER, 50_000, 1_000 + n, SYN) for n in range(50)]
    found = feed(quiet_network(), rows)
    assert min(each.begun for each in found) == BASE_US / 1e6 + 700
    assert len({each.begun for each in found if each.statistic == "ports"}) == 1
    assert {each.window_s for each in found if each.statistic == "ports"} == {10.0}


@pytest.mark.parametrize("kind", [Behaviour, lambda packets: NativeBehaviour(packets, load_kernel())])
def test_who_was_quiet_for_longer_than_any_window_takes_no_memory(kind):
    """A network that sees new hosts all day would fill every table up to its limit otherwise."""
    behaviour = kind(1)
    feed(behaviour, [packet(0, HOST, SERVER, 30_000, 80, SYN)], trained=1)
    scans = (
        [packet(at + n / 50, STRANGER, 0x0A000100 + at + n, 1, 80, SYN) for n in range(50)]
        for at in (10, 2_000)
    )
    feed(behaviour, next(scans))
    feed(behaviour, [packet(20, HOST, SERVER, 30_001, 80, SYN)])
    first = behaviour.subjects
    feed(behaviour, next(scans))
    feed(behaviour, [packet(2_010, HOST, SERVER, 30_002, 80, SYN)])
    assert first > 50
    assert behaviour.subjects <= first


def test_connections_that_come_about_are_no_scan():
    """A newcomer may talk to as many as it likes, if they answer."""
    behaviour = quiet_network()
    rows = [
        row for n in range(60) for row in handshake(700 + n / 10, STRANGER, 0x08000000 + n, 50_000 + n, 443)
    ]
    assert feed(behaviour, [*rows, packet(720, HOST, SERVER, 1, 80, ACK)]) == []


def test_contacts_that_come_about_make_up_for_some_that_fail():
    """A browser that opens its pages again reaches most of them."""

    def with_answers(share):
        rows = []
        for n in range(40):
            at, target = 700 + n / 10, 0x08000000 + n
            answered = n % 10 < share * 10
            one = handshake(at, STRANGER, target, 50_000 + n, 443)
            rows += one if answered else one[:1]
        rows.append(packet(720, HOST, SERVER, 1, 80, ACK))
        return total(feed(quiet_network(), sorted(rows, key=lambda row: row["time_us"])), *CONTACTS)

    assert with_answers(0.7) < 3
    assert with_answers(0.1) > 12


def test_answers_of_a_scanned_host_do_not_speak_against_it():
    behaviour = quiet_network()
    rows = []
    for n in range(50):
        rows.append(packet(700 + n / 50, STRANGER, SERVER, 50_000, 1_000 + n, SYN))
        rows.append(packet(700 + n / 50 + 0.001, SERVER, STRANGER, 1_000 + n, 50_000, RST | ACK))
    assert {each.sender[3] for each in feed(behaviour, rows) if each.sender} == {STRANGER}


def test_many_short_connections_to_a_login_service_are_guessing():
    """It does not matter who closes them; those that stay open count half."""

    def guessed(closing):
        rows = []
        for n in range(12):
            at, sport = 700 + n / 2, 50_000 + n
            rows += handshake(at, STRANGER, SERVER, sport, 22)
            if closing == "client":
                rows.append(packet(at + 0.3, STRANGER, SERVER, sport, 22, FIN | ACK))
            if closing == "server":
                rows.append(packet(at + 0.3, SERVER, STRANGER, 22, sport, FIN | ACK))
        return total(feed(quiet_network(), rows), "logins")

    assert guessed("client") == pytest.approx(guessed("server"))
    assert guessed("server") > 12
    assert guessed("nobody") < 0.6 * guessed("server")


def test_logins_that_move_data_are_no_guessing():
    """Work over SSH is short connections, too, but not as short as a refused password."""
    rows = []
    for n in range(15):
        at, sport = 700 + n / 2, 50_000 + n
        rows += handshake(at, STRANGER, SERVER, sport, 22)
        for part in range(1, 5):
            rows.append(packet(at + part / 50, STRANGER, SERVER, sport, 22, ACK) | {"length": 1_500})
            rows.append(packet(at + part / 50 + 0.001, SERVER, STRANGER, 22, sport, ACK))
    assert total(feed(quiet_network(), rows), "logins") < 3


def test_one_client_that_logs_in_at_four_services_counts_once():
    """A busy day of a mail and file client is as little evidence as one of its services is."""

    def found_at(*ports):
        rows = [
            row
            for n in range(3)
            for port in ports
            for row in (
                *handshake(700 + 10 * n + port / 1000, STRANGER, SERVER, 50_000 + n, port),
                packet(701 + 10 * n + port / 1000, STRANGER, SERVER, 50_000 + n, port, FIN | ACK),
            )
        ]
        return total(feed(quiet_network(), sorted(rows, key=lambda row: row["time_us"])), "logins")

    assert 0 < found_at(21, 22, 143, 445) == pytest.approx(found_at(22))


def test_windows_that_are_long_beside_training_do_not_count():
    """Ten minutes of training cannot tell what is usual in ten minutes."""
    rows = [
        row
        for n in range(9)
        for row in (
            *handshake(700 + 61 * n, STRANGER, SERVER, 50_000 + n, 22),
            packet(701 + 61 * n, STRANGER, SERVER, 50_000 + n, 22, FIN | ACK),
        )
    ]
    assert {each.window_s for each in feed(quiet_network(), rows) if each.statistic == "logins"} <= {
        1.0,
        10.0,
        60.0,
    }


def test_a_flood_of_answered_pings_is_found():
    """An echo reply does not say that anybody wants the pings."""
    rows = []
    for n in range(400):
        ping = {"icmp_type": 8, "icmp_code": 0}
        rows.append(packet(700 + n / 400, STRANGER, SERVER, **ping))
        rows.append(packet(700.001 + n / 400, SERVER, STRANGER, icmp_type=0, icmp_code=0))
    assert total(feed(quiet_network(), rows), "one_way") > BOUND


def test_a_sweep_by_pings_is_found_though_hosts_answer():
    """Every host answers a ping, so what counts is how many new hosts somebody pings."""
    rows = []
    for n in range(16):
        rows.append(packet(700 + n / 10, STRANGER, 0x0A000010 + n, icmp_type=8, icmp_code=0))
        rows.append(packet(700.001 + n / 10, 0x0A000010 + n, STRANGER, icmp_type=0, icmp_code=0))
    found = feed(quiet_network(), rows)
    assert total(found, *CONTACTS) > 12
    assert {each.sender[3] for each in found if each.sender} == {STRANGER}
    assert {each.statistic for each in found if each.sender} == {"targets"}


def test_what_a_monitor_reaches_says_nothing_about_pings_without_a_reply():
    """A monitoring host's round over all hosts, in training, does not hide a sweep over addresses where nobody is."""

    def ping(at, source, target, *, answered):
        there = packet(at, source, target, icmp_type=8, icmp_code=0)
        return [there, packet(at + 0.001, target, source, icmp_type=0, icmp_code=0)] if answered else [there]

    monitored = [row for n in range(40) for row in ping(n / 20, HOST, 0x0A000100 + n, answered=True)]
    usual = [row for at in range(10, 600, 10) for row in handshake(at, HOST, SERVER, 30_000 + at, 80)]
    behaviour = Behaviour(len(monitored) + len(usual))
    feed(behaviour, [*monitored, *usual], trained=len(monitored) + len(usual))
    sweep = [ping(700 + n / 10, STRANGER, 0x0A000200 + n, answered=n % 2 == 0) for n in range(32)]
    found = feed(behaviour, [*(row for rows in sweep for row in rows), packet(705, HOST, SERVER, 1, 80, ACK)])
    assert total(found, *CONTACTS) > BOUND
    assert {(each.statistic, each.service) for each in found if each.sender} == {("targets", UNANSWERED)}
    assert max(each.count for each in found) == 16


def asked_network():
    """Ten minutes in which a host asks for a server's MAC, and gets it within 4 ms."""
    rows = [packet(0.5 * n, HOST + n % 120, SERVER, arp_op=1) for n in range(240)]
    rows += [packet(0.5 * n + 0.004, SERVER, HOST + n % 120, arp_op=2) for n in range(240)]
    rows.sort(key=lambda row: row["time_us"])
    behaviour = Behaviour(len(rows))
    feed(behaviour, rows, trained=len(rows))
    return behaviour


def test_how_long_to_wait_for_an_arp_reply_is_learnt():
    """Where every host answers within 4 ms, nobody waits 400: a slow sweep is found so much sooner."""
    rows = [packet(700 + n / 2, STRANGER, 0x0A000300 + n, arp_op=1) for n in range(20)]
    rows += [packet(700.03 + n / 2, HOST, SERVER, 1, 80, ACK) for n in range(20)]
    rows.sort(key=lambda row: row["time_us"])
    sooner, found = (feed(kind(), rows) for kind in (asked_network, quiet_network))
    waits = [
        [each.time - BASE_US / 1e6 - 700 for each in some if each.service == ARP] for some in (sooner, found)
    ]
    assert waits[0][0] < 0.11
    assert waits[1][0] > 0.39


def test_a_late_arp_reply_is_waited_for_where_training_saw_few():
    """Of the few in a quiet network nothing can be learnt."""
    rows = [packet(700, STRANGER, SERVER + 7, arp_op=1), packet(700.3, SERVER + 7, STRANGER, arp_op=2)]
    behaviour = quiet_network()
    assert feed(behaviour, [*rows, packet(702, HOST, SERVER, 1, 80, ACK)]) == []
    assert behaviour.contacts.arp_grace == 0.4


def test_a_host_that_connects_back_after_a_login_speaks_against_who_logged_in():
    """Data connections of FTP come back by design, and without a login it is nothing."""

    def called(login, back_from, later=2):
        rows = handshake(700, STRANGER, SERVER, 50_000, login)
        rows += handshake(700 + later, SERVER, STRANGER, back_from, 8_080)
        behaviour = quiet_network()
        found = [each for each in feed(behaviour, rows) if each.statistic == "callbacks"]
        assert all(each.sender[3] == STRANGER and each.victim == SERVER for each in found)
        trained = quiet_network()
        feed(trained, [packet(650, HOST, SERVER, 1, 80, ACK)])
        again = Behaviour.from_state(json.loads(json.dumps(trained.to_state())))
        assert total(feed(again, rows), "callbacks") == total(found, "callbacks")
        return total(found, "callbacks")

    assert called(23, 40_000) > 1
    assert called(80, 40_000) == 0
    assert called(21, 20) == 0
    assert called(23, 40_000, later=100) == 0


def test_a_flood_is_found_and_a_transfer_is_not():
    """What the other side acknowledges is wanted."""
    udp = [packet(700 + n / 1000, HOST, STRANGER, udp_sport=5, udp_dport=9) for n in range(300)]
    assert total(feed(quiet_network(), udp), "one_way") > BOUND
    transfer = handshake(700, HOST, STRANGER, 50_000, 9_000)
    for n in range(300):
        transfer.append(packet(700.01 + n / 1000, HOST, STRANGER, 50_000, 9_000, ACK))
        if n % 4 == 0:
            transfer.append(packet(700.01 + n / 1000, STRANGER, HOST, 9_000, 50_000, ACK))
    assert feed(quiet_network(), transfer) == []


def test_syns_of_a_known_host_are_a_flood_where_bulk_transfers_are_usual():
    """They are compared with SYNs of training, not with segments that a busy host takes its time to acknowledge."""
    rows = [row for at in range(0, 600, 10) for row in handshake(at, HOST, SERVER, 30_000 + at, 80)]
    rows += [
        packet(at + 0.1 + n / 1000, HOST, SERVER, 30_000, 80, ACK)
        for at in (100, 300, 500)
        for n in range(60)
    ]
    rows.sort(key=lambda row: row["time_us"])
    behaviour = Behaviour(len(rows))
    feed(behaviour, rows, trained=len(rows))
    more = [packet(690 + n / 1000, HOST, SERVER, 30_000, 80, ACK) for n in range(70)]
    assert total(feed(behaviour, more), "one_way") < 6
    flood = [packet(700 + n / 300, HOST, SERVER, 40_000 + n, 80, SYN) for n in range(290)]
    assert total(feed(behaviour, flood), "one_way") > BOUND
    opened = [row for n in range(20) for row in handshake(710 + n / 300, HOST, SERVER, 41_000 + n, 80)]
    assert not total(feed(behaviour, sorted(opened, key=lambda row: row["time_us"])), "one_way")


def test_who_ends_a_call_a_moment_later_floods_nobody():
    """Replies of the second before make up for packets, too; not those of a second that is longer ago."""

    def after(end_s, begin_s):
        call = [packet(700 + n / 200, HOST, SERVER, udp_sport=5, udp_dport=9) for n in range(400)]
        call += [
            packet(700 + n / 200, SERVER, HOST, udp_sport=9, udp_dport=5) for n in range(round(200 * end_s))
        ]
        call += [packet(begin_s + n / 200, HOST, SERVER, udp_sport=5, udp_dport=9) for n in range(150)]
        return total(feed(quiet_network(), sorted(call, key=lambda row: row["time_us"])), "one_way")

    assert after(2, 702) < 1
    assert after(2, 704) > 5


def test_contacts_that_fail_while_the_uplink_is_down_say_nothing():
    """Once nothing has come from outside for longer than ever in training; within the network they count as before."""
    far = 0x08000000

    def after(silence_s, target):
        rows = [row for at in range(0, 600, 5) for row in handshake(at, HOST, far, 30_000 + at, 443)]
        behaviour = Behaviour(len(rows))
        feed(behaviour, rows, trained=len(rows))
        scan = [packet(600 + silence_s + n / 10, HOST, target + n, 50_000, 443, SYN) for n in range(40)]
        return total(feed(behaviour, [*scan, packet(700, HOST, SERVER, 1, 80, ACK)]), *CONTACTS)

    assert after(-4, far + 1) > 12
    assert after(6, far + 1) == 0
    assert after(6, 0x0A000100) > 12


def test_contacts_fail_for_everybody_where_a_provider_is_down():
    """Something still comes from outside, but four hosts in turn reach nobody new there; until somebody does."""
    far = 0x08000000
    rows = [row for at in range(0, 600, 5) for row in handshake(at, HOST, far, 30_000 + at, 443)]

    def scan(host, start_s):
        return [packet(start_s + n / 10, host, far + 100 + n, 50_000 + host % 7, 443, SYN) for n in range(40)]

    def last_of(*more):
        behaviour = Behaviour(len(rows))
        feed(behaviour, rows, trained=len(rows))
        alive = [packet(600 + n, far, HOST, 443, 30_000, ACK) for n in range(60)]
        others = [row for n in range(3) for row in scan(HOST + 1 + n, 601 + 10 * n)[:1]]
        packets = sorted([*alive, *others, *more, *scan(HOST, 650)], key=lambda row: row["time_us"])
        found = feed(behaviour, [*packets, packet(700, HOST, SERVER, 1, 80, ACK)])
        return total([each for each in found if each.sender and each.sender[3] == HOST], *CONTACTS)

    assert last_of() == 0
    assert last_of(*handshake(645, HOST + 1, far + 50, 50_000, 443)) > 12


def test_where_the_outside_was_never_heard_its_silence_says_nothing():
    behaviour = quiet_network()
    scan = [packet(700 + n / 10, HOST, 0x08000000 + n, 50_000, 443, SYN) for n in range(40)]
    assert total(feed(behaviour, [*scan, packet(720, HOST, SERVER, 1, 80, ACK)]), *CONTACTS) > 12


def test_forged_sources_are_counted_for_their_victim():
    behaviour = quiet_network()
    rows = [packet(700 + n / 100, 0x20000000 + n, SERVER, 50_000, 80, SYN) for n in range(100)]
    found = [each for each in feed(behaviour, rows) if each.statistic == "strangers"]
    assert found
    assert all(each.sender is None and each.victim == SERVER for each in found)


def test_reflectors_are_not_accused():
    """Somebody asked them in the victim's name; the flood is told for its victim."""
    behaviour = quiet_network()
    rows = [
        packet(700 + n / 2_000, 0x08000000 + n % 20, SERVER, udp_sport=53, udp_dport=20_000 + n)
        for n in range(2_000)
    ]
    found = feed(behaviour, rows)
    assert not [each for each in found if each.statistic in ("ports", "contacts", "targets")]
    assert total(found, "strangers") > 5


def test_claims_of_the_address_of_a_present_host_are_theft():
    behaviour = quiet_network()
    claim = packet(700.5, STRANGER, HOST, arp_op=2) | {"arp_src_ip": SERVER}
    there = packet(700, SERVER, HOST, 80, 30_000, ACK)
    found = feed(behaviour, [there, claim, packet(702, SERVER, HOST, 80, 30_000, ACK)])
    assert {(each.statistic, each.sender[2], each.victim) for each in found} >= {("thefts", STRANGER, SERVER)}
    assert behaviour.forged(("s1", 200, STRANGER, SERVER))
    absent = quiet_network()
    late = packet(9_000, STRANGER, HOST, arp_op=2) | {"arp_src_ip": SERVER}
    assert not total(feed(absent, [late]), "thefts")


def test_packets_to_a_blocked_host_prove_nothing():
    """Its answers are dropped, so everything towards it fails."""
    behaviour = quiet_network()
    rows = [packet(700 + n / 50, HOST, STRANGER, 50_000, 1_000 + n, SYN) for n in range(60)]
    blocked = Blocked()
    blocked.decide(decision(switch="s1", target=Target(kind="ip", address="10.0.0.200")))
    assert feed(behaviour, rows, blocked=blocked) == []


def test_only_what_is_new_is_said_again():
    """Findings add up to the weight, which has an upper end."""
    behaviour = quiet_network()
    rows = [packet(700 + n / 200, STRANGER, SERVER, 50_000, 1_000 + n, SYN) for n in range(2_000)]
    found = [each for each in feed(behaviour, rows) if each.statistic in CONTACTS]
    assert sum(each.nats for each in found) == pytest.approx(found[-1].total, rel=0.05)
    assert len(found) < 40


def test_what_was_learnt_survives_the_model_file():
    behaviour = quiet_network()
    feed(behaviour, [packet(650, HOST, SERVER, 1, 80, ACK)])
    again = Behaviour.from_state(json.loads(json.dumps(behaviour.to_state())))
    rows = [packet(700 + n / 50, HOST, SERVER, 50_000, 1_000 + n, SYN) for n in range(50)]
    assert feed(again, rows) == feed(behaviour, rows) != []
    with pytest.raises((KeyError, TypeError, ValueError)):
        Behaviour.from_state({"seconds": -1, "line": 1})
    with pytest.raises(ValueError, match="connected back"):
        Behaviour.from_state(behaviour.to_state() | {"callbacks": [1, 5]})
    with pytest.raises(ValueError, match="silence"):
        Behaviour.from_state(behaviour.to_state() | {"outside": [-3.0, True]})
    with pytest.raises(ValueError, match="ARP reply"):
        Behaviour.from_state(behaviour.to_state() | {"arp_grace": 0.0})
