"""Captures are read to the last whole packet in every form, and say where they are cut."""

import gzip
import io
import struct
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.utils import RawPcapNgWriter, RawPcapReader, RawPcapWriter

from sdnator.capture import captures
from sdnator.capture.pcap_records import Damage, WrongLink, read_pcapng
from sdnator.testing.capture_samples import (
    CAPTURES,
    FRAMES,
    T0,
    block,
    interface,
    packet,
    pcap,
    pcapng,
    section,
)
from tests.requirements import shared_data


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("form", CAPTURES)
def test_every_form_reads_the_same(tmp_path, form, packed):
    """Six formats, plain and gzipped, hold the same three packets."""
    path = tmp_path / "any.name"
    path.write_bytes(gzip.compress(CAPTURES[form]) if packed else CAPTURES[form])
    with captures.Capture(path) as capture:
        assert capture.first_time_ns == T0
        found = list(capture)
    assert found == [(time, len(frame) + 7, frame) for time, frame in FRAMES]
    assert capture.packets == 3
    assert capture.cut is None


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("form", CAPTURES)
def test_every_cut_is_found(tmp_path, form, packed):
    """Wherever the last packet is cut, the two before it are used and the note names its first byte."""
    whole = CAPTURES[form]
    tail = {"pcap-": 16 + 1500, "pcapn": 1532 + (28 + 32 if form.startswith("pcapng") else 0)}[form[:5]]
    path = tmp_path / "cut"
    for end in [len(whole) - 1, len(whole) - 700, len(whole) - 1500]:
        data = whole[:end]
        path.write_bytes(gzip.compress(data) if packed else data)
        with captures.Capture(path) as capture:
            assert len(list(capture)) == 2
        assert capture.cut is not None
        assert capture.cut.packets == 2
        assert capture.cut.offset == len(whole) - (tail if form.startswith("pcap-") else 1532)
        assert "2 complete packets" in str(capture.cut)
        assert ("unpacked" in str(capture.cut)) is packed


def test_a_cut_gzip_stream_gives_all_whole_packets(tmp_path):
    """A gzip file cut in the middle yields what was unpacked before the cut, and says so."""
    path = tmp_path / "big.pcap.gz"
    with captures.CaptureWriter(path) as writer:
        for number in range(5_000):
            writer.write(T0 + number * 1_000_000, number.to_bytes(4, "big") * 100)
    packed = path.read_bytes()
    path.write_bytes(packed[: len(packed) // 2])
    with captures.Capture(path) as capture:
        found = list(capture)
    assert 1_000 < len(found) < 4_000
    assert [frame.data[:4] for frame in found] == [n.to_bytes(4, "big") for n in range(len(found))]
    assert capture.cut is not None
    assert capture.cut.packets == len(found)
    assert "gzip" in str(capture.cut)


def test_several_gzip_members_are_one_capture(tmp_path):
    path = tmp_path / "members.gz"
    data = CAPTURES["pcap-us-little"]
    path.write_bytes(gzip.compress(data[:50]) + gzip.compress(data[50:]) + bytes(512))
    with captures.Capture(path) as capture:
        assert len(list(capture)) == 3
    assert capture.cut is None


def _wrong_link() -> bytes:
    return struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 113) + bytes(16)


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        (None, captures.MissingCapture, "no such file"),
        (b"", captures.EmptyCapture, "file is empty"),
        (b"GIF89a" + bytes(100), captures.NotACapture, "not a capture"),
        (gzip.compress(b"hello world", mtime=0), captures.NotACapture, "not a capture"),
        (b"\x1f\x8bno gzip at all", captures.NotACapture, "not a capture"),
        (pcap("<", False)[:24], captures.EmptyCapture, "no packets"),
        (section("<"), captures.EmptyCapture, "no packets"),
        (pcap("<", False)[:10], captures.NotACapture, "file header"),
        (pcap("<", False)[:50], captures.NotACapture, "no complete packet"),
        (_wrong_link(), captures.UnsupportedLink, "link type 113"),
        (section("<") + interface("<", 6, 113) + packet("<", 1, b"x"), captures.UnsupportedLink, "113"),
    ],
)
def test_bad_input_is_named(tmp_path, content, error, words):
    """Each kind of unusable file has its own class and a text with the path in it."""
    path = tmp_path / "bad"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(error, match=words) as caught:
        captures.Capture(path)
    assert str(path) in str(caught.value)


def test_a_folder_is_no_capture(tmp_path):
    with pytest.raises(captures.MissingCapture, match="folder"):
        captures.Capture(tmp_path)


