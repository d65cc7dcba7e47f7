"""`sdnator plan`: a table, one sentence about the bottleneck, and what the figures do not say."""

import json

import msgspec
import pytest
from typer.testing import CliRunner

from sdnator.cli import plan_command
from sdnator.errors import BadInput
from sdnator.plan import measure
from sdnator.plan.costs import Costs, ProcessCost, read, write
from tests.end_to_end.operator_app import app

COSTS = Costs(
    machine="some processor",
    cores=2,
    measured="2026-11-25",
    rates=(1000.0,),
    processes={
        "switch": ProcessCost(per_switch=True, us_per_packet=(10.0,), mib=50.0),
        "kitsune": ProcessCost(us_per_packet=(50.0,), mib=150.0),
    },
    archive=(500.0,),
    sqlite_bytes_per_s=1e8,
)


@pytest.fixture
def costs(tmp_path):
    path = tmp_path / "costs.json"
    write(path, COSTS)
    return path


def run(*words):
    return CliRunner().invoke(app, ["plan", *map(str, words)], catch_exceptions=False)


def test_what_a_pipeline_takes(costs):
    """A row for each part, and one of them all."""
    shown = run("--switches", 2, "--pps", 2000, "--costs", costs).stdout.splitlines()
    rows = [line.split() for line in shown]
    assert ["switch", "2", "0.010", "0.020", "100", "switches,", "packets"] in rows
    assert ["kitsune", "1", "0.100", "0.100", "150", "packets"] in rows
    assert ["all", "3", "0.120", "250"] in rows
    text = " ".join(" ".join(shown).split())
    assert shown[0] == "2 switches, 2,000 packets/s together, 1,000 at each"
    assert "86.4 GB a day" in text
    assert (
        "Bottleneck: kitsune uses 10% of one core, which is all a process uses, and is full at about 20,000"
        in text
    )
    assert "costs of 2026-11-25 from some processor, 2 cores; no prediction" in text


def test_what_does_not_fit_is_said_with_a_remedy(costs):
    shown = " ".join(run("--pps", 60_000, "--costs", costs).stdout.split())
    assert "Bottleneck: kitsune needs 3 times one core" in shown
    assert "full at about 20,000 packets/s: copy fewer packets" in shown
    shown = " ".join(run("--switches", 3, "--pps", 60_000, "--costs", costs).stdout.split())
    assert 'divide the switches: instances = "sharded" in [kitsune], and processes = { kitsune = 2 }' in shown


def test_little_room_and_the_error_of_predictions_are_said(tmp_path):
    write(tmp_path / "c.json", msgspec.structs.replace(COSTS, error=0.12, note="hurried"))
    shown = " ".join(run("--pps", 16_000, "--costs", tmp_path / "c.json").stdout.split())
    assert "little room for bursts" in shown
    assert "(hurried); predictions for two and four switches were off by up to 12%" in shown


def test_json(costs):
    """Demand, figures and costs in one object."""
    found = json.loads(run("--pps", 1000, "--costs", costs, "--json").stdout)
    assert found["demand"]["pps"] == 1000
    assert found["cores"] == pytest.approx(0.06)
    assert found["bottleneck"]["name"] == "kitsune"
    assert found["costs"]["machine"] == "some processor"


def test_json_has_no_infinity(tmp_path):
    idle = msgspec.structs.replace(COSTS, processes={"x": ProcessCost(idle_cores=0.5)})
    write(tmp_path / "c.json", idle)
    answer = run("--pps", 1, "--costs", tmp_path / "c.json", "--json").stdout
    assert json.loads(answer)["bottleneck"]["pps"] is None
    assert "at no rate of packets" in run("--pps", 1, "--costs", tmp_path / "c.json").stdout


@pytest.mark.parametrize(
    ("words", "word"),
    [
        ((), "--pps"),
        (("--pps", "-1"), "--pps -1"),
        (("--pps", "inf"), "--pps inf"),
        (("--pps", "1", "--switches", "0"), "--switches 0"),
        (("--pps", "1", "--costs", "/nowhere/costs.json"), "No such file"),
    ],
)
def test_nonsense_is_named(words, word):
    with pytest.raises(BadInput, match=word):
        run(*words)


def test_a_measurement_is_written_and_used(monkeypatch, tmp_path):
    """Without --pps it is only measured."""
    monkeypatch.setattr(measure, "measured", lambda _schedule, tell: (tell("working"), COSTS)[1])
    monkeypatch.setattr("sdnator.config.planned_switches.require_compiler", lambda: None)
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr("shutil.which", lambda name: name)
    monkeypatch.chdir(tmp_path)
    assert run("--measure").stdout == ""
    assert read(tmp_path / "sdnator-costs.json") == COSTS
    shown = run("--measure", "--pps", 2000, "--costs", tmp_path / "other.json").stdout
    assert "kitsune" in shown
    assert read(tmp_path / "other.json") == COSTS
    with pytest.raises(BadInput, match="there is no folder"):
        run("--measure", "--costs", tmp_path / "none" / "costs.json")


def test_a_measurement_needs_root(monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    with pytest.raises(BadInput, match="root"):
        run("--measure")


def test_the_costs_of_the_product_are_the_default():
    assert plan_command.basis(msgspec.structs.replace(COSTS, note="")).startswith("costs of 2026-11-25")
    assert "Bottleneck: " in run("--switches", 200, "--pps", 20_000).stdout
