"""`sdnator queries`: list, explain, add and run as a user sees them."""

import json

import pytest
from typer.testing import CliRunner

from apps.sonata_adapter.query.catalogue import CATALOGUE
from sdnator.capture.captures import CaptureWriter
from sdnator.cli.queries_commands import queries
from sdnator.errors import BadInput
from sdnator.testing.query_traffic import mixed
from tests.apps.sonata_adapter.query.test_catalogue import expect

MINE = """query busy(window=1s, most=3):
    filter tcp.flags == SYN
    map dst = ip.dst
    reduce by dst: n = count()
    filter n > most
"""


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SDNATOR_QUERIES", str(tmp_path / "queries"))


def run(*arguments):
    result = CliRunner().invoke(queries, [str(each) for each in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_list_names_all_with_parameters():
    """As a table for people and as JSON."""
    described = json.loads(run("list", "--json"))["queries"]
    assert [each["name"] for each in described] == list(CATALOGUE)
    assert all(p["default"] and p["bounds"] for each in described for p in each["parameters"])
    text = run("list")
    assert "network.traffic_capture.sonata.tcp" in text
    assert "in the switch, results only" in text


def test_explain_draws_the_plan():
    """Also under the short name."""
    assert "stage 0" in run("explain", "ddos")
    assert "only copies, because" in run("explain", "network.traffic_query.sonata.zorro:similar=3")


def test_add_registers_and_run_uses_it(tmp_path):
    """A file with a query; the next command knows it; a wrong file says where it is wrong."""
    file = tmp_path / "mine.txt"
    file.write_text(MINE)
    assert json.loads(run("add", file, "--json"))["added"] == ["busy"]
    assert "busy" in [each["name"] for each in json.loads(run("list", "--json"))["queries"]]
    assert "reports 10" in run("explain", "network.traffic_query.sonata.busy:most=9")
    file.write_text(MINE.replace("reduce by", "reduce"))
    with pytest.raises(BadInput, match=r"mine\.txt:4:12: expected 'by'"):
        run("add", file)
    file.write_text(MINE.replace("busy", "ddos"))
    with pytest.raises(BadInput, match="one of the catalogue"):
        run("add", file)


@pytest.mark.parametrize("name", ["new_tcp", "syn_flood", "dns_tunnel"])
def test_run_over_a_capture_equals_naive(name, tmp_path):
    """Windows count from the second of the first packet."""
    frames = mixed([name], seconds=6)
    with CaptureWriter(tmp_path / "a.pcap") as writer:
        for frame in frames:
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    lines = run("run", name, "--capture", tmp_path / "a.pcap", "--json").splitlines()
    rows = sorted((line["window_start"], line["dst"], line["count"]) for line in map(json.loads, lines))
    truth = [
        (f.window * 3 * 10**9, dict(f.fields)["dst"], dict(f.fields)["count"]) for f in expect(name, frames)
    ]
    assert rows == sorted(truth)
    assert name.split("_", maxsplit=1)[0]
    assert len(run("run", name, "--capture", tmp_path / "a.pcap").splitlines()) == len(rows)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("run", "ddos"), "either --capture FILE or --since"),
        (("run", "ddos", "--since", "1y", "--archive", "sqlite:///x"), "30s, 10m, 1h or 7d"),
        (("run", "ddos", "--capture", "/nowhere.pcap"), "no such file"),
        (("run", "nothing", "--capture", "x"), "there are new_tcp"),
        (("explain", "network.traffic_query.sonata.ddos:window=*"), "name one query"),
        (("explain", "ddos:window=0s"), "100ms to 1h"),
        (("add", "/nowhere"), "cannot be read"),
    ],
)
def test_misuse_is_one_line(arguments, what):
    """What, where and what to do."""
    with pytest.raises(BadInput, match=what):
        run(*arguments)
