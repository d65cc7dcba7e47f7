"""SYN floods that the switch itself counts: real processes, real frames, one flood after the other."""

import time
from contextlib import closing

import pytest

from dataplane.ports.capture_port import COPIED
from sdnator.testing.controller_run import ControllerRun, Heard
from sdnator.testing.query_traffic import SYN, tcp
from sdnator.testing.waiting import wait_for


@pytest.fixture
def stage(tmp_path):
    with ControllerRun(tmp_path) as stage:
        yield stage


def test_the_switch_reports_floods_and_copies_samples_only(stage):
    """Two victims, one after the other: each is guarded, and few of the SYNs were copied."""
    stage.run("apps.sonata_adapter.service", {})
    stage.run("apps.firewall.service", {"learn": False, "arp": "off", "syn": {"resets": 0}})
    engine = stage.engine("observer")
    guards = Heard(engine, "network.protect.firewall.ipv4")
    states = Heard(engine, "network.switch.p4runtime_ctrl.s1")
    stage.controller()
    wait_for(lambda: states.items and states.items[-1].value["telemetry"] == ["q0"], 120, stage.log)
    sent = copied = 0
    begin = time.monotonic()
    with closing(stage.feed()) as feed:
        for victim in ("192.0.2.7", "192.0.2.8"):
            deadline = time.monotonic() + 120
            while victim not in [each["target"]["address"] for each in guards.values("protect")]:
                assert time.monotonic() < deadline, stage.log()
                frames = [
                    tcp(f"10.{number % 250}.{sent % 250}.9", victim, 1024 + number, 80, SYN)
                    for number in range(500)
                ]
                now = int((time.monotonic() - begin) * 1e6)
                feed.send([now + place for place in range(500)], [60] * 500, frames)
                sent += 500
                time.sleep(0.05)
                copied += sum(verdict & COPIED for verdict in feed.verdicts())
    assert copied < sent
    assert engine.health()
