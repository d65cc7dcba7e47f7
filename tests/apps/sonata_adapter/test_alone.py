"""The real switch program counts each query alone, and refines one: results are the naive evaluator's."""

import random
import time
from contextlib import closing

import pytest

from apps.sonata_adapter.query.catalogue import PAPER
from benchmarks.sonata_sets import SetsStage
from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import HOSTS, TimedFrame, mixed, office, udp
from sdnator.testing.waiting import wait_for
from tests.apps.sonata_adapter import quick_health
from tests.apps.sonata_adapter.query.test_catalogue import expect

ADAPTER = "apps.sonata_adapter.service"


class QuickStage(SetsStage):
    """A round ends when three reports of the adapter's health are equal: they come more often than a second apart."""

    def run(self, module, *settings):
        return super().run(quick_health.__name__ if module == ADAPTER else module, *settings)


@pytest.mark.timeout(600)
def test_each_query_alone_is_right_and_counted_in_the_switch(tmp_path):
    """One after the other in one switch, so that each counts in cells that others have used."""
    with QuickStage(tmp_path) as stage:
        for number, name in enumerate(PAPER, start=1):
            outcome = stage.round((name,), mixed((name,), seconds=4), number)
            assert (outcome.wrong, outcome.in_switch) == ([], [name]), stage.log()[-2000:]


@pytest.mark.timeout(300)
def test_all_queries_of_the_paper_are_counted_in_one_switch(tmp_path):
    """All eleven at once, each under attack: none falls back to the host, none disturbs another."""
    with QuickStage(tmp_path) as stage:
        outcome = stage.round(PAPER, mixed(PAPER, seconds=8), 1)
        assert (outcome.wrong, outcome.in_switch) == ([], sorted(PAPER)), stage.log()[-2000:]


def spreading(seconds):
    """An office, and a host that sends to 80 others in every second."""
    frames = office(seconds, random.Random(3))
    for place in range(int(seconds * 80)):
        at = TRAFFIC_US + int(place * 1e6 / 80)
        frames.append(TimedFrame(at, 60, udp(HOSTS["superspreader"], f"10.5.{place % 80}.1", 4000, 4000)))
    return sorted(frames)


@pytest.mark.timeout(300)
def test_refinement_finds_a_lasting_attack_and_reports_nothing_else(tmp_path):
    """Coarse prefixes first: only results that the query has without refinement, and the attacker among them."""
    key = "network.traffic_query.sonata.superspreader:refine=8/16,window=1s"
    with ControllerRun(tmp_path) as stage:
        stage.run("apps.sonata_adapter.service", {})
        engine = stage.engine("observer")
        states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
        commands = Heard(engine, "network.p4_command.sonata_adapter.s1")
        health = Heard(engine, "due.health.sonata_adapter")
        stage.controller()
        results = Heard(engine, key)
        wait_for(lambda: any(state["telemetry"] for state in states.values("network.switch")), why=stage.log)
        coarse = sum(len(item.value["updates"]) for item in commands.items)
        frames = spreading(12)
        begin = time.monotonic()
        with closing(stage.feed()) as feed:
            for first in range(0, len(frames), 16):
                part = frames[first : first + 16]
                time.sleep(max(0.0, (part[-1].time_us - TRAFFIC_US) / 1e6 - (time.monotonic() - begin)))
                feed.send(
                    [f.time_us - TRAFFIC_US for f in part], [f.length for f in part], [f.data for f in part]
                )
            wait_for(lambda: results.items, why=lambda: (health.values("health")[-1:], stage.log()[-2000:]))
        shifted = [TimedFrame(f.time_us - TRAFFIC_US + BASE_US, f.length, f.data) for f in frames]
        truth = {
            (f.window, dict(f.fields)["src"]) for f in expect("superspreader", shifted, {"window": 1000})
        }
        found = [(item.value["window_start"] // 10**9, item.value["src"]) for item in results.items]
        assert set(found) <= truth
        assert len(found) == len(set(found))
        assert HOSTS["superspreader"] in {source for _, source in found}
        assert all(place == "switch" for place in health.values("health")[-1]["app"]["queries"].values())
        assert sum(len(item.value["updates"]) for item in commands.items) > coarse, "finer entries came"
