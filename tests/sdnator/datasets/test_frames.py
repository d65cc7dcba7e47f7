"""Frames are what other programs read: checksums right, fields where scapy finds them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import ICMP, IP, TCP, UDP
from scapy.layers.inet6 import ICMPv6ND_NA, IPv6
from scapy.layers.l2 import ARP, LLC, Dot3, Ether

from sdnator.datasets import frames

MAC_A, MAC_B = bytes.fromhex("020000000001"), bytes.fromhex("020000000002")
IP_A, IP_B = bytes((10, 0, 0, 1)), bytes((10, 0, 0, 2))


def _slow_checksum(data: bytes) -> int:
    """RFC 1071 word by word."""
    total = 0
    for at in range(0, len(data), 2):
        total += int.from_bytes(data[at : at + 2].ljust(2, b"\0"), "big")
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


@given(st.binary(max_size=200) | st.sampled_from([b"", b"\xff\xff", b"\xff\xff\0\0", b"\0" * 7]))
def test_checksum_equals_the_slow_one(data):
    assert frames.checksum(data) == _slow_checksum(data)


def _same_when_rebuilt(data: bytes, *layers) -> None:
    """scapy computes the same checksums and lengths when it makes the frame itself."""
    parsed = Ether(data)
    for layer in layers:
        for field in ("chksum", "cksum", "len", "plen"):
            if field in parsed[layer].fields:
                parsed[layer].delfieldval(field)
    assert bytes(parsed) == data


@given(st.integers(0, 65535), st.integers(0, 65535), st.binary(max_size=60), st.integers(0, 255))
def test_udp_and_tcp(sport, dport, payload, flags):
    datagram = frames.udp(IP_A, IP_B, sport, dport, payload)
    packet = frames.ipv4(IP_A, IP_B, frames.UDP, datagram, ident=7)
    data = frames.ethernet(MAC_B, MAC_A, frames.TYPE_IPV4, packet)
    parsed = Ether(data)
    assert (parsed[UDP].sport, parsed[UDP].dport, parsed[IP].src, parsed.dst) == (
        sport,
        dport,
        "10.0.0.1",
        "02:00:00:00:00:02",
    )
    assert Ether(data)[IP].chksum == _slow_checksum(packet[:10] + b"\0\0" + packet[12:20])
    segment = frames.tcp(IP_A, IP_B, sport, dport, flags, seq=5, ack=6, options=b"\1" * 8, payload=payload)
    packet = frames.ipv4(IP_A, IP_B, frames.TCP, segment)
    parsed = Ether(frames.ethernet(MAC_B, MAC_A, frames.TYPE_IPV4, packet))
    assert (parsed[TCP].sport, parsed[TCP].dport, int(parsed[TCP].flags), parsed[TCP].seq) == (
        sport,
        dport,
        flags,
        5,
    )
    assert bytes(parsed[TCP].payload) == payload


def test_scapy_agrees_on_checksums():
    tcp = frames.tcp(IP_A, IP_B, 1, 2, frames.SYN, options=bytes.fromhex("020405b4"))
    _same_when_rebuilt(
        frames.ethernet(MAC_B, MAC_A, frames.TYPE_IPV4, frames.ipv4(IP_A, IP_B, frames.TCP, tcp)), IP, TCP
    )
    udp = frames.udp(IP_A, IP_B, 1_000, 53_000, b"\1\2\3")
    _same_when_rebuilt(
        frames.ethernet(MAC_B, MAC_A, frames.TYPE_IPV4, frames.ipv4(IP_A, IP_B, frames.UDP, udp)), IP, UDP
    )
    echo = frames.icmp(8, 0, b"\0\1\0\2", b"abc")
    _same_when_rebuilt(
        frames.ethernet(MAC_B, MAC_A, frames.TYPE_IPV4, frames.ipv4(IP_A, IP_B, frames.ICMP, echo)), IP, ICMP
    )


def test_checksums_do_not_need_zero_payloads():
    """`more` stands for zeros: lengths count them, checksums are as if they were there."""
    full = frames.ipv4(IP_A, IP_B, frames.UDP, frames.udp(IP_A, IP_B, 1, 2, b"x" + bytes(99)))
    short = frames.ipv4(IP_A, IP_B, frames.UDP, frames.udp(IP_A, IP_B, 1, 2, b"x", more=99), more=99)
    assert full[: len(short)] == short
    full = frames.ipv4(IP_A, IP_B, frames.TCP, frames.tcp(IP_A, IP_B, 1, 2, 0, payload=bytes(99)))
    short = frames.ipv4(IP_A, IP_B, frames.TCP, frames.tcp(IP_A, IP_B, 1, 2, 0, more=99), more=99)
    assert full[: len(short)] == short


def test_arp_goes_to_everybody_or_to_one():
    request = Ether(frames.arp(1, MAC_A, IP_A, bytes(6), IP_B))
    assert (request.dst, request[ARP].op, request[ARP].psrc, request[ARP].pdst) == (
        "ff:" * 5 + "ff",
        1,
        "10.0.0.1",
        "10.0.0.2",
    )
    assert Ether(frames.arp(1, MAC_A, IP_A, bytes(6), IP_B, to=MAC_B)).dst == "02:00:00:00:00:02"
    assert Ether(frames.arp(2, MAC_A, IP_A, MAC_B, IP_B)).dst == "02:00:00:00:00:02"


def test_ipv6_neighbour_and_llc():
    six = bytes.fromhex("fe80" + "00" * 13 + "01")
    message = frames.icmp6(six, six, 136, 0, bytes(4) + six)
    data = frames.ethernet(
        MAC_B, MAC_A, frames.TYPE_IPV6, frames.ipv6(six, six, frames.ICMP6, message, hops=255)
    )
    assert ICMPv6ND_NA in Ether(data)
    _same_when_rebuilt(data, IPv6, ICMPv6ND_NA)
    assert Dot3(frames.llc(MAC_B, MAC_A, b"\x42\x42\x03abc"))[LLC].dsap == 0x42


@pytest.mark.parametrize(
    ("size", "names"),
    [(0, []), (4, ["MSS"]), (12, ["MSS", "EOL"]), (20, ["MSS", "SAckOK", "Timestamp", "NOP", "WScale"])],
)
def test_syn_options(size, names):
    options = frames.syn_options(size)
    assert len(options) == size
    segment = frames.tcp(IP_A, IP_B, 1, 2, frames.SYN, options=options)
    assert list(dict.fromkeys(name for name, _ in TCP(segment).options)) == names


def test_pad():
    assert frames.pad(b"x") == b"x" + bytes(59)
    assert frames.pad(b"x" * 70) == b"x" * 70
    with pytest.raises(TypeError):
        frames.pad("text")  # type: ignore[arg-type]
