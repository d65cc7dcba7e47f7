"""Frames of a flood are what scapy would have made, from the sources that were asked for."""

import pytest
from scapy.layers.inet import IP, TCP
from scapy.layers.inet6 import IPv6
from scapy.layers.l2 import Ether
from scapy.utils import wrpcap

from sdnator.demos.syn_flood.frames import FloodPlan, flood_sources, make_flood

VICTIMS = {4: ("10.0.0.1", "10.2.0.0/16", IP), 6: ("fd00::1", "fd00:0:0:2::/64", IPv6)}


def plan(sources, version: int = 4, *, rate: int = 100, seconds: float = 2.0, **changes) -> FloodPlan:
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
        **changes,
    )


def frames(sources, version: int, **changes):
    network = VICTIMS[version][2]
    return [Ether(row.tobytes())[network] for row in make_flood(plan(sources, version, **changes)).frames]


@pytest.fixture
def capture(tmp_path) -> str:
    """Three SYNs, one of them with ECN bits, between frames that are none."""
    packets = [
        Ether() / IP(src=source, dst="192.0.2.1") / TCP(sport=sport, dport=25565, seq=sport, flags=flags)
        for source, sport, flags in (
            ("198.51.100.1", 1111, "S"),
            ("198.51.100.9", 9999, "SA"),
            ("198.51.100.2", 2222, "SEC"),
            ("198.51.100.3", 3333, "S"),
        )
    ]
    for number, packet in enumerate(packets):
        packet.time = 1000.0 + number
    path = tmp_path / "syns.pcap"
    wrpcap(str(path), packets)
    return str(path)


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
    assert set(flood_sources(plan(sources, version))) == (
        seen if count != 200 and sources != "repeating" else set()
    )


def test_repeated_syn_is_the_same_after_a_second():
    """Same source, ports and number, about `rate` frames later."""
    rows = [row.tobytes() for row in make_flood(plan("repeating", seconds=3.0)).frames]
    first = {row: place for place, row in reversed(list(enumerate(rows)))}
    distances = {place - first[row] for place, row in enumerate(rows) if first[row] != place}
    assert distances == {101}


@pytest.mark.parametrize("version", [4, 6])
def test_capture_goes_round_at_the_rate(capture, version):
    """Source, port, number and flags are the capture's; victim and port are ours."""
    seen = frames("capture", version, capture=capture, rate=2, seconds=2.0)
    assert [packet[TCP].sport for packet in seen] == [1111, 2222, 3333, 1111]
    assert [packet[TCP].seq for packet in seen] == [1111, 2222, 3333, 1111]
    assert str(seen[1][TCP].flags) == "SEC"
    assert all((packet.dst, packet[TCP].dport) == (VICTIMS[version][0], 80) for packet in seen)
    wanted = "198.51.100.2" if version == 4 else "64:ff9b::c633:6402"
    assert seen[1].src == wanted


def test_capture_as_recorded_keeps_its_times(capture):
    """Once, and no rate counts."""
    flood = make_flood(plan("capture", capture=capture, as_recorded=True))
    assert flood.due.tolist() == pytest.approx([0.0, 2.0, 3.0])
    assert len(flood.frames) == 3
