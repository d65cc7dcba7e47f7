"""One capture behind another: bytes unchanged, times shifted by one amount, labels for both."""

from pathlib import Path

import pytest

from sdnator.capture.captures import Capture, CapturedFrame, CaptureError, CaptureWriter
from sdnator.capture.labels import Labels, LengthMismatch, labels_path, read_labels, write_labels
from sdnator.datasets.splice import splice

MAC = b"\x02\x00\x00\x00\x00\x09"
T0 = 1_540_446_382_000_000_000


def _capture(path: Path, times: list[int], *, nano: bool = False) -> Path:
    with CaptureWriter(path, nanoseconds=nano) as writer:
        for number, time in enumerate(times):
            writer.write(time, bytes(6) + MAC + bytes([number]) * 8, 60)
    return path


def _read(path: Path) -> list[CapturedFrame]:
    with Capture(path) as capture:
        return list(capture)


def test_splice(tmp_path):
    """Without labels the first part is benign, the second an attack of its first sender."""
    benign = _capture(tmp_path / "b.pcap", [T0, T0 + 5_000_000])
    attack = _capture(tmp_path / "a.pcap", [T0 * 2, T0 * 2 + 1_000, T0 * 2 + 9_000])
    steps: list[int] = []
    made = splice(benign, attack, tmp_path / "out.pcap", gap_ns=2_000_000, progress=steps.append)
    found, parts = _read(made.capture), _read(benign) + _read(attack)
    start = T0 + 7_000_000
    assert [frame.time_ns for frame in found] == [T0, T0 + 5_000_000, start, start + 1_000, start + 9_000]
    assert [frame[1:] for frame in found] == [frame[1:] for frame in parts]
    assert (made.benign_packets, made.attack_packets, made.cuts) == (2, 3, ())
    labels = read_labels(made.labels, 5)
    assert labels.attack.tolist() == [False, False, True, True, True]
    assert labels.attackers == {MAC.hex(":")}


def test_labels_beside_the_parts_are_used(tmp_path):
    benign = _capture(tmp_path / "b.pcap", [T0, T0 + 1_000])
    attack = _capture(tmp_path / "a.pcap", [T0, T0 + 1_000])
    write_labels(labels_path(benign), Labels.of([False, True], ["", "10.0.0.1"]))
    write_labels(labels_path(attack), Labels.of([True, False], ["x", ""]))
    labels = read_labels(splice(benign, attack, tmp_path / "out.pcap").labels)
    assert labels.attack.tolist() == [False, True, True, False]
    assert [labels.attacker(index) for index in range(4)] == ["", "10.0.0.1", "x", ""]
    write_labels(labels_path(attack), Labels.of([True]))
    with pytest.raises(LengthMismatch):
        splice(benign, attack, tmp_path / "out2.pcap")


def test_the_gap_counts_from_the_latest_packet(tmp_path):
    """Parts out of order in themselves do not overlap."""
    benign = _capture(tmp_path / "b.pcap", [T0 + 9_000, T0])
    attack = _capture(tmp_path / "a.pcap", [50_000, 20_000])
    found = _read(splice(benign, attack, tmp_path / "out.pcap", gap_ns=1_000).capture)
    assert [frame.time_ns - T0 for frame in found] == [9_000, 0, 40_000, 10_000]


def test_nanoseconds_survive(tmp_path):
    benign = _capture(tmp_path / "b.pcap", [T0])
    attack = _capture(tmp_path / "a.pcap", [7], nano=True)
    made = splice(benign, attack, tmp_path / "out.pcap.gz", gap_ns=3)
    assert [frame.time_ns - T0 for frame in _read(made.capture)] == [0, 3]


def test_cut_parts_are_used_and_named(tmp_path):
    benign = _capture(tmp_path / "b.pcap", [T0, T0 + 1_000])
    benign.write_bytes(benign.read_bytes()[:-3])
    attack = _capture(tmp_path / "a.pcap", [T0])
    made = splice(benign, attack, tmp_path / "out.pcap")
    assert (made.benign_packets, len(made.cuts)) == (1, 1)
    assert "b.pcap" in str(made.cuts[0])


def test_bad_input(tmp_path):
    benign = _capture(tmp_path / "b.pcap", [T0])
    with pytest.raises(CaptureError, match="no such file"):
        splice(benign, tmp_path / "none", tmp_path / "out.pcap")
    with pytest.raises(ValueError, match="cannot overlap"):
        splice(benign, benign, tmp_path / "out.pcap", gap_ns=-1)
    with pytest.raises(OSError, match="No such file"):
        splice(benign, benign, tmp_path / "nowhere" / "out.pcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.pcap"]
