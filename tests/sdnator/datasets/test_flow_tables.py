"""Labelled flows are read as their publishers write them, quirks included, and damage is one error."""

import gzip
from contextlib import suppress
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sdnator.datasets.flow_tables import (
    FlowTableError,
    LabelledFlow,
    MalformedFlowTable,
    MissingFlowTable,
    read_flow_table,
)
from sdnator.testing.table_samples import BINETFLOW, CIC_HEADER, CICFLOWMETER, ZEEK


def _ns(*moment: int) -> int:
    return int(datetime(*moment, tzinfo=UTC).timestamp()) * 10**9  # type: ignore[misc,arg-type]


def _ip(text: str) -> int:
    return int(ip_address(text))


def _read(folder: Path, text: str, offset: float = 0.0) -> list[LabelledFlow]:
    path = folder / "flows"
    path.write_bytes(text.encode("latin-1"))
    return list(read_flow_table(path, clock_offset_hours=offset))


def test_zeek_with_labels_behind_spaces(tmp_path):
    """The last three columns are separated by spaces; labels come in either case; times are UTC."""
    scan, unreachable = _read(tmp_path, ZEEK, 5.0)
    begin = 1_525_879_831_015_811_000
    addresses = (_ip("192.168.100.103"), _ip("65.127.233.163"))
    assert scan == (begin, begin + 2_999_051_000, *addresses, 51524, 23, 6, True)
    assert (unreachable.protocol, unreachable.source_port, unreachable.attack) == (1, 0, False)
    assert unreachable.begin_ns == unreachable.end_ns == 1_525_879_832 * 10**9


def test_binetflow_of_prague(tmp_path):
    """Local time becomes UTC, ARP is left out, and what others send to the bot is no attack."""
    bot, reply = _read(tmp_path, BINETFLOW, 2.0)
    begin = _ns(2011, 8, 10, 7, 46, 53) + 47_277_000
    assert bot[:2] == (begin, begin + 3_124_000_000)
    assert bot[2:] == (_ip("147.32.84.165"), _ip("60.190.222.139"), 1027, 80, 6, True)
    assert (reply.protocol, reply.source_port, reply.destination_port, reply.attack) == (1, 0, 0, False)


def test_cicflowmeter_with_all_its_quirks(tmp_path):
    """Spaces in names, a Windows dash, twelve hours without PM, minutes, negative durations, empty lines."""
    web, afternoon, exact = _read(tmp_path, CICFLOWMETER, -3.0)
    assert (web.begin_ns, web.attack) == (_ns(2017, 7, 6, 12, 20), True)
    assert web.end_ns == web.begin_ns + 5 * 10**9 + 60 * 10**9
    assert afternoon.begin_ns == _ns(2017, 7, 7, 18, 56)
    assert afternoon.end_ns == afternoon.begin_ns + 60 * 10**9
    assert exact.begin_ns == _ns(2017, 7, 3, 11, 55, 58)
    assert exact.end_ns == exact.begin_ns + 10**9 + 1_000


def test_cicflowmeter_with_am_and_pm_and_attempts(tmp_path):
    """The corrected tables have a clock with AM and PM, short names, and attempts that did nothing."""
    header = CIC_HEADER.replace("Source", "Src").replace("Destination", "Dst")
    row = "a,172.16.0.1,1,192.168.10.50,80,6,06/07/2017 02:20:11 PM,5,3,1,DoS Hulk - Attempted\n"
    (flow,) = _read(tmp_path, header + row)
    assert (flow.begin_ns, flow.attack) == (_ns(2017, 7, 6, 14, 20, 11), False)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no header"),
        ("0\n1\n", "line 1 is not the header"),
        (ZEEK.replace("   Malicious", "   Maybe"), "line 9 is not a flow"),
        (ZEEK.replace("1525879831.015811", "yesterday"), "line 9 is not a flow"),
        (BINETFLOW.replace(",1027,", ",70000,"), "line 2 is not a flow"),
        (BINETFLOW.replace("2011/08/10 09:46:53", "9999/08/10 09:46:53"), "out of range"),
        (CICFLOWMETER.replace(",6,6/7", ",6000,6/7"), "protocol 6000"),
        (CICFLOWMETER.replace("5000000", "Infinity"), "line 2 is not a flow"),
        (" Destination Port, Flow Duration, Label\n80,3,BENIGN\n", "GeneratedLabelledFlows"),
        (BINETFLOW + "x" * 70_000, "longer than"),
    ],
)
def test_malformed_tables_name_the_line(tmp_path, text, words):
    """One error type, with the file, the line and what to do."""
    with pytest.raises(MalformedFlowTable, match=words) as caught:
        _read(tmp_path, text)
    assert str(tmp_path) in str(caught.value)


def test_missing_and_cut_tables(tmp_path):
    """A table that is not there, a folder, and a gzip stream that ends too early."""
    with pytest.raises(MissingFlowTable, match="no such file"):
        list(read_flow_table(tmp_path / "none"))
    with pytest.raises(MissingFlowTable):
        list(read_flow_table(tmp_path))
    (tmp_path / "cut").write_bytes(gzip.compress(ZEEK.encode())[:-40])
    with pytest.raises(MalformedFlowTable, match="an incomplete table"):
        list(read_flow_table(tmp_path / "cut"))


@settings(max_examples=150, deadline=None)
@given(st.sampled_from((ZEEK, BINETFLOW, CICFLOWMETER)), st.data())
def test_mutated_tables_give_flows_or_the_declared_error(tmp_path_factory, text, data):
    """Whatever bytes are changed, removed or doubled: flows, or FlowTableError."""
    content = bytearray(text.encode("latin-1"))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        length = data.draw(st.integers(0, 12))
        content[at : at + length] = data.draw(st.binary(max_size=12))
    path = tmp_path_factory.mktemp("mutated") / "flows"
    path.write_bytes(content)
    with suppress(FlowTableError):
        for flow in read_flow_table(path, clock_offset_hours=-3.0):
            assert 0 <= flow.begin_ns <= flow.end_ns
