"""Queries from Python: results as Arrow tables and data frames, equal to the naive evaluator's."""

import re
from pathlib import Path

import pytest

import sdnator
from apps.sonata_adapter.query.language import SYN, ip, tcp
from sdnator.capture.captures import CaptureWriter
from sdnator.errors import BadInput
from sdnator.testing.oracles import sonata
from sdnator.testing.query_traffic import mixed
from tests.apps.sonata_adapter.query.test_catalogue import expect

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "sonata.md"


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SDNATOR_QUERIES", str(tmp_path / "queries"))


@pytest.fixture(scope="module")
def frames():
    return mixed(["new_tcp", "arp_scan"], seconds=6)


@pytest.fixture(scope="module")
def capture(frames, tmp_path_factory):
    path = tmp_path_factory.mktemp("results") / "day.pcap"
    with CaptureWriter(path) as writer:
        for frame in frames:
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    return path


def test_a_table_has_the_results(frames, capture):
    """Text, numbers and times; the rows are those of the naive evaluator."""
    arrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    found = sdnator.run_query("new_tcp", capture)
    table = found.to_arrow()
    truth = expect("new_tcp", frames)
    rows = {(row["dst"], row["count"], row["at"].value // 1000) for row in table.to_pylist()}
    assert rows == {(dict(f.fields)["dst"], dict(f.fields)["count"], f.at_us) for f in truth}
    assert table.schema.field("at").type == arrow.timestamp("ns", "UTC")
    assert table.num_rows == len(found) == len(truth) > 0
    assert found.left_out == 0
    scanners = sdnator.run_query("arp_scan", capture).to_arrow()["mac"].to_pylist()
    assert scanners == [dict(f.fields)["mac"] for f in expect("arp_scan", frames)]
    few = sdnator.run_query("new_tcp:threshold=2", capture, most=1)
    assert len(few) == 1
    assert few.left_out > 0


def test_packets_become_columns(frames, capture):
    """A query that ends with packets: their columns, with times."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    syns = [frame for frame in frames if sonata.is_syn(sonata.read(*frame))]
    query = sdnator.Query("syns").filter(tcp.flags == SYN)
    table = sdnator.run_query(query, [capture]).to_arrow()
    assert table.num_rows == len(syns)
    assert table["tcp_dport"].to_pylist() == [sonata.read(*frame).dport for frame in syns]
    assert table["frame"][0].as_py()[: len(syns[0].data)] == syns[0].data[:256]
    narrow = sdnator.run_query(query.map(dst=ip.dst, port=tcp.dport), capture, most=3)
    assert len(narrow) == narrow.to_arrow().num_rows == 3


def test_the_notebook_of_the_page_works(capture, monkeypatch, capsys):
    """The Python block of docs/sonata.md runs and prints hosts."""
    pytest.importorskip("pandas", reason="pandas is not installed")
    (block,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    monkeypatch.chdir(capture.parent)
    names = {}
    exec(block, names)  # noqa: S102 - our own document
    frame = names["results"].to_pandas()
    assert (frame["syns"] >= 20).all()
    assert len(frame) > 0
    assert frame["dst"].iloc[0] in capsys.readouterr().out


def test_misuse_says_what_to_do(capture, monkeypatch):
    """Unknown query, no capture, a library that is missing."""
    with pytest.raises(BadInput, match="there are new_tcp"):
        sdnator.run_query("nothing", capture)
    with pytest.raises(BadInput, match="at least one capture"):
        sdnator.run_query("new_tcp", [])
    with pytest.raises(BadInput, match="no such file"):
        sdnator.run_query("new_tcp", "/nowhere.pcap")
    results = sdnator.run_query("new_tcp", capture)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(BadInput, match=r"sdnator\[arrow\]"):
        results.to_arrow()
