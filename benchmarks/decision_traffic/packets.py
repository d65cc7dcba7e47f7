"""Packets of each protocol, many at a time, written on a tape.

Lengths are bytes on the wire without the check sequence, never below 60.  `attack` is the id of the attack
that sends them, 0 for benign ones.
"""

from typing import Final

import numpy as np

from benchmarks.decision_traffic.hosts import BROADCAST_MAC, Ends
from benchmarks.decision_traffic.traffic import Column, Ints, Tape

FIN, SYN, RST, PSH, ACK = 1, 2, 4, 8, 16
ICMP, TCP, UDP, IGMP, ICMP6 = 1, 6, 17, 2, 58
IPV4, ARP_TYPE, IPV6 = 0x0800, 0x0806, 0x86DD
UNREACHABLE: Final = 3
NET, HOST, PORT, ADMIN = 0, 1, 3, 13
"""Codes of ICMP unreachable."""
_MIN: Final = 60
_QUOTED_MOST: Final = 590
"""An ICMP error is at most 576 bytes of IP (RFC 1812)."""


def _ip(src: Ends, dst: Ends, proto: int, length: Column) -> dict[str, Column]:
    return {
        "port": src.port,
        "eth_src": src.mac,
        "eth_dst": dst.mac,
        "eth_type": IPV4,
        "ip_version": 4,
        "ip_src_lo": src.ip,
        "ip_dst_lo": dst.ip,
        "ip_proto": proto,
        "length": np.maximum(length, _MIN),
    }


def tcp(
    tape: Tape,
    time: Ints,
    src: Ends,
    dst: Ends,
    *,
    sport: Column,
    dport: Column,
    flags: Column,
    seq: Column = 0,
    ack: Column = 0,
    length: Column = 60,
    attack: Column = 0,
) -> None:
    """Segments; `seq` and `ack` are taken modulo 2**32."""
    tape.add(
        time,
        attack=attack,
        **_ip(src, dst, TCP, length),
        tcp_sport=sport,
        tcp_dport=dport,
        tcp_flags=flags,
        tcp_seq=np.bitwise_and(seq, 0xFFFF_FFFF),
        tcp_ack=np.bitwise_and(ack, 0xFFFF_FFFF),
    )


def udp(
    tape: Tape,
    time: Ints,
    src: Ends,
    dst: Ends,
    *,
    sport: Column,
    dport: Column,
    payload: Column,
    attack: Column = 0,
) -> None:
    """Datagrams with `payload` bytes."""
    length = np.add(payload, 42)
    tape.add(time, attack=attack, **_ip(src, dst, UDP, length), udp_sport=sport, udp_dport=dport)


def echo(
    tape: Tape, time: Ints, src: Ends, dst: Ends, *, reply: bool, length: Column = 98, attack: Column = 0
) -> None:
    """Pings, or replies to them."""
    kind = 0 if reply else 8
    tape.add(time, attack=attack, **_ip(src, dst, ICMP, length), icmp_type=kind, icmp_code=0)


def unreachable(
    tape: Tape,
    time: Ints,
    src: Ends,
    dst: Ends,
    *,
    code: int,
    proto: int,
    sport: Column,
    dport: Column,
    length: Column,
) -> None:
    """ICMP errors from `src` about packets of `dst` that had these ports and this `length`; they quote them."""
    name = "udp" if proto == UDP else "tcp"
    ports = {f"{name}_sport": sport, f"{name}_dport": dport}
    quoting = np.minimum(np.add(length, 28), _QUOTED_MOST)
    tape.add(time, **_ip(src, dst, ICMP, quoting), **ports, quoted=1, icmp_type=UNREACHABLE, icmp_code=code)


def igmp(tape: Tape, time: Ints, src: Ends, dst: Ends, *, length: int = 60) -> None:
    """Queries and reports of multicast groups."""
    tape.add(time, **_ip(src, dst, IGMP, length))


def arp_request(
    tape: Tape,
    time: Ints,
    src: Ends,
    target_ip: Column,
    *,
    claimed_ip: Column | None = None,
    to: Column = BROADCAST_MAC,
    attack: Column = 0,
) -> None:
    """Who has `target_ip`; `claimed_ip` instead of the sender's own (0: a probe), `to` one host instead of all."""
    tape.add(
        time,
        attack=attack,
        port=src.port,
        eth_src=src.mac,
        eth_dst=to,
        eth_type=ARP_TYPE,
        length=_MIN,
        arp_op=1,
        arp_src_mac=src.mac,
        arp_src_ip=src.ip if claimed_ip is None else claimed_ip,
        arp_dst_mac=0,
        arp_dst_ip=target_ip,
    )


def arp_reply(
    tape: Tape, time: Ints, src: Ends, dst: Ends, *, claimed_ip: Column | None = None, attack: Column = 0
) -> None:
    """`src` (or `claimed_ip`) is at the MAC of `src`, told to `dst`."""
    tape.add(
        time,
        attack=attack,
        port=src.port,
        eth_src=src.mac,
        eth_dst=dst.mac,
        eth_type=ARP_TYPE,
        length=_MIN,
        arp_op=2,
        arp_src_mac=src.mac,
        arp_src_ip=src.ip if claimed_ip is None else claimed_ip,
        arp_dst_mac=dst.mac,
        arp_dst_ip=dst.ip,
    )


def raw(tape: Tape, time: Ints, src: Ends, to: int, *, kind: int = 0, length: Column = 60) -> None:
    """Frames that are neither IP nor ARP: spanning tree (kind 0), LLDP, loopback tests."""
    tape.add(time, port=src.port, eth_src=src.mac, eth_dst=to, eth_type=kind, length=length)


def link_local(mac: Ints) -> tuple[int, Column]:
    """The halves of the IPv6 link-local address of a MAC (EUI-64)."""
    head = np.bitwise_xor(mac >> 24, 0x020000)
    low = head << 40 | 0xFFFE << 24 | mac & 0xFFFFFF
    return 0xFE80 << 48, low.astype(np.uint64)


def neighbour(tape: Tape, time: Ints, src: Ends, *, kind: int = 135, length: int = 86) -> None:
    """ICMPv6 of neighbour discovery to all nodes."""
    high, low = link_local(src.mac)
    tape.add(
        time,
        port=src.port,
        eth_src=src.mac,
        eth_dst=0x333300000001,
        eth_type=IPV6,
        length=length,
        ip_version=6,
        ip_src_hi=high,
        ip_src_lo=low,
        ip_dst_hi=0xFF02 << 48,
        ip_dst_lo=1,
        ip_proto=ICMP6,
        icmp6_type=kind,
        icmp6_code=0,
    )


def mdns6(tape: Tape, time: Ints, src: Ends, *, payload: Column) -> None:
    """mDNS over IPv6."""
    high, low = link_local(src.mac)
    tape.add(
        time,
        port=src.port,
        eth_src=src.mac,
        eth_dst=0x3333000000FB,
        eth_type=IPV6,
        length=np.add(payload, 62),
        ip_version=6,
        ip_src_hi=high,
        ip_src_lo=low,
        ip_dst_hi=0xFF02 << 48,
        ip_dst_lo=0xFB,
        ip_proto=UDP,
        udp_sport=5353,
        udp_dport=5353,
    )
