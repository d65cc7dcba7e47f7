"""Frames of a flood are what scapy would have made, from the sources that were asked for."""

import pytest
from scapy.layers.inet import IP, TCP
from scapy.layers.inet6 import IPv6
from scapy.layers.l2 import Ether

from sdnator.syn_flood_frames import FloodPlan, make_frames

VICTIMS = {4: ("10.0.0.1", "10.2.0.0/16", IP), 6: ("fd00::1", "fd00:0:0:2::/64", IPv6)}


def plan(sources, version: int, *, rate: int = 100, seconds: float = 2.0) -> FloodPlan:
    victim, prefix, _ = VICTIMS[version]
    return FloodPlan(
        sources=sources,
        rate=rate,
        seconds=seconds,
        victim=victim,
        victim_mac="02:00:00:00:00:03",
        attacker_mac="02:00:00:00:00:01",
        port=80,
        prefix=prefix,
    )


def frames(sources, version: int, **changes):
    network = VICTIMS[version][2]
    return [Ether(row.tobytes())[network] for row in make_frames(plan(sources, version, **changes))]


@pytest.mark.parametrize("version", [4, 6])
@pytest.mark.parametrize("sources", ["one", "spoofed"])
def test_checksums_are_right(sources, version):
    """Or the victim's kernel would drop the frames, and the flood would harm nobody."""
    for packet in frames(sources, version, seconds=0.5):
        again = packet.copy()
        del again[TCP].chksum
        if version == 4:
            del again[IP].chksum
        assert bytes(again) == bytes(packet)
        assert packet[TCP].flags == "S"
        assert packet[TCP].dport == 80


@pytest.mark.parametrize("version", [4, 6])
@pytest.mark.parametrize(
    ("sources", "count"), [("one", 1), ("hundred", 100), ("spoofed", 200), ("repeating", 100)]
)
def test_number_of_sources(sources, count, version):
    """One, a hundred, a new one for each SYN; every SYN of the repeating flood's second second is a repeat."""
    seen = {packet.src for packet in frames(sources, version)}
    assert count <= len(seen) <= count + 50 * (sources == "repeating")


def test_repeated_syn_is_the_same_after_a_second():
    """Same source, ports and number, about `rate` frames later."""
    rows = [row.tobytes() for row in make_frames(plan("repeating", 4, seconds=3.0))]
    first = {row: place for place, row in reversed(list(enumerate(rows)))}
    distances = {place - first[row] for place, row in enumerate(rows) if first[row] != place}
    assert distances == {101}
