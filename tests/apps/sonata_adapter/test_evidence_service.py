"""Evidence among real processes: somebody wants it, the query learns, runs in the switch, and accuses."""

import random

import pytest

from apps.evidence import Evidence, TrainingState
from due import Capability
from sdnator.testing.controller_run import BASE_US, ControllerRun, Heard
from sdnator.testing.query_traffic import BASE_US as TRAFFIC_US
from sdnator.testing.query_traffic import HOSTS, attack, office
from sdnator.testing.waiting import TookTooLong, wait_for

PREFIX = "network.evidence.sonata_adapter"
QUERIES = ("port_scan", "syn_flood", "arp_scan")
TRAINED_S = 70
SETTINGS = {"limits": {"reads": False}}  # frames come much faster than they were captured


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as stage:
        yield stage


def send(feed, frames):
    """All at once; they are through when the switch has answered for each."""
    for begin in range(0, len(frames), 256):
        part = frames[begin : begin + 256]
        feed.send([f.time_us - TRAFFIC_US for f in part], [f.length for f in part], [f.data for f in part])
    verdicts = b""
    while len(verdicts) < len(frames):
        verdicts += feed.verdicts()


def quiet(seconds, start_s=0.0):
    return office(seconds, random.Random(4), TRAFFIC_US + int(start_s * 1e6))


def learning(health):
    """What each query says of itself in the adapter's newest health."""
    found = [value["app"]["evidence_queries"] for value in health.values("health")]
    return found[-1] if found else {}


def came(condition):
    """Whether something came about in half a minute."""
    try:
        wait_for(condition, seconds=30)
    except TookTooLong:
        return False
    return True


@pytest.mark.timeout(400)  # three adapters' starts, and a minute and a half of traffic
def test_queries_learn_and_then_accuse(stage):
    """The benign office says nothing; each attack does; another adapter goes on with what this one learnt."""
    adapter = stage.run("apps.sonata_adapter.service", SETTINGS)
    engine = stage.engine("observer")
    trainer = stage.engine("kitsune", capabilities=[Capability("network.training.*", archive="always")])
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    health = Heard(engine, "due.health.sonata_adapter")
    stage.controller()
    heard = Heard(engine, *(f"{PREFIX}.{name}" for name in QUERIES))
    wait_for(lambda: set(learning(health)) == set(QUERIES), why=stage.log)
    wait_for(lambda: any(state["telemetry"] for state in states.values("network.switch")), why=stage.log)
    feed = stage.feed()
    send(feed, quiet(TRAINED_S))
    state = TrainingState(
        packets=1, wanted=1, done=True, seconds=TRAINED_S, senders=12, event_time=(BASE_US + TRAINED_S * 10**6) * 1000
    )  # fmt: skip
    trainer.write("network.training.kitsune", state.to_value())
    send(feed, quiet(10, TRAINED_S))
    wait_for(lambda: "learning" not in learning(health).values(), why=lambda: learning(health))
    wait_for(lambda: len(engine.get("network.baseline.sonata_adapter.*")) == len(QUERIES), why=stage.log)
    send(feed, quiet(5, TRAINED_S + 10))
    assert not heard.items
    rng = random.Random(5)
    for attempt in range(4):  # a window that is read too late is lost, and counted; attacks go on
        for place, name in enumerate(QUERIES):
            start = TRAFFIC_US + (TRAINED_S + 20 + 30 * attempt + 5 * place) * 10**6
            send(feed, sorted(attack(name, start, rng)))
        send(feed, quiet(5, TRAINED_S + 40 + 30 * attempt))
        if came(lambda: {item.key for item in heard.items} >= {f"{PREFIX}.{name}" for name in QUERIES}):
            break
    else:
        pytest.fail(f"heard only of {sorted({item.key for item in heard.items})}: {stage.log()}")
    found = {name: [] for name in QUERIES}
    for item in heard.items:
        found[item.key.rpartition(".")[2]].append(Evidence.from_value(item.value))
    assert HOSTS["port_scan"] in {evidence.address for evidence in found["port_scan"]}
    assert (HOSTS["syn_flood"],) in {evidence.victims for evidence in found["syn_flood"]}
    senders = {evidence.sender for evidence in found["arp_scan"]} - {None}
    assert {(s.switch, s.port, s.mac) for s in senders} == {("s1", 1, HOSTS["arp_scan"])}
    feed.close()
    stage.kill(adapter)
    health.items.clear()
    stage.run("apps.sonata_adapter.service", SETTINGS)
    wait_for(lambda: "learning" not in (learning(health) or {"": "learning"}).values(), why=stage.log)


def test_a_query_that_cannot_be_evidence_is_answered(stage):
    """With the reason, like a wrong parameter."""
    stage.run("apps.sonata_adapter.service", {})
    engine = stage.engine("observer")
    answers = Heard(engine, "network.incompatible.sonata_adapter.*")
    Heard(engine, f"{PREFIX}.nonsense")
    wait_for(lambda: answers.items)
    assert "there is no such evidence" in answers.items[0].value["reason"]
