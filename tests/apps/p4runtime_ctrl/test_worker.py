"""What a switch's worker does first."""

import threading

from apps.p4runtime_ctrl.settings import Settings, SwitchSettings
from apps.p4runtime_ctrl.telemetry.classifier import TelemetryRequest
from apps.p4runtime_ctrl.telemetry.demand import Demand
from apps.p4runtime_ctrl.worker import SwitchWorker
from sdnator.testing.product_program import program
from sdnator.testing.waiting import wait_for
from tests.apps.p4runtime_ctrl.state.test_desired_switch import Held, decision

MINE = SwitchSettings(name="s1", address="", device_id=1)


class Written:
    """What the agent uses of an engine."""

    def __init__(self):
        self.items = []

    def write(self, key, value, *_, **__):
        self.items.append((key, value))
        return True

    def confirmed(self):
        return [(value["id"], value["state"]) for key, value in self.items if "confirmation" in key]

    def counted(self):
        return [block["id"] for key, value in self.items if ".switch." in key for block in value["blocks"]]


class Connected:
    """A connection that is there from the start."""

    works = True

    def __init__(self, _):
        pass

    def stand(self, *, active):
        pass

    def open(self):
        pass

    def close(self):
        pass

    def break_off(self):
        pass


class Slow(Held):
    """A switch too busy to tell its counters before it is let."""

    broken = False

    def __init__(self):
        super().__init__()
        self.asked, self.let = threading.Event(), threading.Event()

    def read_counters(self, table_id):
        self.asked.set()
        assert self.let.wait(60)
        return super().read_counters(table_id)


def test_a_decision_does_not_wait_for_counters():
    engine, switch = Written(), Slow()
    settings = Settings(switches=(MINE,), program="", p4info="", restore=False)
    agent = SwitchWorker(engine, settings, MINE, program(), Connected)
    agent.start(active=True)
    agent.became_primary(switch)
    agent.decide(decision(1), 1)
    assert switch.asked.wait(60)
    agent.decide(decision(2, address="10.0.0.2"), 2)
    wait_for(lambda: ("d2", "installed") in engine.confirmed(), 60)
    assert not engine.counted()
    switch.let.set()
    wait_for(lambda: set(engine.counted()) >= {"d1", "d2"}, 60)
    agent.stop()


def test_a_switch_that_sees_copies_only_carries_no_decision_out():
    """An entry's counter there would claim that something was stopped."""
    engine = Written()
    mine = SwitchSettings(name="s1", address="", device_id=1, mirror=True)
    settings = Settings(switches=(mine,), program="", p4info="", restore=False)
    agent = SwitchWorker(engine, settings, mine, program(), Connected)  # type: ignore[arg-type]
    agent.start(active=True)
    try:
        agent.became_primary(Held())  # type: ignore[arg-type]
        agent.decide(decision(1), 1)
        agent.say_again()
        wait_for(lambda: [value for key, value in engine.items if ".switch." in key and value["primary"]])
        assert agent.health()["mirror"] is True
        assert (engine.confirmed(), agent.health()["blocks_total"]) == ([], 0)
    finally:
        agent.stop()


def test_time_of_a_silent_live_switch_goes_on():
    """So that blocks end though no packet comes."""
    engine = Written()
    mine = SwitchSettings(name="s1", address="", device_id=1, clock="own")
    settings = Settings(switches=(mine,), program="", p4info="", restore=False)
    agent = SwitchWorker(engine, settings, mine, program(), Connected)
    agent.start(active=True)

    def ticked():
        agent.tick()
        return len({value["event_time"] for key, value in engine.items if ".switch." in key}) >= 2

    try:
        wait_for(ticked, 60)
    finally:
        agent.stop()


def test_what_the_switch_cannot_hold_is_named_and_takes_nothing_from_others(caplog):
    engine = Written()
    settings = Settings(switches=(MINE,), program="", p4info="", restore=False)
    agent = SwitchWorker(engine, settings, MINE, program(), Connected)
    agent.start(active=True)
    everything = TelemetryRequest(name="packets", bit=255)
    impossible = TelemetryRequest(name="far", bit=3, conditions={"ingress_port": 600})
    routes = {"packets": {"all": 255, "far": 3}}
    try:
        agent.became_primary(Held())
        agent.want(Demand((everything, impossible), routes))
        wait_for(lambda: agent.health()["telemetry"] == ["packets"], 60)
        wait_for(lambda: "left out: far" in agent.health()["change"], 60)
        assert agent.health()["left_out"] == ["far"]
        assert "far: ingress.telemetry_link ingress_port: 600 does not fit" in caplog.text
        agent.want(Demand((everything,)))
        wait_for(lambda: agent.health()["left_out"] == [], 60)
    finally:
        agent.stop()
