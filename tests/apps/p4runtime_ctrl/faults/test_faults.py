"""Whatever breaks, the switch ends up with exactly the desired rules: none stale, none twice, none missing."""

import threading
import time

import pytest

from due import Capability
from sdnator.testing.cable import Cable
from sdnator.testing.controller_run import PACKETS, Bystander, ControllerRun, Heard, block, end, frame
from sdnator.testing.p4runtime_client import P4RuntimeClient
from sdnator.testing.waiting import wait_for

DECISIONS = Capability("network.block.firewall.*", delivery="reliable", archive="always")
CONFIRMATIONS = "network.confirmation.p4runtime_ctrl.*"
STATE = "network.switch.p4runtime_ctrl.s1"
COPIED, FORWARDED = 1, 2
BLOCKED, FREE = 0, COPIED | FORWARDED


class Firewall:
    """Makes decisions as the real one does, and hears what became of them."""

    def __init__(self, stage):
        self.stage = stage
        self.engine = stage.engine(capabilities=(DECISIONS,))
        self.heard = Heard(self.engine, PACKETS, CONFIRMATIONS, STATE)
        self.number = 0

    def decide(self, source, action="block", *, wait="installed"):
        self.number += 1
        decision = block(self.number, source, action)
        self.engine.write("network.block.firewall.ipv4", decision.to_value(), event_time=self.number)
        self.engine.flush()
        if wait:
            wait_for(lambda: (decision.id, wait) in self.said(), why=lambda: (self.said(), self.stage.log()))
        return decision.id

    def said(self):
        return [(value["id"], value["state"]) for value in self.heard.values("confirmation")]

    def state(self):
        states = self.heard.values("network.switch")
        return states[-1] if states else {}


def verdicts(feed, sources):
    """What the switch does with a frame of each source."""
    found = b""
    feed.send([1] * len(sources), [60] * len(sources), [frame(source) for source in sources])

    def all_there():
        nonlocal found
        found += feed.verdicts()
        return len(found) >= len(sources)

    wait_for(all_there)
    return list(found)


def entries(stage):
    """Handles of all block entries in the switch, as its counters show them."""
    return sorted(entry["handle"] for entry in stage["blocks"])


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as made:
        yield made


def test_the_switch_is_killed(stage):
    stage.controller()
    firewall = Firewall(stage)
    wait_for(lambda: firewall.state().get("telemetry") == ["packets"], why=stage.log)
    firewall.decide(1)
    firewall.decide(2)
    before = len(firewall.heard.values("network.switch"))
    stage.target.kill()
    wait_for(lambda: firewall.state()["connected"] is False, why=stage.log)
    late = firewall.decide(3, wait="pending")
    firewall.decide(2, "unblock", wait="pending")
    stage.target.start()
    wait_for(lambda: (late, "installed") in firewall.said(), why=stage.log)
    feed = stage.feed()
    wait_for(
        lambda: firewall.state()["telemetry"] == ["packets"] and firewall.state()["primary"], why=stage.log
    )
    assert verdicts(feed, [1, 2, 3, 4]) == [BLOCKED, FREE, BLOCKED, FREE]
    changes = [state["change"] for state in firewall.heard.values("network.switch")[before:]]
    assert any("program loaded" in change for change in changes), changes
    feed.close()


def test_the_controller_is_killed(stage):
    first = stage.controller()
    firewall = Firewall(stage)
    wait_for(lambda: firewall.state().get("telemetry") == ["packets"], why=stage.log)
    firewall.decide(1)
    firewall.decide(2)
    feed = stage.feed()
    assert verdicts(feed, [1, 2, 3]) == [BLOCKED, BLOCKED, FREE]
    stage.kill(first)
    with Bystander(stage.target.address):
        assert verdicts(feed, [1, 2, 3]) == [BLOCKED, BLOCKED, FREE], "fail open: entries and wires stay"
    firewall.decide(3, wait=None)
    firewall.decide(2, "unblock", wait=None)
    stage.controller()
    wait_for(lambda: verdicts(feed, [1, 2, 3, 4]) == [BLOCKED, FREE, BLOCKED, FREE], why=stage.log)
    left = [f"ingress.block_src[is_ipv4=1,src=10.0.0.{number}]" for number in (1, 3)]
    wait_for(lambda: entries(firewall.state()) == left, why=lambda: (firewall.state(), stage.log()))
    feed.close()


