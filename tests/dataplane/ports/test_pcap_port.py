"""Capture files as ports: both byte orders, µs and ns, cut frames and cut files, full disks."""

import struct
from pathlib import Path

import pytest

from dataplane.ports.pcap_port import PcapPort
from dataplane.ports.port import PortError


def capture(order="<", magic=0xA1B2C3D4, link=1, records=()):
    data = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for seconds, fraction, frame, wire in records:
        data += struct.pack(f"{order}IIII", seconds, fraction, len(frame), wire) + frame
    return data


RECORDS = [(100, 5, b"abcd", 4), (102, 7, b"ab", 6)]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("magic", "scale"), [(0xA1B2C3D4, 1), (0xA1B23C4D, 1000)])
def test_frames_are_padded_and_timed_from_the_first_second(tmp_path, order, magic, scale):
    records = [(seconds, fraction * scale, frame, wire) for seconds, fraction, frame, wire in RECORDS]
    path = tmp_path / "in.pcap"
    path.write_bytes(capture(order, magic, records=records))
    port = PcapPort(path, None, lambda: 0)
    assert port.waiting()
    arrived = port.receive(10)
    assert list(arrived.frames) == [b"abcd", b"ab\0\0\0\0"]
    assert list(arrived.times_us) == [5, 2_000_007]
    assert not port.waiting()
    port.close()


def test_a_cut_file_gives_what_is_whole(tmp_path):
    path = tmp_path / "in.pcap"
    path.write_bytes(capture(records=RECORDS)[:-1])
    port = PcapPort(path, None, lambda: 0)
    assert len(port.receive(10).frames) == 1
    port.close()


def test_what_is_sent_can_be_read_again(tmp_path):
    path = tmp_path / "out.pcap"
    times = iter([3_000_001, 4_500_000])
    port = PcapPort(None, path, lambda: next(times))
    port.send(b"one")
    port.send(b"two")
    port.close()
    again = PcapPort(path, None, lambda: 0)
    arrived = again.receive(10)
    assert (list(arrived.frames), list(arrived.times_us)) == ([b"one", b"two"], [1, 1_500_000])
    again.close()


def test_a_frame_from_before_the_first_one_s_second_comes_at_0(tmp_path):
    path = tmp_path / "in.pcap"
    path.write_bytes(capture(records=[(100, 5, b"a", 1), (98, 0, b"b", 1), (101, 0, b"c", 1)]))
    port = PcapPort(path, None, lambda: 0)
    assert list(port.receive(10).times_us) == [5, 0, 1_000_000]
    port.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full")
@pytest.mark.parametrize("frames", [1, 1000])
def test_a_full_disk_ends_the_capture_and_not_the_switch(capsys, frames):
    """It is said once, and frames that could not be written are counted."""
    port = PcapPort(None, Path("/dev/full"), lambda: 0)
    for _ in range(frames):
        port.send(bytes(1000))
    port.close()
    assert port.counters.sent + port.counters.failed == frames
    assert port.counters.failed or frames == 1  # a single one is still in the buffer
    assert capsys.readouterr().err.count("/dev/full") == 1


def test_a_time_beyond_a_stamp_is_written_modulo_2_to_the_32_s(tmp_path):
    path = tmp_path / "out.pcap"
    port = PcapPort(None, path, lambda: (2**32 + 7) * 1_000_000)
    port.send(b"frame")
    port.close()
    assert struct.unpack_from("<II", path.read_bytes(), 24) == (7, 0)


@pytest.mark.parametrize("data", [b"", b"not a capture at all, really", capture(link=113)])
def test_other_files_are_refused(tmp_path, data):
    path = tmp_path / "in.pcap"
    path.write_bytes(data)
    with pytest.raises(PortError, match=r"in\.pcap"):
        PcapPort(path, None, lambda: 0)


def test_missing_files_and_folders_are_said_plainly(tmp_path):
    with pytest.raises(PortError, match="cannot read"):
        PcapPort(tmp_path / "none", None, lambda: 0)
    with pytest.raises(PortError, match="cannot write"):
        PcapPort(None, tmp_path / "none" / "out.pcap", lambda: 0)
