"""A replay begins when all queries run: what is missing is said."""

import pytest

from sdnator.replay import readiness
from sdnator.replay.readiness import QueriesReady

SYN = "network.traffic_capture.sonata.tcp:flag=syn"
FLOOD = "network.traffic_query.sonata.syn_flood:threshold=100,window=200ms"


class Coordinator:
    """What the API would answer."""

    def __init__(self):
        self.interests, self.assigned, self.health = [SYN, FLOOD], [], {}

    def ask(self, _url, path):
        assigned = [{"key": key} for key in self.assigned]
        return {
            "/interests": [{"key": key} for key in (*self.interests, "network.anomaly.kitsune.alert")],
            "/assignments": [{"app_id": "sonata_adapter", "assignments": assigned, "incompatible": []}],
            "/health": {"apps": {"sonata_adapter": {"health": {"app": self.health}}} if self.health else {}},
        }[path]


@pytest.fixture
def coordinator(monkeypatch):
    made = Coordinator()
    monkeypatch.setattr(readiness, "ask", made.ask)
    return made


def test_each_step_is_waited_for(coordinator):
    ready = QueriesReady("http://127.0.0.1:1")
    assert not ready.look(["packets"])
    assert "no app produces" in ready.missing
    coordinator.assigned = [SYN, FLOOD]
    assert not ready.look(["packets"])
    assert "0 of 2 queries" in ready.missing
    coordinator.health = {"queries": {"a": "", "b": ""}, "bits": 3, "refused": 0}
    assert not ready.look(["packets", "q0", "q1"])
    assert "2 of 3 requests" in ready.missing
    assert ready.look(["packets", "q0", "q1", "q2"])


def test_app_that_goes_on_asking_is_waited_for(coordinator):
    ready = QueriesReady("http://127.0.0.1:1")
    coordinator.assigned = [SYN, FLOOD]
    coordinator.health = {"queries": {"a": "", "b": ""}, "bits": 1, "refused": 0}
    coordinator.interests = [SYN]
    assert not ready.look(["q0"])
    coordinator.interests = [SYN, FLOOD]
    assert not ready.look(["q0"])
    assert ready.look(["q0"])


def test_query_that_the_adapter_refuses_holds_nothing_up(coordinator):
    coordinator.assigned = [SYN, FLOOD]
    coordinator.health = {"queries": {"a": ""}, "bits": 1, "refused": 1}
    ready = QueriesReady("http://127.0.0.1:1")
    ready.look(["q0"])
    assert ready.look(["q0"])


def test_a_wildcard_asks_for_nothing(coordinator):
    """It receives what others have asked for, so there is no query of its own to wait for."""
    coordinator.interests = [SYN, "network.traffic_query.sonata.*"]
    coordinator.assigned = [SYN]
    coordinator.health = {"queries": {"a": ""}, "bits": 1, "refused": 0}
    ready = QueriesReady("http://127.0.0.1:1")
    ready.look(["q0"])
    assert ready.look(["q0"])
