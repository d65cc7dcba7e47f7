"""Frames are read as tshark reads them: on real captures, on built corner cases, and like the slow twin on noise."""

import gzip
import socket
import struct
import subprocess

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.packets import PACKET_COLUMNS, read_frames
from sdnator.testing.packet_rows import FIELDS as TSHARK_FIELDS
from tests.naive.frames import read_frame
from tests.requirements import require_program, shared_data

MACS = bytes.fromhex("0200000000020200000000 01".replace(" ", ""))
CAPTURES = ("synflood_one_source", "ssh_guessing", "ftp_bruteforce", "synflood_spoofed")


def pcap(path):
    data, at, rows = path.read_bytes(), 24, []
    while at + 16 <= len(data):
        seconds, micros, captured, length = struct.unpack_from("<IIII", data, at)
        rows.append((seconds * 1_000_000 + micros, length, data[at + 16 : at + 16 + captured]))
        at += 16 + captured
    return rows


def read(frames, lengths=None, times_us=None):
    count = np.arange(len(frames))
    lengths = [len(frame) for frame in frames] if lengths is None else lengths
    times_us = count if times_us is None else times_us
    return read_frames(
        frames, lengths=lengths, times_us=times_us, ports=count % 7, sequence=count + 1, arrival=count
    )


def row(batch, number=0):
    """The columns of one row that are not absent."""
    given = ("sequence", "arrival", "time_us", "port", "length")
    absent = {name: -1 if kind[0] == "i" else 0 for name, kind in PACKET_COLUMNS.items()}
    found = {name: int(batch[name][number]) for name in PACKET_COLUMNS if name not in given}
    return {name: value for name, value in found.items() if value != absent[name]}


def expected(frame):
    absent = {name: -1 if kind[0] == "i" else 0 for name, kind in PACKET_COLUMNS.items()}
    return {name: value for name, value in read_frame(frame).items() if value != absent[name]}


def one(*parts):
    return row(read([b"".join(parts)]))


def ethernet(kind, *tags):
    return MACS + b"".join(struct.pack(">HH", *tag) for tag in tags) + struct.pack(">H", kind)


def ip4(protocol, payload, *, fragment=0, options=b"", source="10.0.0.1", destination="10.0.0.2", total=None):
    size = 20 + len(options) + len(payload) if total is None else total
    first = 0x45 + len(options) // 4
    head = struct.pack(">BBHHHBBH", first, 0, size, 7, fragment, 64, protocol, 0)
    return head + socket.inet_aton(source) + socket.inet_aton(destination) + options + payload


def ip6(kind, payload, source="2001:db8::1", destination="2001:db8::2"):
    head = struct.pack(">IHBB", 6 << 28, len(payload), kind, 64)
    return (
        head
        + socket.inet_pton(socket.AF_INET6, source)
        + socket.inet_pton(socket.AF_INET6, destination)
        + payload
    )


def udp(sport=1111, dport=53, size=8):
    return struct.pack(">HHHH", sport, dport, size, 0)


def tcp(sport=40000, dport=80, flags=0x02):
    return struct.pack(">HHIIBBHHH", sport, dport, 77, 88, 0x50, flags, 0, 0, 0)


def tshark_row(batch, number):
    """The 19 columns as tshark prints them."""
    value = {name: int(batch[name][number]) for name in PACKET_COLUMNS}

    def mac(name):
        return value[name].to_bytes(6, "big").hex(":")

    def quad(address):
        return socket.inet_ntoa(address.to_bytes(4, "big"))

    def shown(name):
        return "" if value[name] < 0 else str(value[name])

    def address(side, version):
        if value["ip_version"] != version:
            return ""
        if version == 4:
            return quad(value[f"ip_{side}_lo"])
        packed = value[f"ip_{side}_hi"].to_bytes(8, "big") + value[f"ip_{side}_lo"].to_bytes(8, "big")
        return socket.inet_ntop(socket.AF_INET6, packed)

    seconds, micros = divmod(value["time_us"], 1_000_000)
    is_arp = value["arp_op"] >= 0
    arp = [mac("arp_src_mac"), quad(value["arp_src_ip"]), mac("arp_dst_mac"), quad(value["arp_dst_ip"])]
    numbers = ("tcp_sport", "tcp_dport", "udp_sport", "udp_dport", "icmp_type", "icmp_code", "arp_op")
    return [
        f"{seconds}.{micros:06d}000",
        str(value["length"]),
        mac("eth_src"),
        mac("eth_dst"),
        address("src", 4),
        address("dst", 4),
        *map(shown, numbers),
        *(arp if is_arp else [""] * 4),
        address("src", 6),
        address("dst", 6),
    ]


def padded(frame, length):
    return frame + bytes(length - len(frame))


