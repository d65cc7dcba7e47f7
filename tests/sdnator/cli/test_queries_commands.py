"""`sdnator queries`: list, explain, add and run as a user sees them."""

import json
from collections import Counter

import pytest
from typer.testing import CliRunner

from apps.sonata_adapter.query.catalogue import CATALOGUE
from sdnator.capture.captures import CaptureWriter
from sdnator.cli.queries_commands import queries
from sdnator.errors import BadInput
from sdnator.testing.oracles import sonata as oracle
from sdnator.testing.query_traffic import mixed
from tests.apps.sonata_adapter.query.test_catalogue import expect

MINE = """query busy(window=1s, most=3):
    filter tcp.flags == SYN
    map dst = ip.dst
    reduce by dst: n = count()
    filter n > most
"""
JOINED = """query open_ends(window=2s):
    filter tcp.flags == SYN
    map dst = ip.dst
    distinct
    join anti on dst with:
        filter tcp.flags == FIN
        map dst = ip.src
        distinct
"""


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SDNATOR_QUERIES", str(tmp_path / "queries"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("DUE_UPDATES", raising=False)


def run(*arguments):
    result = CliRunner().invoke(queries, [str(each) for each in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_list_is_one_screen_and_show_has_the_details():
    """A line a query; parameters, text and cost are in `show` and in the JSON."""
    described = json.loads(run("list", "--json"))["queries"]
    assert [each["name"] for each in described] == list(CATALOGUE)
    assert all(p["default"] and p["bounds"] for each in described for p in each["parameters"])
    lines = run("list").splitlines()
    assert len(lines) <= 24
    names = [line.split()[0] for line in lines if line and not line.startswith(" ")]
    assert names[1 : len(CATALOGUE) + 1] == list(CATALOGUE)
    assert any(line.startswith("network.traffic_capture.sonata.tcp ") for line in lines)
    text = run("show", "new_tcp")
    assert "in the switch, results only" in text
    assert "reduce by dst: count = count()" in text
    assert "100ms to 1h" in text
    assert json.loads(run("show", "ddos", "--json"))["name"] == "ddos"
    assert "source port" in run("show", "tcp")


def test_fields_say_where_they_run():
    """Filters and keys that the planner accepts are of the switch; payloads are of the host."""
    fields = {each["name"]: each for each in json.loads(run("fields", "--json"))}
    assert set(fields["ip.dst"]["switch"]) == {"filter", "key"}
    assert fields["length"]["unit"] == "bytes"
    assert fields["tcp.seq"]["switch"] == []
    assert fields["dns.name"]["payload"]
    shown = [line.split()[0] for line in run("fields").splitlines() if not line.startswith(" ")]
    assert shown == ["field", *fields]


def test_a_query_is_tried_over_a_capture(tmp_path):
    """Rows of each operator are those that a plain loop counts; the query is not added."""
    frames = mixed(["new_tcp"], seconds=6)
    with CaptureWriter(tmp_path / "a.pcap") as writer:
        for frame in frames:
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    (tmp_path / "mine.sonata").write_text(MINE)
    line = run("test", tmp_path / "mine.sonata", "--capture", tmp_path / "a.pcap", "--json")
    one = json.loads(line)
    packets = [oracle.read(*frame) for frame in frames]
    syns = Counter((p.time_us // 10**6, p.dst) for p in packets if oracle.is_syn(p))
    over = sum(count > 3 for count in syns.values())
    assert [(each["rows_in"], each["rows_out"]) for each in one["steps"]] == [
        (len(frames), syns.total()),
        (syns.total(), syns.total()),
        (syns.total(), len(syns)),
        (len(syns), over),
    ]
    assert over == one["found"] == len(one["results"]) > 0
    assert [each["place"] for each in one["plan"]["operators"]] == ["switch"] * 4
    assert one["cost"]["packets"] == len(frames)
    text = run("test", tmp_path / "mine.sonata", "--capture", tmp_path / "a.pcap", "--most", "1")
    assert f"{over} results" in text
    assert f"… {over - 1} more" in text
    assert "busy" not in run("list")


def test_both_sides_of_a_join_are_counted(tmp_path):
    """What the switch would copy is what its classifier can express of either side."""
    frames = mixed(["syn_flood"], seconds=6)
    with CaptureWriter(tmp_path / "a.pcap") as writer:
        for frame in frames:
            writer.write(frame.time_us * 1000, frame.data, frame.length)
    (tmp_path / "mine.sonata").write_text(JOINED)
    one = json.loads(run("test", tmp_path / "mine.sonata", "--capture", tmp_path / "a.pcap", "--json"))
    packets = [oracle.read(*frame) for frame in frames]
    window = 2 * 10**6
    syns = {(p.time_us // window, p.dst) for p in packets if oracle.is_syn(p)}
    fins = {(p.time_us // window, p.src) for p in packets if oracle.is_fin(p)}
    steps = {each["operator"].split(" ")[0]: each for each in one["steps"] if "join" in each["operator"]}
    assert steps["join"]["rows_out"] == len(syns - fins) == one["found"]
    told = [each["rows_out"] for each in one["steps"] if each["operator"].startswith("distinct")]
    assert told == [len(syns), len(fins)]
    both = sum(oracle.is_syn(p) or oracle.is_fin(p) for p in packets)
    assert one["cost"]["tuples_to_host"] == both < len(frames)
    assert not one["plan"]["in_switch"]


def test_explain_draws_the_plan():
    """Also under the short name."""
    assert "stage 0" in run("explain", "ddos")
    assert "no running adapter was asked" in run("explain", "ddos")
    assert json.loads(run("explain", "ddos", "--json"))["in_switch"]
    assert "passed the gate" in run("explain", "network.traffic_query.sonata.zorro:similar=3")
    assert "only copies, because" in run("explain", "arp_scan")


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
        (("run", "ddos", "--since", "1y", "--archive", "sqlite:///x"), "a time ago such as 1h"),
        (("run", "ddos", "--since", "1h", "--until", "2h"), "before the end"),
        (("run", "ddos", "--capture", "x.pcap", "--until", "2h"), "--until only with --since"),
        (("run", "ddos", "--since", "1h", "--parquet", "x"), "only with --since and --engine spark"),
        (("run", "ddos", "--capture", "x.pcap", "--engine", "spark", "--parquet", "x"), "only with --since"),
        (("run", "ddos", "--since", "1h", "--engine", "flink", "--archive", "memory://"), "numpy or spark"),
        (("run", "ddos", "--capture", "/nowhere.pcap"), "no such file"),
        (("run", "nothing", "--capture", "x"), "there are new_tcp"),
        (("explain", "network.traffic_query.sonata.ddos:window=*"), "name one query"),
        (("explain", "ddos:window=0s"), "100ms to 1h"),
        (("add", "/nowhere"), "cannot be read"),
        (("show", "nothing"), "there are new_tcp"),
        (("test", "/nowhere", "--capture", "x"), "cannot be read"),
    ],
)
def test_misuse_is_one_line(arguments, what):
    """What, where and what to do."""
    with pytest.raises(BadInput, match=what):
        run(*arguments)
