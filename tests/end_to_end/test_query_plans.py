"""What commands tell about queries of a running adapter: its real plan, and why a key is refused."""

import json

import pytest

from sdnator.testing.controller_run import ControllerRun, Heard
from sdnator.testing.oracles import sonata as oracle
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import mixed
from sdnator.testing.waiting import wait_for
from tests.end_to_end.command import sdnator

PREFIX = "network.traffic_query.sonata"


@pytest.fixture
def stage(tmp_path, monkeypatch):
    monkeypatch.setenv("SDNATOR_QUERIES", str(tmp_path / "queries"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with ControllerRun(tmp_path) as stage:
        yield stage


def asked(stage, *words):
    done = sdnator(*words, "--updates", stage.server.url, "--json")
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def test_explain_tells_the_plan_of_the_running_adapter(stage):
    """A switch with a single stage has room for one query: a second is on the host, though alone it would not be."""
    stage.run("apps.sonata_adapter.service", {"limits": {"stages": 1, "cells": 8192}})
    engine = stage.engine("observer")
    assert asked(stage, "queries", "explain", "new_tcp")["state"] == "possible"
    Heard(engine, f"{PREFIX}.new_tcp:threshold=9")
    wait_for(
        lambda: asked(stage, "queries", "explain", "new_tcp:threshold=9")["state"] == "running",
        120,
        why=lambda: asked(stage, "queries", "explain", "new_tcp:threshold=9"),
    )
    first = asked(stage, "queries", "explain", "new_tcp:threshold=9")
    assert first["in_switch"]
    assert first["entries"][0]["table"] == "ingress.count_0.queries"
    second = asked(stage, "queries", "explain", "new_tcp:threshold=10")
    assert (second["state"], second["in_switch"], second["others"]) == ("possible", False, 1)
    assert "no counting stage" in second["reason"]
    alone = json.loads(sdnator("queries", "explain", "new_tcp:threshold=10", "--empty", "--json").stdout)
    assert alone["in_switch"]


def test_observe_tells_why_a_key_is_refused(stage):
    """Every observer is told, not the first one only: what is wrong and what would do."""
    stage.run("apps.sonata_adapter.service", {})
    for _ in range(2):
        done = sdnator(
            "observe", f"{PREFIX}.new_tcp:window=1ms", "--for", "60s", "--updates", stage.server.url
        )
        assert done.returncode == 2
        assert "100ms to 1h" in done.stderr
    done = sdnator("observe", f"{PREFIX}.new_tcp:size=1", "--for", "60s", "--updates", stage.server.url)
    assert "no parameter size; there are window, threshold" in done.stderr


def test_explain_follows_a_key_from_the_wish_to_the_archive(stage):
    """Who wants it, the assignment, the plan, the entry with its counter, what came back, and the last result."""
    stage.run("apps.sonata_adapter.service", {})
    engine = stage.engine("observer")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    stage.controller()
    key = f"{PREFIX}.new_tcp:threshold=10,window=2s"
    results = Heard(engine, key)
    wait_for(lambda: states.items and states.items[-1].value["telemetry"] == ["q0"], 120, stage.log)
    where = [
        "--updates",
        stage.server.url,
        "--archive",
        stage.archive,
        "--switch",
        stage.target.address,
        "--insecure",
    ]
    where += ["--url", stage.processes[0].wait_ready()["http"]]

    def explained(*more):
        done = sdnator("explain", key, *where, *more)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    wait_for(lambda: json.loads(explained("--json"))["switches"][0]["entries"][0]["handle"], 240)
    frames = mixed(["new_tcp"], seconds=6)
    feed = stage.feed()
    feed.send([f.time_us - TRAFFIC_US for f in frames], [f.length for f in frames], [f.data for f in frames])
    seen = 0

    def processed():
        nonlocal seen
        seen += len(feed.verdicts())
        return seen >= len(frames) and results.items

    wait_for(processed, 120, stage.log)
    feed.close()
    wait_for(lambda: json.loads(explained("--json"))["archive"]["last"], 240)
    one = json.loads(explained("--json"))
    assert [each["app_id"] for each in one["coordinator"]["wanted_by"]] == ["observer"]
    assert one["coordinator"]["assigned"][0]["app_id"] == "sonata_adapter"
    assert one["plan"]["state"] == "running"
    assert {each["place"] for each in one["plan"]["operators"]} == {"switch"}
    (entry,) = one["switches"][0]["entries"]
    assert entry["handle"].startswith("ingress.count_0.queries[")
    assert entry["packets"] == sum(oracle.is_syn(oracle.read(*frame)) for frame in frames)
    assert one["plan"]["came"]["reports"] >= one["plan"]["results"] == len(results.items)
    assert one["archive"]["last"]["value"]["dst"] == results.items[-1].value["dst"]
    text = explained()
    assert f"observer wants {key}" in text
    assert "counting stage 0" in text
    refused = sdnator("explain", f"{PREFIX}.new_tcp:window=1ms", *where)
    assert "refused: " in refused.stdout
    assert "100ms to 1h" in refused.stdout
    assert "nobody wants it" in refused.stdout