@pytest.mark.parametrize("pad", [False, True])
def test_equals_tshark_on_the_real_capture(pad):
    capture = pcap(shared_data("kitsune/mirai2000.pcap"))
    times, lengths, frames = zip(*capture, strict=True)
    if pad:
        frames = [padded(frame, length)[:256] for frame, length in zip(frames, lengths, strict=True)]
    batch = read(frames, lengths, times)
    with gzip.open(shared_data("kitsune/mirai_38k.tsv.gz"), "rt") as text:
        next(text)
        for number in range(len(frames)):
            assert tshark_row(batch, number) == next(text).rstrip("\n").split("\t")


@pytest.mark.parametrize("name", CAPTURES)
def test_equals_an_installed_tshark(name):
    tshark = require_program("tshark")
    path = shared_data(f"captures/{name}.pcap")
    fields = [part for field in TSHARK_FIELDS for part in ("-e", field)]
    options = ["-T", "fields", "-E", "header=n", "-E", "occurrence=f", *fields]
    done = subprocess.run(
        [tshark, "-n", "-r", str(path), *options], capture_output=True, text=True, check=True
    )
    times, lengths, frames = zip(*pcap(path), strict=True)
    batch = read(frames, lengths, times)
    lines = done.stdout.splitlines()
    assert len(lines) == len(frames)
    for number, line in enumerate(lines):
        assert tshark_row(batch, number) == line.split("\t")


@pytest.mark.parametrize("name", CAPTURES)
def test_equals_the_slow_twin_on_real_captures(name):
    capture = pcap(shared_data(f"captures/{name}.pcap"))[:2000]
    times, lengths, frames = zip(*capture, strict=True)
    batch = read(frames, lengths, times)
    for number, frame in enumerate(frames):
        assert row(batch, number) == expected(frame)


def test_has_every_column_with_its_type():
    batch = read([ethernet(0x0800) + ip4(17, udp())])
    assert {name: batch[name].dtype.str[1:] for name in batch.columns} == PACKET_COLUMNS
    assert len(read([])) == 0


def test_tcp_of_the_packet_itself():
    found = one(ethernet(0x0800), ip4(6, tcp(flags=0xC2)))
    assert (found["tcp_sport"], found["tcp_dport"], found["tcp_flags"]) == (40000, 80, 0xC2)
    assert (found["tcp_seq"], found["tcp_ack"], found["ip_proto"]) == (77, 88, 6)


@pytest.mark.parametrize("inner_options", [b"", b"\x01" * 8])
def test_icmp_error_shows_quoted_ports(inner_options):
    quoted = ip4(17, udp(5353, 53), options=inner_options, source="10.9.9.9")
    found = one(ethernet(0x0800), ip4(1, struct.pack(">BBHI", 3, 3, 0, 0) + quoted))
    assert (found["udp_sport"], found["udp_dport"], found["quoted"]) == (5353, 53, 1)
    assert (found["icmp_type"], found["icmp_code"], found["ip_src_lo"]) == (3, 3, 0x0A000001)
    assert "tcp_flags" not in found


def test_icmp_echo_quotes_nothing():
    found = one(ethernet(0x0800), ip4(1, struct.pack(">BBHI", 8, 0, 0, 0) + ip4(17, udp())))
    assert found["icmp_type"] == 8
    assert "udp_sport" not in found


def test_icmp6_error_shows_quoted_ports():
    quoted = ip6(6, tcp(1234, 443)[:8])
    found = one(ethernet(0x86DD), ip6(58, struct.pack(">BBHI", 1, 4, 0, 0) + quoted))
    assert (found["tcp_sport"], found["tcp_dport"], found["icmp6_type"]) == (1234, 443, 1)
    assert "icmp_type" not in found


def test_vlan_tags_two_are_read_a_third_is_not():
    two = one(ethernet(0x0800, (0x88A8, 100), (0x8100, 0x2005)), ip4(17, udp()))
    assert (two["vlan"], two["eth_type"], two["udp_dport"]) == (100, 0x0800, 53)
    three = one(ethernet(0x0800, (0x88A8, 100), (0x8100, 5), (0x8100, 6)), ip4(17, udp()))
    assert (three["vlan"], three["eth_type"]) == (100, 0x8100)
    assert "udp_dport" not in three


@pytest.mark.parametrize(("count", "seen"), [(1, True), (3, True), (4, False)])
def test_ipv6_extension_headers_three_are_read(count, seen):
    payload = udp()
    kinds = [0, 60, 43, 60][:count]
    for following in [17, *reversed(kinds[1:])]:
        payload = bytes([following, 0]) + bytes(6) + payload
    found = one(ethernet(0x86DD), ip6(kinds[0], payload))
    assert ("udp_dport" in found) == seen
    assert found["ip_proto"] == (17 if seen else 60)


