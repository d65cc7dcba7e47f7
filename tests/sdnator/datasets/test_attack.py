"""The attack does what Mirai does, in the order of the plan, and names its sender in every packet."""

import pytest

from sdnator.datasets import frames, hosts
from sdnator.datasets.attack import AttackPlan, traffic
from sdnator.datasets.traffic import ARP, SECOND, TCP, UDP, SentPacket

LENGTH = 400 * SECOND


def _attack(**options) -> list[SentPacket]:
    return traffic(1, SECOND, SECOND + LENGTH, AttackPlan(**options))


def test_every_packet_names_its_sender():
    sent = _attack()
    assert {packet.attacker for packet in sent} == {hosts.INFECTED.mac_text, hosts.INTRUDER.mac_text}
    assert all(packet.attacker == packet.src.mac_text for packet in sent)
    times = [packet.time for packet in sent]
    assert times == sorted(times)
    assert SECOND <= times[0] < times[-1] < SECOND + LENGTH


def test_the_scan_is_mirais():
    """Port 23 nine times of ten, else 2323; the sequence number is the target; one source port."""
    scan = [
        packet
        for packet in _attack()
        if packet.kind == TCP and packet.dport in {23, 2323} and not packet.answered
    ]
    assert len(scan) > 4_000
    assert {packet.number == int.from_bytes(packet.dst, "big") for packet in scan} == {True}
    assert len({packet.sport for packet in scan}) == 1
    assert 0.07 < sum(packet.dport == 2323 for packet in scan) / len(scan) < 0.13
    assert sum(hosts.is_local(packet.dst) for packet in scan) / len(scan) == pytest.approx(0.2, abs=0.03)


def test_break_in_sweep_and_commands():
    sent = _attack()
    login = [packet for packet in sent if packet.src is hosts.INTRUDER and packet.dport == 23]
    sweep = [packet for packet in sent if packet.kind == ARP and packet.src is hosts.INFECTED]
    orders = [packet for packet in sent if packet.src is hosts.INTRUDER and packet.sport == 48_101]
    assert login[0].time < sweep[1].time
    assert len({packet.dst for packet in sweep}) >= 250
    assert len(orders) >= 5


@pytest.mark.parametrize("kind", ["udp", "syn", "ack"])
def test_one_kind_of_flood_only(kind):
    sent = [packet for packet in _attack(floods=(kind,), scan=False) if not packet.answered]
    flags = {"udp": 0, "syn": frames.SYN, "ack": frames.ACK}[kind]
    flood = [packet for packet in sent if packet.kind == (UDP if kind == "udp" else TCP)]
    assert len(flood) > 5_000
    assert {packet.flags for packet in flood} == {flags}
    assert {packet.dport for packet in sent if packet.kind == TCP} <= {80}


def test_quiet_plan():
    """No scan, no floods: break-in and commands are left."""
    sent = _attack(floods=(), scan=False)
    assert 100 < len(sent) < 2_000
