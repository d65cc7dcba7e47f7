"""Frames rebuilt from tshark's table show every reader of headers what the table says."""

import gzip
import subprocess

import numpy as np
import pytest

from apps.packets import PACKET_COLUMNS, read_frames
from sdnator.capture.captures import Capture
from sdnator.capture.tshark_tsv import COLUMNS, TsharkRow, as_columns, read_rows
from sdnator.datasets.rebuild import RebuildError, frame, rebuild
from sdnator.testing.table_samples import TSHARK_HEADER, TSHARK_UDP
from tests.requirements import require_program, shared_data

GUESSED = {"tcp_flags", "tcp_seq", "tcp_ack", "icmp6_type", "icmp6_code"}
"""Columns of the packet record that the table does not have."""


def _row(**fields: int) -> TsharkRow:
    empty = dict.fromkeys(TsharkRow._fields, -1)
    empty |= {"line": 5, "time_ns": 0, "length": 100, "eth_src": 1, "eth_dst": 2, "ip_version": 0}
    return TsharkRow(**(empty | fields))


def _read_back(rows: list[TsharkRow], frames: list[bytes]):
    number = len(frames)
    return read_frames(
        frames,
        lengths=[len(data) for data in frames],
        times_us=[row.time_ns // 1000 for row in rows],
        ports=[1] * number,
        sequence=range(1, number + 1),
        arrival=range(number),
    )


def _assert_same(rows: list[TsharkRow], frames: list[bytes]) -> None:
    found, expected = _read_back(rows, frames), as_columns(rows)
    for name in PACKET_COLUMNS.keys() - GUESSED:
        differ = np.flatnonzero(np.asarray(found[name]) != expected[name])
        assert not len(differ), f"{name} differs in rows {differ[:5]}: {found[name][differ[:5]]}"


def test_all_real_rows(tmp_path):
    """38,363 rows: all fields, lengths on the wire and times come back."""
    table, out = shared_data("kitsune/mirai_38k.tsv.gz"), tmp_path / "out.pcap"
    steps: list[int] = []
    made = rebuild(table, out, steps.append)
    assert made.packets == steps[-1] == 38_363
    assert not made.nanoseconds
    rows = list(read_rows(table))
    with Capture(out) as capture:
        written = list(capture)
    assert [each.time_ns for each in written] == [row.time_ns for row in rows]
    assert (
        [each.length for each in written]
        == [len(each.data) for each in written]
        == [row.length for row in rows]
    )
    _assert_same(rows, [each.data for each in written])


IP = {"ip_version": 4, "ip_src": 0x01020304, "ip_dst": 0x05060708}
IP6 = {"ip_version": 6, "ip_src": 0xFE80 << 112 | 1, "ip_dst": 0xFF02 << 112 | 0x1_FF00_0005}


@pytest.mark.parametrize("length", [60, 61, 62, 74, 90, 94, 95, 1514, 9018])
@pytest.mark.parametrize(
    "fields",
    [
        {**IP, "tcp_sport": 1, "tcp_dport": 65535},
        {**IP, "udp_sport": 53, "udp_dport": 0},
        {**IP, "icmp_type": 8, "icmp_code": 0},
        {**IP, "icmp_type": 11, "icmp_code": 1},
        {**IP},
        {**IP, "ip_dst": 0xE0000016},
        {"arp_op": 2, "arp_src_mac": 3, "arp_src_ip": 4, "arp_dst_mac": 5, "arp_dst_ip": 6},
        {},
        {"eth_dst": 1},
        {"eth_dst": 0x0180C2000000},
    ],
)
def test_every_kind_at_many_lengths(fields, length):
    row = _row(length=length, **fields)
    _assert_same([row], [frame(row)])


@pytest.mark.parametrize("length", [74, 75, 82, 90, 102, 590])
@pytest.mark.parametrize(
    "fields",
    [
        {**IP, "icmp_type": 3, "icmp_code": 3, "udp_sport": 1, "udp_dport": 2},
        {**IP, "icmp_type": 11, "icmp_code": 0, "tcp_sport": 1, "tcp_dport": 2},
        {**IP6, "tcp_sport": 1, "tcp_dport": 2},
        {**IP6, "udp_sport": 1, "udp_dport": 2},
        {**IP6},
    ],
)
def test_errors_that_quote_and_ipv6(fields, length):
    row = _row(length=length, **fields)
    _assert_same([row], [frame(row)])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"eth_src": -1}, "line 5: no Ethernet"),
        ({**IP, "tcp_sport": 1, "tcp_dport": 2, "udp_sport": 1, "udp_dport": 2}, "at once"),
        ({**IP, "tcp_sport": 1, "tcp_dport": 2, "length": 50}, "50 bytes are too few"),
        ({**IP, "icmp_type": 3, "icmp_code": 1, "udp_sport": 1, "udp_dport": 2, "length": 60}, "too few"),
        ({"length": 10}, "10 bytes are too few"),
        ({**IP6, "length": 40}, "too few"),
    ],
)
def test_rows_that_no_frame_can_stand_for(fields, words):
    with pytest.raises(RebuildError, match=words):
        frame(_row(**fields))


def test_nanoseconds_are_kept(tmp_path):
    """A table with ns times gives a ns capture; a bad row leaves no file."""
    table, out = tmp_path / "t.tsv", tmp_path / "out.pcap"
    table.write_text(f"{TSHARK_HEADER}\n{TSHARK_UDP.replace('391651000', '391651007')}\n")
    assert rebuild(table, out).nanoseconds
    with Capture(out) as capture:
        assert capture.first_time_ns == 1_540_446_383_391_651_007
    out.unlink()
    table.write_text(f"{TSHARK_HEADER}\n{TSHARK_UDP}\n{TSHARK_UDP.replace('117', '20', 1)}\n")
    with pytest.raises(RebuildError, match="line 3"):
        rebuild(table, out)
    assert [path.name for path in tmp_path.iterdir()] == ["t.tsv"]


def test_tshark_writes_the_same_table_again(tmp_path):
    """The real tshark finds in the rebuilt frames, byte for byte, the table that they were rebuilt from."""
    tshark = require_program("tshark")
    table, out = shared_data("kitsune/mirai_38k.tsv.gz"), tmp_path / "out.pcap"
    rebuild(table, out)
    fields = [word for name in COLUMNS for word in ("-e", name)]
    command = [tshark, "-r", str(out), "-T", "fields", *fields, "-E", "header=y", "-E", "occurrence=f"]
    made = subprocess.run(command, capture_output=True, check=True)
    assert made.stdout == gzip.decompress(table.read_bytes())
