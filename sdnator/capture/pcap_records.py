"""The records of pcap and pcapng, out of a stream of bytes; and the stream behind a gzip header.

Pure readers: they take an open binary stream and yield frames.  If the stream ends in the middle of a
record, or a record is invalid, they raise `Damage` with the offset of that record.

Sources: IETF draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng; RFC 1952 (gzip).
"""

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

LINK_ETHERNET = 1
MAX_FRAME = 262_144
"""The largest snapshot length that libpcap accepts, in bytes."""
MAX_BLOCK = 1 << 24
"""The largest pcapng block taken for sound; name tables and secrets stay far below it."""
MAX_INTERFACES = 4_096
"""Interfaces of one pcapng section, at most."""
MAX_TIME_NS = 1 << 62
"""Later times (from the year 2116 on) are taken for damage; sums of them would not fit into 64 bits."""
MAX_RATIO = 500
"""Unpacked bytes for each packed one, from `BOMB_BYTES` on; real captures stay below 100."""
BOMB_BYTES = 1 << 28

PCAP_MAGICS = {
    b"\xa1\xb2\xc3\xd4": (">", 1_000),
    b"\xd4\xc3\xb2\xa1": ("<", 1_000),
    b"\xa1\xb2\x3c\x4d": (">", 1),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
}
"""First four bytes to (byte order, nanoseconds a tick)."""
PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
GZIP_MAGIC = b"\x1f\x8b"

_SECTION, _INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _PACKET = 0x0A0D0D0A, 1, 2, 3, 6
_OPTION_RESOLUTION, _OPTION_OFFSET = 9, 14
_NS = 1_000_000_000


class CapturedFrame(NamedTuple):
    """A frame of a capture: absolute time in ns (UTC), length on the wire, and the bytes captured."""

    time_ns: int
    length: int
    data: bytes


class Damage(Exception):
    """The record at `offset` (bytes from the start of the unpacked capture) is not whole."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset = offset
        self.reason = reason


class WrongLink(Exception):
    """Frames are of another link type than Ethernet."""

    def __init__(self, link: int) -> None:
        super().__init__(f"link type {link}")
        self.link = link


class GunzipStream(io.RawIOBase):
    """Content of a gzip file, member after member; damage reads as the end of file, with its reason in `fault`.

    The standard library's reader discards up to a megabyte of valid data if the file is cut.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._unpacker = zlib.decompressobj(wbits=31)
        self._fresh = True
        self._rest = b""
        """Read from the file, but belonging to the next member."""
        self.fault = ""
        self.delivered = 0
        """Unpacked bytes handed out so far."""
        self._packed = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        data = self._next(len(buffer))
        buffer[: len(data)] = data
        self.delivered += len(data)
        return len(data)

    def _next(self, size: int) -> bytes:
        while not self.fault:
            packed = self._unpacker.unconsumed_tail or self._rest
            if not packed:
                packed = self._file.read(65_536)
                self._packed += len(packed)
            self._rest = b""
            if self.delivered > max(BOMB_BYTES, self._packed * MAX_RATIO):
                self.fault = (
                    f"the gzip stream unpacks to more than {MAX_RATIO} times its size, as no capture does"
                )
                return b""
            if not packed:
                self.fault = "" if self._fresh else "the gzip stream ends too early"
                return b""
            try:
                data = self._unpacker.decompress(packed, size)
            except zlib.error:
                self.fault = "the gzip stream is damaged"
                return b""
            self._fresh = False
            if self._unpacker.eof:
                self._start_member()
            if data:
                return data
        return b""

    def _start_member(self) -> None:
        self._rest = self._unpacker.unused_data.lstrip(b"\0")  # tape blocks are padded with zeros
        self._unpacker = zlib.decompressobj(wbits=31)
        self._fresh = True


def read_pcap(stream: BinaryIO, magic: bytes) -> Iterator[CapturedFrame]:
    """Frames of a pcap file whose first four bytes were `magic` and are already read."""
    order, tick = PCAP_MAGICS[magic]
    header = stream.read(20)
    if len(header) < 20:
        raise Damage(0, "the file header is incomplete")
    link = struct.unpack(f"{order}16xI", header)[0] & 0xFFFF
    if link != LINK_ETHERNET:
        raise WrongLink(link)
    record = struct.Struct(f"{order}4I")
    read, unpack = stream.read, record.unpack
    offset = 24
    while head := read(16):
        if len(head) < 16:
            raise Damage(offset, "the header of a packet is incomplete")
        seconds, fraction, captured, length = unpack(head)
        if captured > MAX_FRAME or length > MAX_FRAME:
            raise Damage(
                offset, f"a packet of {max(captured, length)} bytes is announced, more than any capture holds"
            )
        data = read(captured)
        if len(data) < captured:
            raise Damage(offset, f"a packet has {len(data)} of its {captured} bytes")
        yield CapturedFrame(seconds * _NS + fraction * tick, max(length, captured), data)
        offset += 16 + captured


@dataclass(frozen=True)
class _Interface:
    link: int
    snap_length: int
    ticks_per_second: int
    offset_ns: int

    def time_ns(self, high: int, low: int) -> int:
        return ((high << 32) | low) * _NS // self.ticks_per_second + self.offset_ns


