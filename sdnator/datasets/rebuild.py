"""Frames from tshark's table: what the table says is in them, the rest is the likeliest.

A reader of headers finds in the rebuilt frames exactly the columns of the table, so a detector's
features are equal.  Not in the table, and therefore guessed: TCP flags (a bare header of SYN size is
a SYN, anything else an ACK), payloads (zeros), identifications, ICMPv6 types.  Times are exact: the
capture is written with µs where that is enough, with ns else.

    RebuildError (TsvError)     a row that no frame can stand for, with its line
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

from sdnator.capture.captures import CaptureWriter
from sdnator.capture.tshark_tsv import TYPE_LOOPBACK, TsharkRow, TsvError, read_rows
from sdnator.datasets import frames

_STP_GROUP = 0x0180C2000000
_STP, _CDP = b"\x42\x42\x03", b"\xaa\xaa\x03\x00\x00\x0c\x20\x00"
_ALL_NODES = 0xFF02_0000_0000_0000_0000_0000_0000_0001
_SOLICITED = 0xFF02_0000_0000_0000_0000_0001_FF00_0000 >> 24
_NEIGHBOUR_ADVERT, _NEIGHBOUR_SOLICIT, _ROUTER_ADVERT = 136, 135, 134


class RebuildError(TsvError):
    """A row that no frame can stand for."""


@dataclass(frozen=True)
class Rebuilt:
    """What became of a table."""

    packets: int
    nanoseconds: bool
    """Times needed nanoseconds."""


def rebuild(
    table: str | os.PathLike[str],
    out: str | os.PathLike[str],
    progress: Callable[[int], None] = lambda _: None,
) -> Rebuilt:
    """Write the capture of a table; the file appears only when it is whole.

    Args:
        table: TSV of 19 columns, plain or gzipped.
        out: pcap to write (gzipped when it ends in `.gz`).
        progress: called with the number of packets written so far.

    Raises:
        TsvError: `MissingTsv`, `MalformedTsv` or `RebuildError`, with the line.
        OSError: `out` cannot be written.
    """
    nanoseconds = any(row.time_ns % 1_000 for row in read_rows(table))
    with CaptureWriter(out, nanoseconds=nanoseconds) as writer:
        for row in read_rows(table):
            writer.write(row.time_ns, frame(row))
            if writer.packets % 1_000 == 0:
                progress(writer.packets)
    progress(writer.packets)
    return Rebuilt(writer.packets, nanoseconds)


def frame(row: TsharkRow) -> bytes:
    """The frame of a row, as long as it was on the wire.

    Raises:
        RebuildError: the row's columns exclude each other, or its length is too short for them.
    """
    if row.eth_src < 0 or row.eth_dst < 0:
        raise RebuildError(f"line {row.line:,}: no Ethernet addresses; only Ethernet captures can be rebuilt")
    if row.tcp_sport >= 0 and row.udp_sport >= 0:
        raise RebuildError(f"line {row.line:,}: TCP and UDP ports at once; leave the row out of the table")
    build = _builder(row)
    head = frames.ethernet(_mac(row.eth_dst), _mac(row.eth_src), row.eth_type, b"")
    payload = build(row) if row.length >= len(head) else b""
    if len(payload) + len(head) > row.length:
        raise RebuildError(
            f"line {row.line:,}: {row.length} bytes are too few for the fields of this packet "
            f"({len(payload) + len(head)}); leave the row out of the table"
        )
    if row.eth_type == 0:  # 802.3: a length where Ethernet has its type
        head = head[:12] + min(row.length - 14, 1_500).to_bytes(2, "big")
    return frames.pad(head + payload, row.length)


def _builder(row: TsharkRow) -> Callable[[TsharkRow], bytes]:
    if row.arp_op >= 0:
        return _arp
    if row.ip_version == 4:
        return _ipv4
    if row.ip_version == 6:
        return _ipv6
    return _other


def _mac(value: int) -> bytes:
    return value.to_bytes(6, "big")


def _arp(row: TsharkRow) -> bytes:
    macs = [_mac(max(value, 0)) for value in (row.arp_src_mac, row.arp_dst_mac)]
    ips = [max(value, 0).to_bytes(4, "big") for value in (row.arp_src_ip, row.arp_dst_ip)]
    return frames.arp(row.arp_op, macs[0], ips[0], macs[1], ips[1])[14:]


def _other(row: TsharkRow) -> bytes:
    if row.eth_type == TYPE_LOOPBACK:
        return b"\0\0\1\0"
    return _STP if row.eth_dst == _STP_GROUP else _CDP


def _ipv4(row: TsharkRow) -> bytes:
    src, dst = row.ip_src.to_bytes(4, "big"), row.ip_dst.to_bytes(4, "big")
    room = row.length - 34
    if row.icmp_type >= 0:
        body = _icmp(row, src, dst, room)
        return frames.ipv4(src, dst, frames.ICMP, body)
    if row.tcp_sport >= 0:
        return frames.ipv4(src, dst, frames.TCP, _tcp(row, src, dst, room))
    if row.udp_sport >= 0:
        return frames.ipv4(src, dst, frames.UDP, _udp(row, src, dst, room))
    return frames.ipv4(src, dst, row.ip_proto, bytes(max(room, 0)))


def _tcp(row: TsharkRow, src: bytes, dst: bytes, room: int) -> bytes:
    ports = (row.tcp_sport, row.tcp_dport)
    if row.length == frames.MIN_FRAME:  # six bytes of it are options or padding
        return frames.tcp(src, dst, *ports, frames.SYN, options=frames.syn_options(4))
    if 24 <= room <= 60 and room % 4 == 0:
        return frames.tcp(src, dst, *ports, frames.SYN, options=frames.syn_options(room - 20))
    return frames.tcp(src, dst, *ports, frames.ACK, payload=bytes(max(room - 20, 0)))


def _udp(row: TsharkRow, src: bytes, dst: bytes, room: int) -> bytes:
    return frames.udp(src, dst, row.udp_sport, row.udp_dport, bytes(max(room - 8, 0)))


def _icmp(row: TsharkRow, src: bytes, dst: bytes, room: int) -> bytes:
    if not row.quoted:
        return frames.icmp(row.icmp_type, max(row.icmp_code, 0), b"\0\1\0\1", bytes(max(room - 8, 0)))
    quoted_room = room - 28
    if row.tcp_sport >= 0:
        proto, ports = frames.TCP, (row.tcp_sport, row.tcp_dport)
        options = max(min(quoted_room - 20, 40), 0) & ~3
        inner = frames.tcp(dst, src, *ports, frames.SYN, options=frames.syn_options(options))
    else:
        proto, ports = frames.UDP, (row.udp_sport, row.udp_dport)
        inner = frames.udp(dst, src, *ports, bytes(max(quoted_room - 8, 0)))
    quoted = frames.ipv4(dst, src, proto, inner)[: max(room - 8, 28)]
    return frames.icmp(row.icmp_type, max(row.icmp_code, 0), bytes(4), quoted)


def _ipv6(row: TsharkRow) -> bytes:
    src, dst = row.ip_src.to_bytes(16, "big"), row.ip_dst.to_bytes(16, "big")
    room = row.length - 54
    if row.tcp_sport >= 0:
        return frames.ipv6(src, dst, frames.TCP, _tcp(row, src, dst, room))
    if row.udp_sport >= 0:
        return frames.ipv6(src, dst, frames.UDP, _udp(row, src, dst, room))
    kind = _neighbour_discovery(row.ip_dst, room)
    return frames.ipv6(
        src, dst, frames.ICMP6, frames.icmp6(src, dst, kind, 0, bytes(max(room - 4, 0))), hops=255
    )


def _neighbour_discovery(dst: int, room: int) -> int:
    if dst >> 24 == _SOLICITED:
        return _NEIGHBOUR_SOLICIT
    return _ROUTER_ADVERT if dst == _ALL_NODES and room > 32 else _NEIGHBOUR_ADVERT
