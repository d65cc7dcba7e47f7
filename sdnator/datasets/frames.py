"""Frames from their fields: Ethernet, ARP, IPv4, IPv6, UDP, TCP, ICMP and what an ICMP error quotes.

Addresses are bytes in network order.  `pad` zero-fills a frame to its length on the wire; a payload
given as a number is that many zero bytes, which no checksum needs to see.

Sources: RFC 791, 792, 768, 826, 9293, 8200, 4443, 4861; checksum as in RFC 1071.
"""

import struct
from typing import Final

BROADCAST: Final = b"\xff" * 6
TYPE_IPV4, TYPE_ARP, TYPE_IPV6, TYPE_LOOPBACK = 0x0800, 0x0806, 0x86DD, 0x9000
ICMP, IGMP, TCP, UDP, ICMP6 = 1, 2, 6, 17, 58
FIN, SYN, RST, PSH, ACK = 0x01, 0x02, 0x04, 0x08, 0x10
MIN_FRAME: Final = 60
"""Shortest Ethernet frame as captures show it, without the check sequence."""

_LINUX_SYN: Final = bytes.fromhex("020405b4 0402 080a0000000100000000 01 030307")
"""Segment size, selective acknowledgement, time stamps, window scale."""

_IPV4 = struct.Struct("!BBHHHBBH4s4s")
_TCP = struct.Struct("!HHIIBBHHH")
_ARP = struct.Struct("!HHBBH6s4s6s4s")


def checksum(data: bytes) -> int:
    """The Internet checksum; one modulo instead of a loop, since 2**16 is 1 modulo 0xFFFF."""
    value = int.from_bytes(data + b"\0" if len(data) & 1 else data, "big")
    rest = value % 0xFFFF
    return 0xFFFF - rest if rest or not value else 0


def pad(frame: bytes, length: int = MIN_FRAME) -> bytes:
    """The frame on the wire, zero-filled to `length` bytes."""
    return frame.ljust(length, b"\0")


def ethernet(dst: bytes, src: bytes, kind: int, payload: bytes) -> bytes:
    return dst + src + kind.to_bytes(2, "big") + payload


def arp(op: int, src_mac: bytes, src_ip: bytes, dst_mac: bytes, dst_ip: bytes, *, to: bytes = b"") -> bytes:
    """A whole frame, unpadded; a request (op 1) goes to everybody unless `to` says otherwise."""
    body = _ARP.pack(1, TYPE_IPV4, 6, 4, op, src_mac, src_ip, dst_mac, dst_ip)
    return ethernet(to or (BROADCAST if op == 1 else dst_mac), src_mac, TYPE_ARP, body)


def ipv4(
    src: bytes, dst: bytes, proto: int, payload: bytes, *, ident: int = 0, ttl: int = 64, more: int = 0
) -> bytes:
    """Header and payload; `more` counts bytes of the payload that are not given (zeros, or cut off)."""
    length = 20 + len(payload) + more
    head = _IPV4.pack(0x45, 0, length, ident, 0x4000, ttl, proto, 0, src, dst)
    return head[:10] + checksum(head).to_bytes(2, "big") + head[12:] + payload


def ipv6(src: bytes, dst: bytes, proto: int, payload: bytes, *, hops: int = 64) -> bytes:
    return struct.pack("!IHBB", 0x6000_0000, len(payload), proto, hops) + src + dst + payload


def _pseudo(src: bytes, dst: bytes, proto: int, length: int) -> bytes:
    """The pseudo header that TCP, UDP and ICMPv6 checksums cover; zeros between do not count."""
    return src + dst + struct.pack("!II", length, proto)


def udp(src: bytes, dst: bytes, sport: int, dport: int, payload: bytes, *, more: int = 0) -> bytes:
    """Header and payload of a datagram from address `src` to `dst` (4 or 16 bytes each)."""
    length = 8 + len(payload) + more
    head = struct.pack("!HHH", sport, dport, length)
    total = checksum(_pseudo(src, dst, UDP, length) + head + payload) or 0xFFFF
    return head + total.to_bytes(2, "big") + payload


def tcp(
    src: bytes,
    dst: bytes,
    sport: int,
    dport: int,
    flags: int,
    *,
    seq: int = 0,
    ack: int = 0,
    options: bytes = b"",
    payload: bytes = b"",
    more: int = 0,
    window: int = 5_840,
) -> bytes:
    """Header, options (a multiple of four bytes) and payload of a segment."""
    offset = (20 + len(options)) << 2
    head = _TCP.pack(sport, dport, seq, ack, offset, flags, window, 0, 0) + options + payload
    total = checksum(_pseudo(src, dst, TCP, len(head) + more) + head)
    return head[:16] + total.to_bytes(2, "big") + head[18:]


def syn_options(size: int) -> bytes:
    """Options of a SYN in `size` bytes (a multiple of four, at most 40): as Linux sends them where 20 fit."""
    chosen = _LINUX_SYN if size >= len(_LINUX_SYN) else _LINUX_SYN[:4] if size >= 4 else b""
    return chosen.ljust(size, b"\0")


def icmp(kind: int, code: int, rest: bytes, payload: bytes = b"") -> bytes:
    """`rest` is the second word: identifier and sequence number of an echo, unused in an error."""
    body = bytes((kind, code, 0, 0)) + rest + payload
    return body[:2] + checksum(body).to_bytes(2, "big") + body[4:]


def icmp6(src: bytes, dst: bytes, kind: int, code: int, body: bytes) -> bytes:
    message = bytes((kind, code, 0, 0)) + body
    total = checksum(_pseudo(src, dst, ICMP6, len(message)) + message)
    return message[:2] + total.to_bytes(2, "big") + message[4:]


def llc(dst: bytes, src: bytes, payload: bytes) -> bytes:
    """An 802.3 frame: a length where Ethernet has its type."""
    return ethernet(dst, src, len(payload), payload)
