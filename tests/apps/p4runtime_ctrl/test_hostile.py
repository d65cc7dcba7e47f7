"""The controller refuses what is no message, counts it, and goes on with what is one."""

import contextlib

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from apps.messages import Decision, RateLimit, TableCommand, TableUpdate, Target
from apps.p4runtime_ctrl.service import INTERESTS, P4RuntimeCtrlService
from apps.p4runtime_ctrl.settings import Settings
from due import RecordBatch
from sdnator.testing.controller_run import block
from sdnator.testing.product_program import P4INFO, PROGRAM
from tests.apps.hostile import NOW, Hands, mutations, values
from tests.apps.p4runtime_ctrl.fake_switch import FakeSwitch

UPDATE = TableUpdate(
    kind="insert", table="block_src", match={"is_ipv4": 1, "src": "10.9.9.9"}, action="drop_src"
)
METER = Decision(
    id="m1",
    action="meter",
    switch="s1",
    target=Target(kind="ip", address="10.0.0.1"),
    reason="a flood",
    event_time=NOW,
    expires=0,
    limit=RateLimit(kind="udp_from", port=53, rate=20, spared=("192.0.2.53",), spared_rate=40),
)
COLUMNS = ("id", "query", "src_hi", "src_lo", "dst_hi", "dst_lo", "port", "length", "source_port", "sweep")
GENUINE = {
    "network.block.firewall.*": ("network.block.firewall.ipv4", block(1, 1).to_value()),
    "network.protect.firewall.*": ("network.protect.firewall.ipv4", block(1, 1).to_value()),
    "network.meter.firewall.*": ("network.meter.firewall.ipv4", METER.to_value()),
    "network.p4_command.*.*": (
        "network.p4_command.listener.s1",
        TableCommand(id="c", updates=(UPDATE,)).to_value(),
    ),
    "network.telemetry.*.*": (
        "network.telemetry.sonata.q1",
        {"name": "q1", "bit": 1, "conditions": {"dport": 53, "src": "10.0.0.0/8"}},
    ),
    "network.cell_request.*.*": (
        "network.cell_request.sonata_adapter.s1",
        RecordBatch({**{name: np.ones(2, "u1") for name in COLUMNS}, "time_us": np.array([1, 2], "i8")}),
    ),
    "network.packet_out.*.*": (
        "network.packet_out.firewall.s1",
        {"port": np.array([1], "u2"), "length": np.array([3], "u2"), "frames": b"abc"},
    ),
    "network.clock.*.*": ("network.clock.replay.s1", {"event_time": NOW}),
}


@contextlib.contextmanager
def controller(*, learn=None, **options):
    """A service on an engine that is none, in control of a switch that is none."""
    with FakeSwitch() as switch:
        settings = {"name": "s1", "address": switch.address, "forward": {"1": 2}, "learn": learn}
        engine = Hands()
        files = {"program": str(PROGRAM), "p4info": str(P4INFO)}
        made = msgspec.convert({"switches": [settings], **files, **options}, Settings)
        service = P4RuntimeCtrlService(engine, made)
        service.start()
        try:
            yield engine, service, switch
        finally:
            service.stop()


def still_works(engine, service, number):
    """A genuine decision is carried out, and no thread has ended."""
    engine.hand("network.block.firewall.*", "network.block.firewall.ipv4", block(number, number).to_value())
    engine.until(
        lambda: any(
            v["id"] == f"d{number}" and v["state"] == "installed" for v in engine.values("network.conf")
        )
    )
    service.tick()


def test_all_interests_are_tried():
    """A new interest of the controller has to be fuzzed, too."""
    assert {interest.key for interest in INTERESTS} == GENUINE.keys()


@pytest.mark.parametrize("pattern", GENUINE)
def test_hostile_values_are_refused_and_counted(pattern, caplog):
    """Every wrong value under every key leaves the controller alive; the log stays short."""
    key, genuine = GENUINE[pattern]
    with controller() as (engine, service, _):
        number = 0
        for number, value in enumerate(mutations(genuine), start=1):  # noqa: B007 - the last one is used
            engine.hand(pattern, key, value)
        still_works(engine, service, 7)
        health = service.health()
    assert health["refused_messages"] > number / 3
    assert sum(health["refused_by_cause"].values()) == health["refused_messages"]
    assert sum("refused a message" in record.message for record in caplog.records) < 20


@pytest.mark.parametrize("pattern", GENUINE)
def test_nobody_speaks_for_another_app(pattern):
    """A genuine message under another app's key does nothing, and is counted."""
    key, genuine = GENUINE[pattern]
    with controller() as (engine, service, _):
        engine.hand(pattern, key, genuine, app="intruder")
        still_works(engine, service, 7)
        assert service.health()["refused_by_cause"] == {"sender": 1}
        assert {value["id"] for value in engine.values("network.confirmation")} == {"d7"}


def test_offers_take_no_bit_and_no_name_of_another():
    """A clash, or a condition that cannot be, is refused as it comes: it would hold up all telemetry."""
    pattern, offer = "network.telemetry.*.*", {"name": "q1", "bit": 1, "conditions": {}}
    with controller() as (engine, service, _):
        engine.hand(pattern, "network.telemetry.sonata.q1", offer)
        engine.hand(pattern, "network.telemetry.other.q1", {**offer, "bit": 2})
        engine.hand(pattern, "network.telemetry.other.q2", {**offer, "name": "q2"})
        for number, wrong in enumerate(([1, 2, 3], [], "10.0.0.0/200", {}, 1 << 60)):
            value = {"name": f"w{number}", "bit": 10 + number, "conditions": {"src": wrong}}
            engine.hand(pattern, f"network.telemetry.other.w{number}", value)
        health = service.health()
        assert (health["offers"], health["refused_messages"]) == (1, 7)
        engine.hand(pattern, "network.telemetry.sonata.q1", {**offer, "active": False})
        assert service.health()["offers"] == 0


def test_requests_come_and_go_with_the_command_that_has_their_entries():
    """One that cannot be read refuses the whole command; one that clashes is refused alone."""
    pattern, key = "network.p4_command.*.*", "network.p4_command.sonata_adapter.s1"
    request = {"name": "q1", "bit": 1, "conditions": {"protocol": 6}, "copy": False}

    def command(number, *requests):
        return TableCommand(id=f"c{number}", updates=(), requests=requests).to_value()

    with controller() as (engine, service, _):
        engine.hand(pattern, key, command(1, request, {**request, "name": "q2", "bit": 2}))
        assert service.health()["offers"] == 2
        engine.hand(pattern, key, command(2, {"name": "q3"}))
        engine.hand(pattern, key, command(3, {**request, "name": "q4"}, {**request, "name": "q5", "bit": 5}))
        health = service.health()
        assert (health["offers"], health["refused_messages"]) == (3, 2)
        engine.hand(pattern, "network.p4_command.sonata_adapter.s2", command(4, {**request, "active": False}))
        assert service.health()["offers"] == 3, "of a switch that is another controller's"
        engine.hand(pattern, key, command(5, {**request, "active": False}))
        assert service.health()["offers"] == 2


def test_any_plain_value_under_any_key():
    """Whatever values hypothesis makes, no callback raises."""
    with controller() as (engine, service, _):

        @settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
        @given(values)
        def hand(value):
            for pattern, (key, genuine) in GENUINE.items():
                engine.hand(pattern, key, value)
                if isinstance(genuine, dict) and isinstance(value, dict):
                    engine.hand(pattern, key, {**genuine, **value})

        hand()
        still_works(engine, service, 7)
