"""The same three packets in every form of capture, and the blocks of which pcapng is made."""

import struct

T0 = 1_540_446_382_933_899_000
"""Capture time of the first packet, ns."""
FRAMES = [(T0, b"\x01" * 60), (T0 + 5_000, b"\x02" * 61), (T0 + 1_000_000_000, b"\x03" * 1500)]


def pcap(order: str, nano: bool) -> bytes:
    """The packets of FRAMES as pcap; `order` as of `struct`, `nano`: times in ns instead of µs."""
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    data = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
    for time, frame in FRAMES:
        fraction = time % 10**9 // (1 if nano else 1000)
        data += struct.pack(f"{order}4I", time // 10**9, fraction, len(frame), len(frame) + 7) + frame
    return data


def block(order: str, kind: int, body: bytes) -> bytes:
    """A pcapng block of any kind."""
    body += bytes(-len(body) % 4)
    size = struct.pack(f"{order}I", len(body) + 12)
    return struct.pack(f"{order}I", kind) + size + body + size


def section(order: str) -> bytes:
    """A section header."""
    return block(order, 0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))


def interface(order: str, resolution: int, link: int = 1) -> bytes:
    """An interface description; `resolution` is the negative power of ten of its clock, in s."""
    options = struct.pack(f"{order}HHB3xHH", 9, 1, resolution, 0, 0)
    return block(order, 1, struct.pack(f"{order}HHI", link, 0, 0) + options)


def packet(order: str, ticks: int, frame: bytes, interface: int = 0) -> bytes:
    """An enhanced packet block; the original length is 7 bytes more than `frame`."""
    head = struct.pack(f"{order}5I", interface, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame) + 7)
    return block(order, 6, head + frame)


def pcapng(order: str) -> bytes:
    """Two sections with different clocks, a block nobody knows, and an interface of ns behind one of µs."""
    first = section(order) + interface(order, 6) + packet(order, FRAMES[0][0] // 1000, FRAMES[0][1])
    unknown = block(order, 0xBAD, b"hello")
    second = interface(order, 9) + packet(order, FRAMES[1][0], FRAMES[1][1], 1)
    other = ">" if order == "<" else "<"
    third = section(other) + interface(other, 9) + packet(other, FRAMES[2][0], FRAMES[2][1])
    return first + unknown + second + third


CAPTURES = {
    "pcap-us-little": pcap("<", False),
    "pcap-us-big": pcap(">", False),
    "pcap-ns-little": pcap("<", True),
    "pcap-ns-big": pcap(">", True),
    "pcapng-little": pcapng("<"),
    "pcapng-big": pcapng(">"),
}
"""Name of the form to the content of the file."""
