"""Traffic as a pcap with its label file, for `sdnator replay` and for programs that read captures.

Frames are as long as they were on the wire; payloads are zeros (those of names and messages too).  A reader finds in
them the columns that were written, except `port`, `sequence` and `arrival`, which no pcap has.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.decision_traffic.hosts import mac_text
from benchmarks.decision_traffic.packets import ARP_TYPE, ICMP, ICMP6, IPV6, TCP, UDP
from benchmarks.decision_traffic.traffic import Array, Traffic
from sdnator.capture.captures import CaptureWriter
from sdnator.capture.labels import Labels, labels_path, write_labels
from sdnator.datasets import frames

_NEEDED: Final = (
    "time_us", "length", "eth_src", "eth_dst", "eth_type", "arp_op", "arp_src_mac", "arp_src_ip", "arp_dst_mac",
    "arp_dst_ip", "ip_version", "ip_src_hi", "ip_src_lo", "ip_dst_hi", "ip_dst_lo", "ip_proto", "tcp_sport",
    "tcp_dport", "udp_sport", "udp_dport", "quoted", "tcp_flags", "tcp_seq", "tcp_ack", "icmp_type", "icmp_code",
    "icmp6_type", "icmp6_code",
)  # fmt: skip
_ROWS: Final = 65_536


class _Row(NamedTuple):
    """One packet."""

    time_us: int
    length: int
    eth_src: int
    eth_dst: int
    eth_type: int
    arp_op: int
    arp_src_mac: int
    arp_src_ip: int
    arp_dst_mac: int
    arp_dst_ip: int
    ip_version: int
    ip_src_hi: int
    ip_src_lo: int
    ip_dst_hi: int
    ip_dst_lo: int
    ip_proto: int
    tcp_sport: int
    tcp_dport: int
    udp_sport: int
    udp_dport: int
    quoted: int
    tcp_flags: int
    tcp_seq: int
    tcp_ack: int
    icmp_type: int
    icmp_code: int
    icmp6_type: int
    icmp6_code: int


def to_capture(
    columns: Mapping[str, Array], labels: npt.NDArray[np.int32], path: Path, *, snap: int | None = None
) -> None:
    """Write the packets to `path` (pcap) and their labels beside it (`NAME.labels.csv`); both appear when whole.

    Args:
        columns: as in `Traffic`; IPv4, ARP, IPv6 with ICMPv6 or UDP, and frames of other types.
        labels: attack id of each packet; a packet with one is labelled with its sender's MAC as attacker.
        path: file to write; gzipped where it ends in `.gz`.
        snap: bytes kept of each frame, None: all.

    Raises:
        OSError: `path` cannot be written.
    """
    write_captures([Traffic(dict(columns), labels)], path, snap=snap)


def write_captures(parts: Iterable[Traffic], path: Path, *, snap: int | None = None) -> None:
    """The same for parts that follow each other, with the memory of one."""
    attack: list[npt.NDArray[np.bool_]] = []
    attackers: list[str] = []
    with CaptureWriter(path) as writer:
        for part in parts:
            for some in part.batches(_ROWS):
                for row in _rows(some):
                    data = frame(row)
                    writer.write(row.time_us * 1_000, data[:snap], len(data))
                is_attack = some.attack != 0
                attack.append(is_attack)
                senders = some.columns["eth_src"].tolist()
                attackers += [
                    mac_text(mac) if flag else ""
                    for mac, flag in zip(senders, is_attack.tolist(), strict=True)
                ]
    write_labels(labels_path(path), Labels.of(np.concatenate([np.zeros(0, np.bool_), *attack]), attackers))


def frames_in(part: Traffic) -> Iterator[bytes]:
    """The frames of the packets, in order, as long as on the wire."""
    for some in part.batches(_ROWS):
        yield from map(frame, _rows(some))


def _rows(part: Traffic) -> Iterator[_Row]:
    return map(_Row._make, zip(*(part.columns[name].tolist() for name in _NEEDED), strict=True))


def frame(row: _Row) -> bytes:
    """The frame of one packet, as long as on the wire."""
    if row.eth_type == ARP_TYPE:
        body = _arp(row)
    elif row.ip_version == 4:
        body = _ipv4(row)
    elif row.eth_type == IPV6 and row.ip_version == 6:
        body = _ipv6(row)
    else:
        body = b"\0\0\1\0" if row.eth_type else b"\x42\x42\x03"
    kind = row.eth_type or row.length - 14
    whole = frames.ethernet(row.eth_dst.to_bytes(6, "big"), row.eth_src.to_bytes(6, "big"), kind, body)
    return frames.pad(whole, row.length)[: row.length]


def _arp(row: _Row) -> bytes:
    src, dst = row.arp_src_mac.to_bytes(6, "big"), row.arp_dst_mac.to_bytes(6, "big")
    addresses = [value.to_bytes(4, "big") for value in (row.arp_src_ip, row.arp_dst_ip)]
    return frames.arp(row.arp_op, src, addresses[0], dst, addresses[1])[14:]


def _ipv4(row: _Row) -> bytes:
    src, dst = row.ip_src_lo.to_bytes(4, "big"), row.ip_dst_lo.to_bytes(4, "big")
    ident, room = row.time_us & 0xFFFF, row.length - 34
    if row.ip_proto == ICMP:
        body = _icmp(row, src, dst, room)
    elif row.ip_proto == TCP:
        body = _tcp(row, src, dst, room)
    elif row.ip_proto == UDP:
        body = _udp(row, src, dst, room)
    else:
        body = b"\x11\0\xee\xff\0\0\0\0"  # IGMP: membership query
    return frames.ipv4(src, dst, row.ip_proto, body, ident=ident)


def _tcp(row: _Row, src: bytes, dst: bytes, room: int) -> bytes:
    """A SYN has options in its room, a 60-byte frame padding behind the header, others a payload."""
    is_syn = row.tcp_flags & frames.SYN
    options = frames.syn_options(min(room - 20, 40) & ~3) if is_syn and room >= 24 else b""
    payload = bytes(max(room - 20, 0)) if not is_syn and row.length > frames.MIN_FRAME else b""
    if not is_syn and room >= 32:  # time stamps, as in every segment behind a SYN that offers them
        options, payload = b"\1\1\x08\x0a" + bytes(8), payload[:-12]
    return frames.tcp(
        src,
        dst,
        row.tcp_sport,
        row.tcp_dport,
        row.tcp_flags,
        seq=row.tcp_seq,
        ack=row.tcp_ack,
        options=options,
        payload=payload,
    )


def _udp(row: _Row, src: bytes, dst: bytes, room: int) -> bytes:
    size = room - 8 if row.length > frames.MIN_FRAME else 0
    return frames.udp(src, dst, row.udp_sport, row.udp_dport, bytes(max(size, 0)))


def _icmp(row: _Row, src: bytes, dst: bytes, room: int) -> bytes:
    if not row.quoted:
        return frames.icmp(row.icmp_type, max(row.icmp_code, 0), b"\0\1\0\1", bytes(max(room - 8, 0)))
    inner_room = room - 28
    if row.tcp_sport >= 0:
        proto, inner = TCP, frames.tcp(dst, src, row.tcp_sport, row.tcp_dport, frames.SYN)
    else:
        proto, inner = UDP, frames.udp(dst, src, row.udp_sport, row.udp_dport, bytes(max(inner_room - 8, 0)))
    quoted = frames.ipv4(dst, src, proto, inner[: max(inner_room, 8)])
    return frames.icmp(row.icmp_type, max(row.icmp_code, 0), bytes(4), quoted)


def _ipv6(row: _Row) -> bytes:
    src = row.ip_src_hi.to_bytes(8, "big") + row.ip_src_lo.to_bytes(8, "big")
    dst = row.ip_dst_hi.to_bytes(8, "big") + row.ip_dst_lo.to_bytes(8, "big")
    room = row.length - 54
    if row.ip_proto == UDP:
        body = frames.udp(src, dst, row.udp_sport, row.udp_dport, bytes(max(room - 8, 0)))
        return frames.ipv6(src, dst, UDP, body)
    body = frames.icmp6(src, dst, row.icmp6_type, max(row.icmp6_code, 0), bytes(max(room - 4, 0)))
    return frames.ipv6(src, dst, ICMP6, body, hops=255)