def test_the_connection_is_cut_under_traffic(stage):
    with Cable(stage.target.address) as cable:
        stage.switch_options["address"] = cable.address
        stage.controller(timeout_s=1.0)
        firewall = Firewall(stage)
        wait_for(lambda: firewall.state().get("telemetry") == ["packets"], why=stage.log)
        firewall.decide(1)
        feed = stage.feed()
        done = threading.Event()
        sent = [0]

        def traffic():
            while not done.is_set():
                feed.send([sent[0]] * 20, [60] * 20, [frame(1 + n % 4) for n in range(20)])
                sent[0] += 20
                done.wait(0.02)
                feed.verdicts()

        thread = threading.Thread(target=traffic)
        thread.start()
        try:
            wait_for(lambda: len(firewall.heard.arrivals()) > 100, why=stage.log)
            cable.cut()
            wait_for(lambda: firewall.state()["connected"] is False, why=stage.log)
            late = firewall.decide(2, wait="pending")
            firewall.decide(1, "unblock", wait="pending")
            cable.mend()
            wait_for(lambda: (late, "installed") in firewall.said(), why=stage.log)
            before = len(firewall.heard.arrivals())
            wait_for(lambda: len(firewall.heard.arrivals()) > before + 100, why=stage.log)
        finally:
            done.set()
            thread.join()
        arrivals = firewall.heard.arrivals()
        assert (arrivals[1:] > arrivals[:-1]).all(), "order kept, nothing twice"
        feed.close()
        fresh = stage.feed()
        assert verdicts(fresh, [1, 2, 3]) == [FREE, BLOCKED, FREE]
        wait_for(lambda: firewall.state()["packet_in"] + firewall.state()["lost"] >= len(arrivals))
        fresh.close()


def test_a_standby_controller_takes_over(stage):
    first = stage.controller()
    firewall = Firewall(stage)
    wait_for(lambda: firewall.state().get("telemetry") == ["packets"], why=stage.log)
    firewall.decide(1)
    stage.controller()
    firewall.decide(2)
    stage.kill(first)
    third = firewall.decide(3, wait=None)
    wait_for(lambda: {(third, "installed"), (third, "exists")} & set(firewall.said()), why=stage.log)
    wait_for(
        lambda: firewall.state()["primary"] and firewall.state()["telemetry"] == ["packets"], why=stage.log
    )
    feed = stage.feed()
    assert verdicts(feed, [1, 2, 3, 4]) == [BLOCKED, BLOCKED, BLOCKED, FREE]
    wait_for(lambda: len(firewall.state()["blocks"]) == 3, why=stage.log)
    feed.close()


def test_an_active_controller_takes_its_switch_from_one_whose_clock_is_ahead(stage):
    """As a standby on another machine, which stepped in while this one was away, and hears of no decision."""
    an_hour_ahead = 1 << 64 | time.time_ns() // 1_000_000 + 3_600_000
    with P4RuntimeClient(stage.target.address, election_id=an_hour_ahead) as standby:
        standby.arbitrate()
        stage.controller()
        Firewall(stage).decide(1)


@pytest.mark.parametrize(("fail", "without_controller"), [("open", FORWARDED), ("closed", 0)])
def test_what_happens_to_traffic_without_a_controller_is_configured(tmp_path, fail, without_controller):
    with ControllerRun(tmp_path, fail=fail) as stage:
        controller = stage.controller()
        feed = stage.feed()
        assert verdicts(feed, [4]) == [FORWARDED]
        end(controller)
        with Bystander(stage.target.address):
            assert verdicts(feed, [4]) == [without_controller]
        stage.controller()
        assert verdicts(feed, [4]) == [FORWARDED]
        feed.close()


def test_the_switch_falls_silent_and_comes_to(stage):
    stage.controller(timeout_s=1.0)
    firewall = Firewall(stage)
    wait_for(lambda: firewall.state().get("telemetry") == ["packets"], why=stage.log)
    firewall.decide(1)
    stage.target.pause()
    wait_for(lambda: firewall.state()["connected"] is False, why=stage.log)
    late = firewall.decide(2, wait="pending")
    stage.target.resume()
    wait_for(lambda: {(late, "installed"), (late, "exists")} & set(firewall.said()), why=stage.log)
    feed = stage.feed()
    wait_for(lambda: verdicts(feed, [1, 2, 3]) == [BLOCKED, BLOCKED, FREE], why=stage.log)
    assert "program loaded" not in firewall.state()["change"]
    feed.close()
