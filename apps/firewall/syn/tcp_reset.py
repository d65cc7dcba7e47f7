"""The frame that ends a half-open connection at its server: a bare RST, as the client could have sent it.

A server in SYN-RECEIVED accepts a RST with the sequence number that it expects next, the client's
first number plus one.  Its own SYN-ACK acknowledges just that number.  Source: RFC 9293, 3.10.7.4.
"""

import struct
from typing import Final, NamedTuple

_RST: Final = 0x04
_TCP: Final = 6
_HOPS: Final = 64
_NO_WINDOW: Final = 0
_VLAN, _IPV4, _IPV6 = 0x8100, 0x0800, 0x86DD


class HalfOpen(NamedTuple):
    """A half-open connection at a server; addresses as integers."""

    version: int
    """IP version, 4 or 6."""
    client: int
    client_port: int
    server: int
    server_port: int
    expected: int
    """The client's next sequence number, as the server acknowledged it."""
    client_mac: int
    server_mac: int
    vlan: int
    """VLAN id; -1: untagged."""
    port: int
    """Port of the switch behind which the server is."""


def reset_frame(half: HalfOpen) -> bytes:
    """The whole Ethernet frame, to be sent out of `half.port`."""
    size = 4 if half.version == 4 else 16
    client, server = half.client.to_bytes(size, "big"), half.server.to_bytes(size, "big")
    segment = struct.pack(
        ">HHIIBBHHH", half.client_port, half.server_port, half.expected, 0, 5 << 4, _RST, _NO_WINDOW, 0, 0
    )
    pseudo = client + server + struct.pack(">II", len(segment), _TCP)
    segment = segment[:16] + struct.pack(">H", _checksum(pseudo + segment)) + segment[18:]
    ethernet = half.server_mac.to_bytes(6, "big") + half.client_mac.to_bytes(6, "big")
    if half.vlan >= 0:
        ethernet += struct.pack(">HH", _VLAN, half.vlan)
    if half.version == 6:
        header = struct.pack(">IHBB", 6 << 28, len(segment), _TCP, _HOPS) + client + server
        return ethernet + struct.pack(">H", _IPV6) + header + segment
    header = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(segment), 0, 0x4000, _HOPS, _TCP, 0) + client + server
    header = header[:10] + struct.pack(">H", _checksum(header)) + header[12:]
    return ethernet + struct.pack(">H", _IPV4) + header + segment


def _checksum(data: bytes) -> int:
    """The Internet checksum (RFC 1071) of an even number of bytes."""
    total: int = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return total ^ 0xFFFF
