"""Ports and wires as typed, and what status and down say where nothing runs."""

import json
import os

import msgspec
import pytest
from typer.testing import CliRunner

from apps.p4runtime_ctrl.state.mac_learning import LearnSettings
from sdnator.cli.status_command import (
    control_lines,
    controlled,
    damage_lines,
    damaged_by_app,
    open_incidents,
    trouble_lines,
)
from sdnator.config.planned_switches import parse_ports, parse_wires, planned
from sdnator.config.up_settings import LearnPlan, SwitchPlan
from sdnator.errors import BadInput
from sdnator.up.planning import model_settings
from sdnator.up.running import claimed
from tests.end_to_end.operator_app import app


@pytest.fixture(autouse=True)
def no_pipeline(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def run(*words):
    return CliRunner().invoke(app, list(words), catch_exceptions=False)


def test_ports_by_number():
    assert parse_ports(["1=veth:lo", "2=null"], "embedded") == {1: "veth:lo", 2: "null"}
    assert parse_ports([], "10.0.0.2:9559") == {}


@pytest.mark.parametrize(
    ("option", "switch", "word"),
    [
        ("1", "embedded", "N=veth:INTERFACE"),
        ("1=veth:", "embedded", "N=veth:INTERFACE"),
        ("1=capture:/x.sock", "embedded", "sdnator replay"),
        ("x=null", "embedded", "1 to 509"),
        ("0=null", "embedded", "1 to 509"),
        ("510=null", "embedded", "1 to 509"),
        ("1=veth:no-such-if", "embedded", "no-such-if"),
        ("1=null", "bmv2", "BMv2"),
        ("1=null", "10.0.0.2:9559", "leave --port out"),
        ("1=null", "somewhere", "HOST:PORT"),
    ],
)
def test_wrong_ports_are_named(option, switch, word):
    with pytest.raises(BadInput, match=word):
        parse_ports([option], switch)


def test_a_port_is_given_once():
    with pytest.raises(BadInput, match="twice"):
        parse_ports(["1=null", "1=null"], "embedded")


def test_ports_that_learn_are_there_and_no_wire_by_themselves():
    learn = LearnPlan(ports=(1, 2))
    plan = SwitchPlan(ports=("1=null", "2=null"), learn=learn)
    assert (planned(plan).forward, planned(plan).learn) == ({}, learn)
    with pytest.raises(BadInput, match="there is no port 2"):
        planned(SwitchPlan(ports=("1=null",), learn=learn))
    with pytest.raises(BadInput, match="closed"):
        planned(msgspec.structs.replace(plan, fail="closed"))
    with pytest.raises(BadInput, match="1 to 509"):
        planned(SwitchPlan(kind="10.0.0.2:9559", learn=LearnPlan(ports=(1, 510))))


def test_where_a_switch_listens_is_an_address():
    assert planned(SwitchPlan(listen="0.0.0.0:9559")).listen == "0.0.0.0:9559"
    for plan, word in (
        (SwitchPlan(listen="9559"), "HOST:PORT"),
        (SwitchPlan(listen="unix:/s", kind="bmv2"), "BMv2"),
        (SwitchPlan(listen="unix:/s", kind="10.0.0.2:9559"), "leave it out"),
    ):
        with pytest.raises(BadInput, match=word):
            planned(plan)


@pytest.mark.parametrize("wrong", [{"ports": (1,)}, {"ports": (1, 1)}, {"age_s": 0.0}, {"limit": 0}])
def test_learning_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match=r"learn\."):
        LearnPlan(**wrong)


def test_learning_defaults_are_the_controllers():
    """The command line does not import the controller, so they stand twice."""
    own = {one.name: one.default for one in msgspec.structs.fields(LearnPlan) if one.name != "ports"}
    its = {one.name: one.default for one in msgspec.structs.fields(LearnSettings) if one.name != "ports"}
    assert own == its


def test_two_ports_are_a_wire_by_themselves():
    """One port only listens; of three, nobody can know."""
    two = {1: "null", 5: "null"}
    assert parse_wires(None, two, "embedded") == {1: 5, 5: 1}
    assert parse_wires(["none"], two, "embedded") == {}
    assert parse_wires(None, {1: "null"}, "embedded") == {}
    assert parse_wires(None, {1: "null", 2: "null", 3: "null"}, "embedded") == {}
    assert parse_wires(["7-8"], {}, "10.0.0.2:9559") == {7: 8, 8: 7}


@pytest.mark.parametrize(
    ("wires", "word"),
    [
        (["1"], "two ports"),
        (["1-1"], "two ports"),
        (["1-x"], "1 to 509"),
        (["1-2", "2-3"], "already joined"),
        (["1-4"], "no port 4"),
    ],
)
def test_wrong_wires_are_named(wires, word):
    with pytest.raises(BadInput, match=word):
        parse_wires(wires, {1: "null", 2: "null", 3: "null"}, "embedded")


