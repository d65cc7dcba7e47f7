"""One Ethernet frame read the obvious way, byte after byte; the twin of `apps.packets.read_frames`."""

import struct

EXTENSIONS = (0, 43, 44, 51, 60)


def number(data, at, width):
    """A big-endian number, or None when the bytes are not all there."""
    if at + width > len(data):
        return None
    return int.from_bytes(data[at : at + width], "big")


def read_frame(frame):  # noqa: C901 - read from top to bottom
    """The columns of one frame that are not absent, as a dict."""
    row = {}
    for name, at in (("eth_dst", 0), ("eth_src", 6)):
        if number(frame, at, 6) is not None:
            row[name] = number(frame, at, 6)
    if len(frame) < 14:
        return row
    kind, at = number(frame, 12, 2), 14
    for depth in range(2):
        if kind not in (0x8100, 0x88A8, 0x9100) or at + 4 > len(frame):
            break
        if depth == 0:
            row["vlan"] = number(frame, at, 2) % 4096
        kind, at = number(frame, at + 2, 2), at + 4
    row["eth_type"] = 0 if kind <= 1500 else kind
    if kind <= 1500 and frame[at : at + 6] == bytes.fromhex("aaaa03000000") and at + 8 <= len(frame):
        frame = frame[: at + kind]
        kind, at = number(frame.ljust(at + 8, b"\0"), at + 6, 2) if at + 8 <= len(frame) else None, at + 8
    if kind == 0x0806:
        read_arp(row, frame[at:])
    elif kind == 0x0800:
        read_outer(row, ipv4(frame[at:]), 4)
    elif kind == 0x86DD:
        read_outer(row, ipv6(frame[at:]), 6)
    return row


def read_arp(row, data):
    if len(data) < 28:
        return
    hardware, protocol, sizes, operation = struct.unpack(">HHHH", data[:8])
    if hardware in (1, 6) and protocol == 0x0800 and sizes == 0x0604:
        row["arp_op"] = operation
        row["arp_src_mac"], row["arp_src_ip"] = number(data, 8, 6), number(data, 14, 4)
        row["arp_dst_mac"], row["arp_dst_ip"] = number(data, 18, 6), number(data, 24, 4)


def ipv4(data):
    """Addresses, protocol and payload; None for what is no IPv4."""
    if len(data) < 20 or data[0] >> 4 != 4:
        return None
    header, total = data[0] % 16 * 4, number(data, 2, 2)
    if header < 20 or 0 < total < header:
        return None
    source, destination = number(data, 12, 4), number(data, 16, 4)
    payload = data[header:total] if total else data[header:]
    if number(data, 6, 2) % 8192:
        payload = b""
    return (0, source), (0, destination), data[9], payload


def ipv6(data):
    if len(data) < 40 or data[0] >> 4 != 6:
        return None
    source = number(data, 8, 8), number(data, 16, 8)
    destination = number(data, 24, 8), number(data, 32, 8)
    size, kind = number(data, 4, 2), data[6]
    payload = data[40 : 40 + size] if size else data[40:]
    for _ in range(3):
        if kind not in EXTENSIONS or len(payload) < 8:
            break
        later = kind == 44 and number(payload, 2, 2) // 8
        length = {44: 8, 51: (payload[1] + 2) * 4}.get(kind, (payload[1] + 1) * 8)
        kind, payload = payload[0], b"" if later else payload[length:]
    return source, destination, kind, payload


def ports(row, protocol, payload):
    name = {6: "tcp", 17: "udp", 136: "udp"}.get(protocol)
    if name and len(payload) >= 4:
        row[f"{name}_sport"], row[f"{name}_dport"] = number(payload, 0, 2), number(payload, 2, 2)
        return True
    return False


def read_outer(row, packet, version):
    if packet is None:
        return
    source, destination, protocol, payload = packet
    row["ip_version"], row["ip_proto"] = version, protocol
    row["ip_src_hi"], row["ip_src_lo"] = source
    row["ip_dst_hi"], row["ip_dst_lo"] = destination
    ports(row, protocol, payload)
    if protocol == 6 and len(payload) >= 14:
        row["tcp_seq"], row["tcp_ack"], row["tcp_flags"] = (
            number(payload, 4, 4),
            number(payload, 8, 4),
            payload[13],
        )
    for wanted, name, errors, header in (
        (1, "icmp", (3, 4, 5, 11, 12), ipv4),
        (58, "icmp6", (1, 2, 3, 4), ipv6),
    ):
        if protocol == wanted and len(payload) >= 2:
            row[f"{name}_type"], row[f"{name}_code"] = payload[0], payload[1]
            quoted = header(payload[8:]) if payload[0] in errors else None
            if quoted is not None and ports(row, quoted[2], quoted[3]):
                row["quoted"] = 1