def test_senseless_record_lengths_end_the_capture(tmp_path):
    """A record that announces 4 GB is damage, not an allocation."""
    path = tmp_path / "huge"
    path.write_bytes(CAPTURES["pcap-us-little"] + struct.pack("<4I", 1, 0, 0xFFFFFFFF, 1))
    with captures.Capture(path) as capture:
        assert len(list(capture)) == 3
    assert capture.cut is not None
    assert "4294967295" in capture.cut.reason


def test_reads_as_scapy_does():
    """The shared real capture reads exactly as scapy reads it."""
    path = shared_data("kitsune/mirai2000.pcap")
    with captures.Capture(path) as capture, RawPcapReader(str(path)) as oracle:
        for ours, (data, meta) in zip(capture, oracle, strict=True):
            assert ours == (meta.sec * 10**9 + meta.usec * 1000, meta.wirelen, data)
        assert capture.position == capture.size


@pytest.mark.parametrize("nano", [False, True])
@pytest.mark.parametrize("endian", ["<", ">"])
def test_reads_what_scapy_writes(tmp_path, nano, endian):
    path = tmp_path / "scapy.pcap"
    with RawPcapWriter(str(path), linktype=1, nano=nano, endianness=endian) as writer:
        writer.write_header(None)
        for time, frame in FRAMES:
            writer.write_packet(
                frame, time // 10**9, time % 10**9 // (1 if nano else 1000), wirelen=len(frame) + 7
            )
    with captures.Capture(path) as capture:
        assert list(capture) == [(time, len(frame) + 7, frame) for time, frame in FRAMES]


def test_reads_what_scapy_writes_as_pcapng(tmp_path):
    path = tmp_path / "scapy.pcapng"
    with RawPcapNgWriter(str(path)) as writer:
        writer.linktype = 1
        writer.write_header(None)
        for time, frame in FRAMES:
            writer.write_packet(frame, Fraction(time, 10**9), 0, wirelen=len(frame))  # type: ignore[arg-type]
    with captures.Capture(path) as capture:
        assert [(time // 1000, data) for time, _, data in capture] == [(t // 1000, f) for t, f in FRAMES]


@pytest.mark.parametrize("name", ["out.pcap", "out.pcap.gz"])
@pytest.mark.parametrize("nano", [False, True])
def test_what_is_written_reads_back(tmp_path, name, nano):
    path = tmp_path / name
    with captures.CaptureWriter(path, nanoseconds=nano) as writer:
        for time, frame in FRAMES:
            writer.write(time + 123, frame, len(frame) + 7)
    with captures.Capture(path) as capture:
        extra = 123 if nano else 0
        assert list(capture) == [(time + extra, len(frame) + 7, frame) for time, frame in FRAMES]
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    path = tmp_path / "out.pcap"

    def interrupted() -> None:
        with captures.CaptureWriter(path) as writer:
            writer.write(T0, b"x")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@given(st.binary(max_size=300), st.sampled_from(sorted(CAPTURES)), st.integers(0, 3000))
def test_no_bytes_crash_the_readers(tmp_path_factory, noise, form, where):
    """Sound captures overwritten with noise anywhere give frames, a note or one of our errors: nothing else."""
    data = bytearray(CAPTURES[form])
    data[where : where + len(noise)] = noise
    path: Path = tmp_path_factory.mktemp("noise") / "capture"
    path.write_bytes(data)
    try:
        with captures.Capture(path) as capture:
            list(capture)
    except captures.CaptureError:
        pass


def test_simple_and_old_packet_blocks():
    """Obsolete block types of pcapng still read; a simple packet has the time of the one before it."""
    old = struct.pack("<HH4I", 0, 0, T0 // 1000 >> 32, T0 // 1000 & 0xFFFFFFFF, 3, 3) + b"old"
    simple = struct.pack("<I", 4) + b"simp"
    data = section("<") + interface("<", 6) + block("<", 2, old) + block("<", 3, simple)
    frames = list(read_pcapng(io.BytesIO(data[4:])))
    assert frames == [(T0, 3, b"old"), (T0, 4, b"simp")]


def test_an_unknown_interface_is_damage():
    data = section("<") + interface("<", 6) + packet("<", 1, b"x", interface=3)
    with pytest.raises(Damage, match="interface 3"):
        list(read_pcapng(io.BytesIO(data[4:])))


def test_a_link_that_changes_half_way_is_named(tmp_path):
    path = tmp_path / "mixed"
    path.write_bytes(pcapng("<") + section("<") + interface("<", 6, 113) + packet("<", 1, b"x"))
    with captures.Capture(path) as capture, pytest.raises(captures.UnsupportedLink, match="after 3 packets"):
        list(capture)
    assert issubclass(captures.UnsupportedLink, captures.CaptureError)
    assert not issubclass(WrongLink, captures.CaptureError)
