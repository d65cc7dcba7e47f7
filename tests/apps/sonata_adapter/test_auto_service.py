"""`threshold=auto` among real processes: the query learns, is at its threshold in the switch, and reports attacks only."""

import random

import pytest

from apps.evidence import TrainingState
from apps.sonata_adapter.plan_answer import plan_key
from due import Capability
from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import HOSTS, attack, office
from sdnator.testing.waiting import wait_for
from tests.apps.sonata_adapter.test_evidence_service import send

KEY = "network.traffic_query.sonata.superspreader:threshold=auto"
TRAINED_S = 70


@pytest.mark.timeout(300)
def test_it_learns_and_then_reports_attacks_only(tmp_path):
    """In training and in benign traffic after it nothing; then the attack, counted in the switch."""
    with ControllerRun(tmp_path) as stage:
        stage.run("apps.sonata_adapter.service", {"limits": {"reads": False}})  # faster than it was captured
        engine = stage.engine("observer")
        trainer = stage.engine("kitsune", capabilities=[Capability("network.training.*", archive="always")])
        health = Heard(engine, "due.health.sonata_adapter")
        states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
        stage.controller()
        results = Heard(engine, KEY)
        plans = Heard(engine, plan_key(KEY))
        wait_for(lambda: any(state["telemetry"] for state in states.values("network.switch")), why=stage.log)

        def newest():
            return health.values("health")[-1]["app"] if health.values("health") else {}

        feed = stage.feed()
        rng = random.Random(4)
        send(feed, office(TRAINED_S, rng))
        end_us = BASE_US + TRAINED_S * 10**6
        state = TrainingState(
            packets=1, wanted=1, done=True, seconds=TRAINED_S, senders=12, event_time=end_us * 1000
        )
        trainer.write("network.training.kitsune", state.to_value())
        send(feed, office(10, rng, TRAFFIC_US + TRAINED_S * 10**6))
        wait_for(
            lambda: any("count >=" in text for text in newest().get("auto_thresholds", {}).values()),
            why=lambda: (newest(), stage.log()[-2000:]),
        )
        wait_for(lambda: any(place == "switch" for place in newest()["queries"].values()), why=newest)
        send(feed, office(10, rng, TRAFFIC_US + (TRAINED_S + 10) * 10**6))
        assert not results.items
        for attempt in range(8):  # entries of the new threshold may still be on their way
            start_us = TRAFFIC_US + (TRAINED_S + 30 + 6 * attempt) * 10**6
            send(feed, attack("superspreader", start_us, rng))
            if results.items:
                break
        wait_for(lambda: results.items, why=lambda: (newest(), stage.log()[-2000:]))
        feed.close()
        assert {item.value["src"] for item in results.items} == {HOSTS["superspreader"]}
        assert "threshold=auto" in results.items[0].key
        found = results.items[0].value["count"]  # told once a second: the newest plan may be of the training
        wait_for(
            lambda: plans.items[-1].value["auto"]["new_hosts_threshold"] == found,
            why=lambda: plans.items[-1].value,
        )
        plan = plans.items[-1].value
        assert plan["state"] == "running"
        assert "0.01 false reports an hour" in plan["auto"]["text"]


def test_a_key_that_cannot_have_one_is_answered(tmp_path):
    """With the reason, like a wrong parameter."""
    with ControllerRun(tmp_path) as stage:
        stage.run("apps.sonata_adapter.service", {})
        engine = stage.engine("observer")
        answers = Heard(engine, "network.incompatible.sonata_adapter.*")
        Heard(engine, "network.traffic_query.sonata.new_tcp:threshold=auto,refine=8/16")
        wait_for(lambda: answers.items)
        assert "refine needs a threshold that is a number" in answers.items[0].value["reason"]
