"""Record readers at their edges: what the forms allow but hardly anybody writes."""

import gzip
import io
import struct

import pytest

from sdnator.capture.pcap_records import (
    PCAPNG_MAGIC,
    CapturedFrame,
    Damage,
    GunzipStream,
    WrongLink,
    read_pcap,
    read_pcapng,
)


def _block(kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size


SECTION = _block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))


def _interface(*options: tuple[int, bytes], link: int = 1) -> bytes:
    body = struct.pack("<HHI", link, 0, 0)
    for code, value in options:
        body += struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)
    return _block(1, body)


def _packet(ticks: int, data: bytes) -> bytes:
    return _block(6, struct.pack("<5I", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data)) + data)


def _read(data: bytes) -> list[CapturedFrame]:
    assert data[:4] == PCAPNG_MAGIC
    return list(read_pcapng(io.BytesIO(data[4:])))


def test_resolution_may_be_a_power_of_two():
    """0x8A = 2^10 ticks a second."""
    assert (
        _read(SECTION + _interface((9, b"\x8a")) + _packet(3 * 1024 + 512, b"x"))[0].time_ns == 3_500_000_000
    )


def test_time_offset_of_an_interface():
    data = SECTION + _interface((9, b"\x06"), (14, struct.pack("<q", 1_000_000_000))) + _packet(5, b"x")
    assert _read(data)[0].time_ns == 1_000_000_000_000_005_000


def test_options_end_at_the_end_mark():
    data = SECTION + _interface((0, b""), (9, b"\x09")) + _packet(5, b"x")
    assert _read(data)[0].time_ns == 5_000


@pytest.mark.parametrize(
    ("tail", "words"),
    [
        (b"\x01\x00\x00\x00" + b"\x0d\x00\x00\x00" + bytes(8), "which is impossible"),
        (b"\x01\x00\x00\x00" + b"\xff\xff\xff\x7f" + bytes(8), "which is impossible"),
        (b"\x01\x00\x00\x00" + b"\x14\x00\x00\x00" + bytes(12), "two lengths"),
        (b"\x01\x00\x00", "header of a block"),
        (_block(1, b"\1\0\0\0"), "description of an interface"),
        (_block(6, bytes(8)), "header of a packet"),
        (_block(6, struct.pack("<5I", 0, 0, 0, 99, 99)), "0 of its 99 bytes"),
        (b"\x0a\x0d\x0d\x0a" + bytes(8), "section header"),
    ],
)
def test_damaged_blocks(tail, words):
    """What is whole comes first, then the damage with its offset."""
    start = SECTION + _interface() + _packet(1, b"whole")
    reader = read_pcapng(io.BytesIO((start + tail)[4:]))
    assert next(reader).data == b"whole"
    with pytest.raises(Damage, match=words) as caught:
        next(reader)
    assert caught.value.offset == len(start)


def test_empty_blocks_and_zero_length_packets():
    found = _read(SECTION + _interface() + _block(0xB, b"") + _packet(1, b"") + _packet(2, b"y"))
    assert [frame.data for frame in found] == [b"", b"y"]


def test_wrong_link_in_pcap():
    header = struct.pack("<HHiIII", 2, 4, 0, 0, 65535, 101)
    with pytest.raises(WrongLink, match="101"):
        next(read_pcap(io.BytesIO(header), b"\xd4\xc3\xb2\xa1"))


def test_link_field_may_carry_flags():
    """The upper bits of pcap's link field say how long the check sequence is."""
    header = struct.pack("<HHiIII", 2, 4, 0, 0, 65535, 1 | 0x54000000)
    record = struct.pack("<4I", 1, 2, 1, 60) + b"x"
    assert next(read_pcap(io.BytesIO(header + record), b"\xd4\xc3\xb2\xa1")) == (1_000_002_000, 60, b"x")


def test_gunzip_stream_hands_out_all_before_a_flaw():
    """Damaged in the middle of the second member: the first is whole, the fault is told."""
    first, second = gzip.compress(b"a" * 100_000), bytearray(gzip.compress(bytes(range(256)) * 500))
    second[40:60] = b"\xff" * 20
    stream = GunzipStream(io.BytesIO(first + bytes(second)))
    found = io.BufferedReader(stream).read()
    assert found.startswith(b"a" * 100_000)
    assert "damaged" in stream.fault
    assert stream.delivered == len(found)
