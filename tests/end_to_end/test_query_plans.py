"""What commands tell about queries of a running adapter: its real plan, and why a key is refused."""

import json

import pytest

from sdnator.testing.controller_run import ControllerRun, Heard
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
