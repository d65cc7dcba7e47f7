"""Frames that the parser cannot take apart: counted by cause, passed unless an entry drops them, copied as others."""

import pytest

from dataplane.v1model.tables import Exact, Ternary
from tests.p4.sdnator_switch import PACKET_IN_BYTES, entry, ethernet, mac, udp, want_all

CUT, MALFORMED, EXTENSIONS, PROTOCOL, ETHERTYPE = range(1, 6)
ENDS = (mac(1), mac(2))
_V6 = b"\x60\0\0\0\0\x20"
_V6_ENDS = bytes([64]) + bytes(15) + b"\1" + bytes(15) + b"\2"


def ipv6(following, payload):
    return ethernet(*ENDS, _V6 + bytes([following]) + _V6_ENDS + payload, etype=0x86DD)


def extension(following):
    return bytes([following, 0]) + bytes(6)


CASES = {
    "no whole Ethernet header": (b"\2\0\0", CUT),
    "IPv4 header cut": (ethernet(*ENDS, udp()[:15]), CUT),
    "UDP header cut": (ethernet(*ENDS, udp()[:24]), CUT),
    "version 5 in an IPv4 frame": (ethernet(*ENDS, udp(first=0x55)), MALFORMED),
    "IPv4 header of 4 words": (ethernet(*ENDS, udp(first=0x44)), MALFORMED),
    "version 4 in an IPv6 frame": (
        ethernet(*ENDS, b"\x40" + _V6[1:] + b"\x11" + _V6_ENDS + bytes(8), etype=0x86DD),
        MALFORMED,
    ),
    "four extension headers": (
        ipv6(0, extension(60) + extension(60) + extension(60) + extension(17) + bytes(8)),
        EXTENSIONS,
    ),
    "OSPF": (ethernet(*ENDS, udp(protocol=89)), PROTOCOL),
    "ESP over IPv6": (ipv6(50, bytes(20)), PROTOCOL),
    "LLDP": (ethernet(*ENDS, bytes(40), etype=0x88CC), ETHERTYPE),
    "802.3 length": (ethernet(*ENDS, bytes(40), etype=38), ETHERTYPE),
    "three VLAN tags": (ethernet(*ENDS, b"\0\1\x81\0\0\1\x08\0" + udp(), etype=0x8100, vid=3), ETHERTYPE),
}
PARSED = {
    "UDP": ethernet(*ENDS, udp()),
    "tagged": ethernet(*ENDS, udp(), vid=5),
    "IPv6 UDP behind three extension headers": ipv6(
        0, extension(60) + extension(43) + extension(17) + bytes(8)
    ),
    "no next header": ipv6(59, b""),
    "later fragment": ethernet(*ENDS, udp()[:6] + b"\0\5" + udp()[8:]),
}


@pytest.fixture
def forwarding(switch):
    switch.tables["ingress.forward_port"].insert(entry((Exact(1),), "to_port", 2))
    return switch


def unparsed(switch):
    """Frames by cause."""
    counter = switch.counters["ingress.unparsed_frames"]
    return {cause: n for cause in range(8) if (n := counter.read(cause).packets)}


@pytest.mark.parametrize("name", CASES)
def test_it_is_counted_forwarded_and_copied(forwarding, name):
    data, cause = CASES[name]
    want_all(forwarding, copies=1)
    result = forwarding.process(1, data, 9)
    assert unparsed(forwarding) == {cause: 1}
    assert result.outputs == [(2, data)]
    assert [copy[PACKET_IN_BYTES:] for copy in result.packet_ins] == [data]


@pytest.mark.parametrize("name", PARSED)
def test_what_was_taken_apart_is_not_counted(forwarding, name):
    assert forwarding.process(1, PARSED[name], 9).outputs
    assert unparsed(forwarding) == {}


def test_an_entry_drops_a_cause_and_counts_it(forwarding):
    table = forwarding.tables["ingress.unparsed"]
    table.insert(entry((Exact(PROTOCOL),), "drop_unparsed"))
    want_all(forwarding, copies=1)
    result = forwarding.process(1, CASES["OSPF"][0], 9)
    assert (result.outputs, result.packet_ins) == ([], [])
    assert table.counter((Exact(PROTOCOL),)).packets == 1
    assert forwarding.process(1, CASES["LLDP"][0], 9).outputs
    assert unparsed(forwarding) == {PROTOCOL: 1, ETHERTYPE: 1}


def test_the_default_can_be_to_drop_all_of_it(forwarding):
    forwarding.tables["ingress.unparsed"].set_default("ingress.drop_unparsed")
    assert all(not forwarding.process(1, data, 9).outputs for data, _ in CASES.values())
    assert all(forwarding.process(1, data, 9).outputs for data in PARSED.values())


def test_allow_wins_over_it(forwarding):
    forwarding.tables["ingress.unparsed"].set_default("ingress.drop_unparsed")
    source = Ternary(mac(1), (1 << 48) - 1)
    wild = Ternary(0, 0)
    match = (wild, source, wild, wild, wild, wild, wild)
    forwarding.tables["ingress.allow"].insert(entry(match, "allow_frame", priority=1))
    assert forwarding.process(1, CASES["OSPF"][0], 9).outputs
