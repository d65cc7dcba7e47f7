"""The adapter among real processes: a key is declared, a query runs in the switch, and leaves with the key."""

import time
from contextlib import closing
from functools import partial

import pytest

from apps.sonata_adapter.query.catalogue import CATALOGUE
from dataplane.ports.capture_port import COPIED
from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard, end
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import TimedFrame, mixed
from sdnator.testing.waiting import wait_for
from tests.apps.sonata_adapter.query.test_catalogue import expect

PREFIX = "network.traffic_query.sonata"
ENTERED = ("installed", "exists")


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as stage:
        yield stage


def telemetry(states):
    """What the newest state of the switch says that it sends."""
    found = states.values("network.switch")
    return found[-1]["telemetry"] if found else []


def test_all_queries_together_find_what_each_finds(stage):
    """All keys of the catalogue, twice as fast as the traffic came: results equal the naive evaluator's, and the switch has
    counted what it has room for.
    """
    adapter = stage.run("apps.sonata_adapter.service", {})
    engine = stage.engine("observer")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    confirmations = Heard(engine, "network.confirmation.p4runtime_ctrl.s1")
    commands = Heard(engine, "network.p4_command.sonata_adapter.s1")
    health = Heard(engine, "due.health.sonata_adapter")
    stage.controller()
    # until it has heard of the Coordinator the controller asks for everything
    wait_for(lambda: states.values("network.switch") and telemetry(states) == [], why=stage.log)
    keys = {name: f"{PREFIX}.{name}:window=2s" for name in CATALOGUE}
    results = Heard(engine, *keys.values())
    wait_for(
        lambda: is_set_up(len(keys), states, health, commands, confirmations),
        why=lambda: (telemetry(states), stage.log()[-3000:]),
    )
    frames = mixed(CATALOGUE, seconds=8)
    with closing(stage.feed()) as feed:
        copied = play(feed, frames)
    wait_for(lambda: states.values("network.switch")[-1]["packet_in"] >= copied, why=stage.log)
    health.items.clear()
    wait_for(lambda: quiet(health))
    app = health.values("health")[-1]["app"]
    end(adapter)
    shifted = [TimedFrame(f.time_us - TRAFFIC_US + BASE_US, f.length, f.data) for f in frames]
    for name in CATALOGUE:
        truth = {(f.window, f.fields) for f in expect(name, shifted, {"window": 2000})}
        wait_for(partial(at_least, results, name, truth), why=partial(found, results, name))
        assert found(results, name) == truth
    results.stop()
    counted = {
        key.partition(":")[0].rpartition(".")[2] for key, place in app["queries"].items() if place == "switch"
    }
    assert counted >= {"new_tcp", "superspreader", "port_scan", "ddos", "syn_flood", "incomplete_flows"}
    assert app["reports"] > 0


def play(feed, frames):
    """Feed frames twice as fast as they came; returns how many were copied to the controller."""
    begin, verdicts = time.monotonic(), b""
    for first in range(0, len(frames), 32):
        part = frames[first : first + 32]
        ahead = (part[-1].time_us - TRAFFIC_US) / 2e6 - (time.monotonic() - begin)
        time.sleep(max(0.0, ahead))
        feed.send([f.time_us - TRAFFIC_US for f in part], [f.length for f in part], [f.data for f in part])
        verdicts += feed.verdicts()

    def processed():
        nonlocal verdicts
        verdicts += feed.verdicts()
        return len(verdicts) >= len(frames)

    wait_for(processed)
    return sum(verdict & COPIED for verdict in verdicts)


def is_set_up(queries, states, health, commands, confirmations):
    """The switch has all bits and all counting entries of as many queries: they come on streams of their own."""
    app = health.values("health")[-1]["app"] if health.items else {"queries": (), "bits": -1}
    asked = sum(len(item.value["updates"]) for item in commands.items)
    answered = sum(str(item.value["id"]).startswith("sonata-") for item in confirmations.items)
    return (len(app["queries"]), app["bits"]) == (queries, len(telemetry(states))) and answered >= asked


def quiet(health):
    """Nothing has reached the adapter between its last three reports of health."""
    counts = [(v["app"]["host_packets"], v["app"]["reports"]) for v in health.values("health")[-3:]]
    return len(counts) == 3 and len(set(counts)) == 1 and min(counts[0]) > 0


def at_least(results, name, truth):
    return found(results, name) >= truth


def found(results, name):
    rows = set()
    for item in results.items:
        if item.key.startswith(f"{PREFIX}.{name}:"):
            value = dict(item.value)
            start, _, _ = value.pop("window_start"), value.pop("window_end"), value.pop("at")
            for extra in ("exact", "partial", "error"):
                value.pop(extra, None)
            rows.add((start // 2_000_000_000, tuple(sorted(value.items()))))
    return rows


def test_two_consumers_share_and_the_last_one_removes(stage):
    """One entry for two consumers of a key; gone in two seconds when the last one leaves."""
    stage.run("apps.sonata_adapter.service", {})
    engine, other = stage.engine("observer"), stage.engine("other")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    stage.controller()
    first = Heard(engine, f"{PREFIX}.new_tcp:threshold=5")
    second = Heard(other, f"{PREFIX}.new_tcp:threshold=5")
    wait_for(lambda: telemetry(states) == ["q0"], why=stage.log)
    first.stop()
    second.stop()
    wait_for(lambda: telemetry(states) == [], why=stage.log)


def test_wrong_parameter_is_answered(stage):
    """A value out of bounds is answered with what would do."""
    stage.run("apps.sonata_adapter.service", {})
    engine = stage.engine("observer")
    answers = Heard(engine, "network.incompatible.sonata_adapter.*")
    Heard(engine, f"{PREFIX}.new_tcp:window=1ms")
    wait_for(lambda: answers.items)
    assert "100ms to 1h" in answers.items[0].value["reason"]


def test_a_killed_adapter_leaves_nothing(stage):
    """kill -9, then another instance: what the first put into the switch goes, what is wanted comes."""
    first = stage.run("apps.sonata_adapter.service", {})
    engine = stage.engine("observer")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    confirmations = Heard(engine, "network.confirmation.p4runtime_ctrl.s1")
    stage.controller()
    Heard(engine, f"{PREFIX}.new_tcp:threshold=7")
    wait_for(lambda: telemetry(states) == ["q0"] and confirmations.items, why=stage.log)
    wait_for(lambda: engine.get("network.p4_command.sonata_adapter.s1"))
    stage.kill(first)
    stage.run("apps.sonata_adapter.service", {})
    wait_for(
        lambda: "removed" in [item.value["state"] for item in confirmations.items],
        why=lambda: ([item.value for item in confirmations.items], stage.log()[-2000:]),
    )
    wait_for(lambda: confirmations.items[-1].value["state"] in ENTERED)


def test_a_new_controller_is_told_everything(stage):
    """kill -9 of the controller, then another one: the switch has what is wanted again."""
    stage.run("apps.sonata_adapter.service", {})
    controller = stage.controller()
    engine = stage.engine("observer")
    Heard(engine, f"{PREFIX}.ddos", "network.traffic_capture.sonata.udp:dport=53")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    wait_for(lambda: len(telemetry(states)) == 5, why=lambda: (telemetry(states), stage.log()[-2000:]))
    stage.kill(controller)
    states.items.clear()
    stage.controller()
    wait_for(lambda: len(telemetry(states)) == 5, why=lambda: (telemetry(states), stage.log()[-2000:]))
