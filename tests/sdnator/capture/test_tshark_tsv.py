"""tshark's table becomes the packet record, and a line that does not fit is named."""

import gzip

import numpy as np
import pytest

from apps.packets import PACKET_COLUMNS
from sdnator.capture.tshark_tsv import (
    COLUMNS,
    MalformedTsv,
    MissingTsv,
    TsharkRow,
    as_columns,
    read_batches,
    read_rows,
)
from sdnator.testing.table_samples import TSHARK_HEADER, TSHARK_UDP
from tests.requirements import shared_data


def _row(**cells: str) -> str:
    base = {"frame.time_epoch": "1.5", "frame.len": "60", "eth.src": "00:00:00:00:00:01"}
    base |= {"eth.dst": "00:00:00:00:00:02"}
    return "\t".join(
        (base | {name.replace("__", "."): value for name, value in cells.items()}).get(c, "") for c in COLUMNS
    )


def _rows(tmp_path, *lines: str) -> list[TsharkRow]:
    path = tmp_path / "table.tsv"
    path.write_text("\n".join([TSHARK_HEADER, *lines]) + "\n")
    return list(read_rows(path))


def test_columns_of_an_ordinary_row(tmp_path):
    (row,) = _rows(tmp_path, TSHARK_UDP)
    columns = as_columns([row], start=7)
    assert set(columns) == set(PACKET_COLUMNS)
    assert {name: columns[name].dtype for name in columns} == {
        n: np.dtype(k) for n, k in PACKET_COLUMNS.items()
    }
    got = {name: int(columns[name][0]) for name in columns}
    assert got["time_us"] == 1_540_446_383_391_651
    assert (got["arrival"], got["sequence"], got["port"]) == (7, 8, 1)
    assert (got["ip_version"], got["ip_proto"], got["udp_sport"], got["udp_dport"]) == (4, 17, 2440, 53)
    assert (got["tcp_sport"], got["arp_op"], got["arp_src_ip"], got["vlan"]) == (-1, -1, 0, -1)
    assert got["ip_src_lo"] == 0xC0A80273
    assert got["eth_src"] == 0x00166C7F8220


def test_quoted_ports_and_ipv6(tmp_path):
    """Ports beside an ICMP type are quoted; IPv6 addresses fill both halves."""
    error, six = _rows(
        tmp_path,
        _row(
            ip__src="1.2.3.4",
            ip__dst="5.6.7.8",
            icmp__type="3",
            icmp__code="1",
            tcp__srcport="9",
            tcp__dportx="",
        ).replace("\t9\t", "\t9\t80"),
        _row(ipv6__src="fe80::1", ipv6__dst="ff02::1"),
    )
    assert error.quoted
    assert error.ip_proto == 1
    columns = as_columns([error, six])
    assert columns["quoted"].tolist() == [1, 0]
    assert columns["ip_src_hi"].tolist() == [0, 0xFE80 << 48]
    assert columns["ip_proto"].tolist() == [1, 58]


def test_what_the_columns_imply(tmp_path):
    igmp, other, loop, llc, arp = _rows(
        tmp_path,
        _row(ip__src="1.2.3.4", ip__dst="224.0.0.22"),
        _row(ip__src="1.2.3.4", ip__dst="1.2.3.5"),
        _row(eth__dst="00:00:00:00:00:01"),
        _row(),
        _row(arp__opcode="1", arp__src__hw_mac="00:00:00:00:00:01"),
    )
    assert (igmp.ip_proto, other.ip_proto, loop.ip_proto) == (2, 253, -1)
    assert [row.eth_type for row in (igmp, loop, llc, arp)] == [0x0800, 0x9000, 0, 0x0806]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1.5\t60", "line 2 has 2 columns"),
        (_row(frame__len="x"), "line 2, column frame.len: 'x'"),
        (_row(frame__time_epoch="2018-10-25T05:46:22Z"), "column frame.time_epoch"),
        (_row(frame__time_epoch="1.1234567890"), "column frame.time_epoch"),
        (_row(eth__src="00-00-00-00-00-01"), "column eth.src"),
        (_row(eth__src="gg:00:00:00:00:01"), "column eth.src"),
        (_row(ip__src="1.2.3"), "column ip.src"),
        (_row(ip__src="1.2.3.4,5.6.7.8"), "column ip.src"),
        (_row(ipv6__dst="::g"), "column ipv6.dst"),
        (_row(tcp__srcport="-1"), "column tcp.srcport"),
    ],
)
def test_malformed(tmp_path, line, words):
    with pytest.raises(MalformedTsv, match=words):
        _rows(tmp_path, line)


def test_other_header_and_missing_file(tmp_path):
    path = tmp_path / "table.tsv"
    path.write_text("a\tb\n")
    with pytest.raises(MalformedTsv, match="19 columns"):
        list(read_rows(path))
    path.write_text("")
    with pytest.raises(MalformedTsv, match="19 columns"):
        list(read_rows(path))
    with pytest.raises(MissingTsv, match="no such file"):
        list(read_rows(tmp_path / "none"))
    with pytest.raises(MissingTsv, match="cannot be read"):
        list(read_rows(tmp_path))


def test_cut_gzip(tmp_path):
    path = tmp_path / "table.tsv.gz"
    path.write_bytes(gzip.compress("\n".join([TSHARK_HEADER, *[TSHARK_UDP] * 50]).encode())[:-9])
    with pytest.raises(MalformedTsv, match="an incomplete table"):
        list(read_rows(path))
    path.write_bytes(b"\x1f\x8b\x00\x00junk")
    with pytest.raises(MalformedTsv, match="an incomplete table"):
        list(read_rows(path))


def test_all_real_rows_in_batches():
    """38,363 rows; times in µs give back the float64 of the table's decimals."""
    path = shared_data("kitsune/mirai_38k.tsv.gz")
    batches = list(read_batches(path, rows=10_000))
    assert [len(batch) for batch in batches] == [10_000, 10_000, 10_000, 8_363]
    times = np.concatenate([batch["time_us"] for batch in batches])
    with gzip.open(path, "rt") as lines:
        next(lines)
        expected = np.array([float(line.split("\t", 1)[0]) for line in lines])
    assert np.array_equal(times / 1e6, expected)
    assert batches[3]["arrival"][-1] == 38_362
    assert int(sum(batch["quoted"].sum() for batch in batches)) == 5_581
