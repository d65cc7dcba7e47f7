"""Blocks hold the frames that one reading after the other gives, whatever the file's form."""

import gzip
import struct

import numpy as np
import pytest

from sdnator.capture import capture_blocks
from sdnator.capture.capture_blocks import CaptureBlocks
from sdnator.capture.captures import Capture, CaptureWriter, MissingCapture
from sdnator.replay.survey import survey

FRAMES = [bytes([number]) * (14 + number * 37 % 400) for number in range(200)]


def pcap(path, *, nanoseconds=False):
    with CaptureWriter(path, nanoseconds=nanoseconds) as writer:
        for number, frame in enumerate(FRAMES):
            writer.write(5_000_000_000 + number * 1_500, frame, len(frame) + number % 3)
    return path


def swapped(path):
    """The same file in the other byte order."""
    data, at = path.read_bytes(), 24
    parts = [struct.pack(">IHHiIII", *struct.unpack("<IHHiIII", data[:24]))]
    while at < len(data):
        head = struct.unpack_from("<4I", data, at)
        parts.append(struct.pack(">4I", *head) + data[at + 16 : at + 16 + head[2]])
        at += 16 + head[2]
    path.write_bytes(b"".join(parts))
    return path


def pcapng(path):
    def block(kind, body):
        body += bytes(-len(body) % 4)
        size = struct.pack("<I", len(body) + 12)
        return struct.pack("<I", kind) + size + body + size

    parts = [
        block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(1, struct.pack("<HHI", 1, 0, 0)),
    ]
    for number, frame in enumerate(FRAMES):
        parts.append(block(6, struct.pack("<5I", 0, 0, number, len(frame), len(frame)) + frame))
    path.write_bytes(b"".join(parts))
    return path


FORMS = {
    "plain": pcap,
    "nanoseconds": lambda path: pcap(path, nanoseconds=True),
    "swapped": lambda path: swapped(pcap(path)),
    "gzipped": lambda path: pcap(path.with_suffix(".pcap.gz")),
    "pcapng": pcapng,
    "cut": lambda path: (pcap(path).write_bytes(path.read_bytes()[:-5]), path)[1],
}


def taken(path, index, *sizes):
    with CaptureBlocks(path, index) as blocks:
        return [blocks.take(size) for size in sizes]


@pytest.mark.parametrize("form", sorted(FORMS))
def test_blocks_are_what_the_capture_holds(tmp_path, form):
    """Frames, lengths and times, in blocks of any size."""
    path = FORMS[form](tmp_path / "one.pcap")
    with Capture(path) as capture:
        frames = list(capture)
    surveyed = survey(path)
    sizes = (1, 7, 100, len(frames) - 108)
    blocks = taken(path, surveyed.frames(), *sizes)
    assert [len(block) for block in blocks] == list(sizes)
    assert [data for block in blocks for data in block.frames()] == [frame.data for frame in frames]
    assert np.concatenate([block.lengths for block in blocks]).tolist() == [frame.length for frame in frames]
    assert np.concatenate([block.times_us for block in blocks]).tolist() == [
        frame.time_ns // 1_000 - surveyed.base_us for frame in frames
    ]
    assert surveyed.plain == (form not in ("gzipped", "pcapng"))


def test_a_block_is_limited_in_bytes_but_has_a_frame(tmp_path, monkeypatch):
    """Many large frames at once would take memory without bound."""
    path = pcap(tmp_path / "one.pcap")
    index = survey(path).frames()
    monkeypatch.setattr(capture_blocks, "MAX_BYTES", 1_000)
    blocks = taken(path, index, *[200] * 4)
    assert all(len(block) and int(block.lengths.sum()) <= 1_000 for block in blocks)
    monkeypatch.setattr(capture_blocks, "MAX_BYTES", 1)
    assert [len(block) for block in taken(path, index, 5, 5)] == [1, 1]


def test_a_file_that_shrinks_is_an_error(tmp_path):
    """The index is older than the file."""
    path = pcap(tmp_path / "one.pcap")
    index = survey(path).frames()
    path.write_bytes(path.read_bytes()[:3_000])
    with pytest.raises(MissingCapture, match="shorter"):
        taken(path, index, 200)


def test_gzip_is_told_by_content(tmp_path):
    """A gzipped file may have any name: its frames do not lie where the lengths say."""
    path = tmp_path / "one.pcap"
    path.write_bytes(gzip.compress(pcap(tmp_path / "two.pcap").read_bytes()))
    assert not survey(path).plain
    assert list(taken(path, survey(path).frames(), 200)[0].frames()) == FRAMES