def read_pcapng(stream: BinaryIO) -> Iterator[CapturedFrame]:
    """Frames of a pcapng file whose first four bytes were `PCAPNG_MAGIC` and are already read."""
    section = _Section(_section_order(stream.read(8), 0))
    kind, head, offset = _SECTION, section.head, 0
    last_ns = 0
    while True:
        size, body = _block(stream, head, section.order, offset)
        if kind == _INTERFACE:
            section.add_interface(body, offset)
        elif kind in (_PACKET, _OLD_PACKET, _SIMPLE_PACKET):
            frame = section.frame(kind, body, offset, last_ns)
            last_ns = frame.time_ns
            yield frame
        offset += size
        start = stream.read(12)
        if not start:
            return
        if len(start) < 12:
            raise Damage(offset, "the header of a block is incomplete")
        if start[:4] == PCAPNG_MAGIC:
            section = _Section(_section_order(start[4:], offset))
            kind, head = _SECTION, section.head
        else:
            kind, head = struct.unpack(f"{section.order}I", start[:4])[0], start[4:]


def _section_order(head: bytes, offset: int) -> tuple[str, bytes]:
    orders = {b"\x1a\x2b\x3c\x4d": ">", b"\x4d\x3c\x2b\x1a": "<"}
    if len(head) < 8 or head[4:] not in orders:
        raise Damage(offset, "a section header is incomplete")
    return orders[head[4:]], head


def _block(stream: BinaryIO, head: bytes, order: str, offset: int) -> tuple[int, bytes]:
    """Length of the block and its body; `head` is its length field and the four bytes behind it."""
    (size,) = struct.unpack(f"{order}I", head[:4])
    if size < 12 or size % 4 or size > MAX_BLOCK:
        raise Damage(offset, f"a block of {size} bytes is announced, which is impossible")
    if size == 12:
        body, tail = b"", head[4:]
    else:
        rest = stream.read(size - 12)
        body, tail = head[4:] + rest[:-4], rest[-4:]
        if len(rest) < size - 12:
            raise Damage(offset, f"a block has {12 + len(rest)} of its {size} bytes")
    if tail != head[:4]:
        raise Damage(offset, "the two lengths of a block differ")
    return size, body


class _Section:
    """State of a section: byte order and interfaces."""

    def __init__(self, order_and_head: tuple[str, bytes]) -> None:
        self.order, self.head = order_and_head
        self.interfaces: list[_Interface] = []

    def add_interface(self, body: bytes, offset: int) -> None:
        if len(self.interfaces) >= MAX_INTERFACES:
            raise Damage(offset, f"more than {MAX_INTERFACES:,} interfaces are described")
        if len(body) < 8:
            raise Damage(offset, "the description of an interface is incomplete")
        link, snap_length = struct.unpack(f"{self.order}H2xI", body[:8])
        ticks, seconds = 1_000_000, 0
        for code, value in self._options(body[8:]):
            if code == _OPTION_RESOLUTION and len(value) == 1:
                ticks = (2 if value[0] & 0x80 else 10) ** (value[0] & 0x7F)
            elif code == _OPTION_OFFSET and len(value) == 8:
                (seconds,) = struct.unpack(f"{self.order}q", value)
        self.interfaces.append(_Interface(link, snap_length or MAX_FRAME, ticks, seconds * _NS))

    def _options(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        at = 0
        while at + 4 <= len(data):
            code, length = struct.unpack_from(f"{self.order}2H", data, at)
            if code == 0:
                return
            yield code, data[at + 4 : at + 4 + length]
            at += 4 + length + (-length % 4)

    def frame(self, kind: int, body: bytes, offset: int, last_ns: int) -> CapturedFrame:
        layout = {_PACKET: "5I", _OLD_PACKET: "H2x4I", _SIMPLE_PACKET: "I"}[kind]
        start = struct.calcsize(f"{self.order}{layout}")
        if len(body) < start:
            raise Damage(offset, "the header of a packet is incomplete")
        fields = struct.unpack_from(f"{self.order}{layout}", body)
        interface = self._interface(0 if kind == _SIMPLE_PACKET else fields[0], offset)
        if kind == _SIMPLE_PACKET:  # carries no time: that of the packet before it
            captured, length, time_ns = min(fields[0], interface.snap_length), fields[0], last_ns
        else:
            _, high, low, captured, length = fields
            time_ns = interface.time_ns(high, low)
            if not 0 <= time_ns < MAX_TIME_NS:
                raise Damage(offset, "the time of a packet is out of range")
        if captured > MAX_FRAME or length > MAX_FRAME:
            raise Damage(
                offset, f"a packet of {max(captured, length)} bytes is announced, more than any capture holds"
            )
        if captured > len(body) - start:
            raise Damage(offset, f"a packet has {len(body) - start} of its {captured} bytes")
        return CapturedFrame(time_ns, max(length, captured), body[start : start + captured])

    def _interface(self, number: int, offset: int) -> _Interface:
        if number >= len(self.interfaces):
            raise Damage(offset, f"a packet names interface {number}, which the capture does not describe")
        interface = self.interfaces[number]
        if interface.link != LINK_ETHERNET:
            raise WrongLink(interface.link)
        return interface
