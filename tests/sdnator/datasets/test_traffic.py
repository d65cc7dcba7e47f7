"""Packets become frames of the right length, cut to what is kept; chance is reproducible."""

import pytest
from scapy.layers.dns import DNS
from scapy.layers.inet import ICMP, IP, TCP, UDP
from scapy.layers.l2 import Ether

from sdnator.datasets import frames, hosts
from sdnator.datasets.traffic import (
    ECHO,
    RAW,
    SECOND,
    Chance,
    SentPacket,
    as_frame,
    query,
)
from sdnator.datasets.traffic import (
    TCP as TCP_KIND,
)
from sdnator.datasets.traffic import (
    UDP as UDP_KIND,
)


@pytest.mark.parametrize("length", [60, 74, 200, 201, 554, 1514])
def test_lengths_and_cuts(length):
    """The IP header tells the whole length, the bytes end at the snap length."""
    sent = SentPacket(5, UDP_KIND, hosts.DOME, hosts.PC.ip, length, 1, 2)
    frame = as_frame(sent, 200)
    assert (frame.time, frame.length, len(frame.data), frame.attacker) == (5, length, min(length, 200), "")
    assert Ether(frame.data)[IP].len == length - 14
    assert Ether(frame.data)[UDP].len == length - 34


def test_tcp_sizes():
    """A SYN of 74 bytes has 20 of options; an ACK of 60 has no payload, one of 1,502 has 1,448."""
    syn = Ether(as_frame(SentPacket(0, TCP_KIND, hosts.DOME, hosts.PC.ip, 74, 1, 2, frames.SYN), 200).data)
    assert (syn[TCP].dataofs, syn[IP].len) == (10, 60)
    ack = Ether(as_frame(SentPacket(0, TCP_KIND, hosts.DOME, hosts.PC.ip, 60, 1, 2, frames.ACK), 200).data)
    assert ack[IP].len == 40
    data = Ether(as_frame(SentPacket(0, TCP_KIND, hosts.DOME, hosts.PC.ip, 1502, 1, 2, frames.ACK), 200).data)
    assert data[IP].len - 40 == 1448


def test_echo_and_raw():
    echo = Ether(as_frame(SentPacket(0, ECHO, hosts.DOME, hosts.PC.ip, 98, number=70_000), 200).data)
    assert (echo[ICMP].type, echo[ICMP].seq, echo[IP].len) == (8, 70_000 & 0xFFFF, 84)
    assert as_frame(SentPacket(0, RAW, hosts.DOME, b"\xe0", 60, payload=b"abc"), 200).data == b"abc" + bytes(
        57
    )


def test_query_is_a_dns_question():
    found = DNS(query("www.camera.example", 7))
    assert (found.id, found.qd[0].qname) == (7, b"www.camera.example.")


def test_chance_is_reproducible_and_independent():
    first, again, other = Chance(1, 2, 3), Chance(1, 2, 3), Chance(1, 2, 4)
    drawn = [first.number(0, 10**9) for _ in range(5)]
    assert drawn == [again.number(0, 10**9) for _ in range(5)]
    assert drawn != [other.number(0, 10**9) for _ in range(5)]


def test_chance_keeps_its_bounds():
    chance = Chance(1)
    times = list(chance.every(2.0, 5.0, 0, 100 * SECOND))
    assert times == sorted(times)
    assert all(0 <= time < 100 * SECOND for time in times)
    assert sorted(chance.pick(1, 254, 254)) == list(range(1, 255))
    assert 0 < sum(chance.happens(0.5) for _ in range(100)) < 100
    assert 32_768 <= chance.port() <= 60_999