def test_ports_of_fragments_stand_in_the_first():
    first = one(ethernet(0x0800), ip4(17, udp(), fragment=0x2000))
    later = one(ethernet(0x0800), ip4(17, udp(), fragment=0x0010))
    assert first["udp_dport"] == 53
    assert "udp_dport" not in later
    assert later["ip_proto"] == 17
    later6 = one(ethernet(0x86DD), ip6(44, struct.pack(">BBHI", 17, 0, 8, 1) + udp()))
    assert "udp_dport" not in later6


@pytest.mark.parametrize("protocol", [4, 41, 47])
def test_the_inside_of_tunnels_is_not_read(protocol):
    found = one(ethernet(0x0800), ip4(protocol, ip4(17, udp())))
    assert found["ip_proto"] == protocol
    assert "udp_sport" not in found


def test_padding_behind_the_datagram_is_not_a_header():
    found = one(ethernet(0x0800), ip4(1, struct.pack(">BBHI", 3, 3, 0, 0)), ip4(17, udp()))
    assert "udp_sport" not in found


def test_802_3_frames_and_snap():
    llc = one(ethernet(38), b"\x42\x42\x03" + bytes(35))
    assert "eth_type" not in llc
    snap = one(ethernet(36), bytes.fromhex("aaaa03000000"), b"\x08\x00", ip4(17, udp()))
    assert (snap["udp_dport"], snap["ip_version"]) == (53, 4)
    assert "eth_type" not in snap


def test_arp_other_than_ipv4_over_ethernet_is_no_arp():
    body = struct.pack(">HHBBH", 1, 0x0800, 6, 4, 2) + MACS[6:] + b"\x0a\0\0\1" + MACS[:6] + b"\x0a\0\0\2"
    found = one(ethernet(0x0806), body)
    assert (found["arp_op"], found["arp_src_ip"], found["arp_dst_ip"]) == (2, 0x0A000001, 0x0A000002)
    assert "arp_op" not in one(ethernet(0x0806), b"\0\x07" + body[2:])


def test_segmentation_offload_leaves_total_length_zero():
    assert one(ethernet(0x0800), ip4(17, udp(), total=0))["udp_dport"] == 53


@pytest.mark.parametrize("cut", [0, 5, 6, 12, 13, 14, 20, 33, 34, 37, 38, 47, 48])
def test_cut_frames_are_absent_where_bytes_are_missing(cut):
    frame = (ethernet(0x0800) + ip4(6, tcp()))[:cut]
    assert row(read([frame])) == expected(frame)


def test_columns_of_wrong_length_are_named():
    with pytest.raises(ValueError, match=r"2 frames, but port has shape \(1,\)"):
        read_frames([b"", b""], lengths=[0, 0], times_us=[0, 0], ports=[1], sequence=[1, 2], arrival=[0, 1])


def _frames():
    kinds = st.sampled_from([0x0800, 0x86DD, 0x0806, 0x8100, 0x88A8, 0x9100, 40, 0x88CC])
    noise = st.binary(max_size=40)
    transport = st.one_of(noise, st.just(udp()), st.just(tcp()))
    quoted = st.one_of(
        st.builds(ip4, st.sampled_from([6, 17, 1]), transport), st.builds(ip6, st.just(17), transport)
    )
    errors = st.builds(
        lambda kind, inner: struct.pack(">BBHI", kind, 1, 0, 0) + inner,
        st.integers(0, 13),
        quoted,
    )
    inner = st.one_of(transport, errors)
    packets = st.one_of(
        st.builds(
            ip4,
            st.sampled_from([1, 6, 17, 58, 136, 47]),
            inner,
            fragment=st.sampled_from([0, 0x2000, 0x4000, 3]),
            options=st.sampled_from([b"", b"\x01" * 4, b"\x01" * 40]),
            total=st.one_of(st.none(), st.integers(0, 90)),
        ),
        st.builds(ip6, st.sampled_from([0, 43, 44, 51, 60, 6, 17, 58]), inner),
        noise,
        st.builds(lambda rest: bytes.fromhex("aaaa030000000800") + rest, st.builds(ip4, st.just(17), inner)),
    )
    tags = st.lists(st.tuples(st.sampled_from([0x8100, 0x88A8]), st.integers(0, 65535)), max_size=3)
    whole = st.builds(lambda kind, tags, packet: ethernet(kind, *tags) + packet, kinds, tags, packets)
    return st.builds(lambda frame, cut: frame[: len(frame) - cut], whole, st.integers(0, 30))


@settings(max_examples=150, deadline=None)
@given(st.lists(_frames(), max_size=8))
def test_equals_the_slow_twin_on_noise(frames):
    batch = read(frames)
    for number, frame in enumerate(frames):
        assert row(batch, number) == expected(frame)