def test_a_model_is_used_where_it_exists_and_written_where_not(tmp_path):
    model = tmp_path / "home.model"
    assert model_settings(None) == {}
    assert model_settings(model)["save_model"] == str(model)
    model.write_bytes(b"")
    assert model_settings(model)["load_model"] == str(model)
    with pytest.raises(BadInput, match="--model"):
        model_settings(tmp_path / "none" / "home.model")


def test_status_of_nothing_is_exit_code_1():
    done = run("status")
    assert (done.exit_code, "sdnator up" in done.stdout) == (1, True)
    done = run("status", "--json")
    assert (done.exit_code, json.loads(done.stdout)) == (1, {"running": False, "pid": None})


def test_a_pipeline_that_starts_is_told(tmp_path):
    with claimed(tmp_path / "state" / "sdnator"):
        done = run("status")
    assert (done.exit_code, done.stdout) == (
        1,
        f"a pipeline is starting or stopping (process {os.getpid()})\n",
    )


def test_status_tells_who_closes_a_switch_that_nobody_controls():
    told = {
        "watchdog": False,
        "switches": [
            {"switch": "s1", "connected": True, "primary": True, "fail": "open", "packet_in": 3},
            {"switch": "s2", "connected": False, "primary": False, "fail": "closed", "learnt": 2},
        ],
    }
    control = controlled({"apps": {"p4runtime_ctrl": {"health": {"app": told, "engine": {}}}}})
    assert control["switches"]["s2"] == {
        "connected": False,
        "primary": False,
        "fail": "closed",
        "learnt": 2,
    }
    first, second = control_lines(control, {"s1", "s2"})
    assert first == "switch s1 is under control; it fails open: port forwarding stays without a controller"
    assert "s2 is NOT under control; it fails closed, but NO watchdog runs; 2 MAC addresses learnt" in second
    assert "a watchdog runs" in list(control_lines({**control, "watchdog": True}, {"s2"}))[1]
    assert "closed, and has no port forwarding" in list(control_lines(control, ()))[1]
    assert controlled({"apps": {}}) is None, "the controller has said nothing yet"
    assert list(control_lines(None, ())) == []


def test_status_names_the_process_that_has_each_switch():
    """Any of the controllers that divide the switches may have told."""
    one = {"connected": True, "primary": False, "fail": "open"}
    switches = {
        "s1": {**one, "owner": "i1"},
        "s2": {**one, "owner": "i2", "primary": True},
        "s3": {**one, "owner": "another"},
        "s4": {**one, "owner": ""},
    }
    processes = {"i1": "process 7 on rack", "i2": "process 8 on shelf"}
    said = [line.partition(";")[0] for line in control_lines({"switches": switches}, (), processes)]
    assert said == [
        "switch s1 is under control of process 7 on rack",
        "switch s2 is under control of process 8 on shelf",
        "switch s3 is under control of another instance",
        "switch s4 is NOT under control",
    ]


def test_status_tells_of_a_program_that_leaves_its_arrays():
    calm = {"restarts": 0, "cause": "", "suppressed_lines": 0}
    (line,) = trouble_lines({"firewall": calm, "switch": calm | {"out_of_range": 2}})
    assert line.startswith("the program of switch reached beyond the end of an array 2 times")


def test_status_tells_of_damage_on_disk():
    engine = {"damaged_rows": 1, "archive": {"damaged_spools": 2}}
    apps = {"kitsune": {"health": {"engine": engine}}, "firewall": {"health": {"engine": {}}}}
    damaged = damaged_by_app({"apps": apps})
    assert damaged == {"kitsune": {"rows": 1, "spools": 2}}
    assert list(damage_lines(damaged)) == [
        "kitsune left 1 damaged row of the archive out of its answers",
        "kitsune set 2 damaged pieces of its spool aside",
    ]
    assert damaged_by_app({}) == {}


def test_down_is_content_where_nothing_runs():
    done = run("down")
    assert (done.exit_code, done.stdout) == (0, "no pipeline was running\n")
    assert json.loads(run("down", "--json").stdout) == {"stopped": None}


def test_wrong_archive_is_told_before_anything_starts(tmp_path):
    with pytest.raises(BadInput, match="--archive"):
        run("up", "--archive", "postgres://somewhere")
    assert not (tmp_path / "state" / "sdnator" / "logs").exists()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--engine", "flink"], "give numpy or spark"),
        (["--spark-master", "local[4]"], "only with --engine spark"),
        (["--engine", "spark"], r"pip install 'sdnator\[spark\]'"),
    ],
)
def test_an_engine_that_cannot_run_is_said_before_anything_starts(options, word, monkeypatch):
    monkeypatch.setattr("apps.sonata_adapter.host.spark.find_spec", lambda _: None)
    with pytest.raises(BadInput, match=word):
        run("up", *options)


def test_open_incidents_are_the_firewalls_word():
    """None without a firewall that says so."""
    told = {"apps": {"firewall": {"health": {"app": {"incidents_open": 2}, "engine": {}}}}}
    assert open_incidents(told) == 2
    assert open_incidents({"apps": {}}) is None
