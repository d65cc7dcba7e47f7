"""Packets on their way to controllers: back-pressure where nothing may be lost, counted loss elsewhere."""

import time
from pathlib import Path

import pytest

from dataplane.compiler.machine import BatchResult
from dataplane.p4runtime.device import Device
from dataplane.p4runtime.status import Precondition
from dataplane.p4runtime.trust import AnyProgram
from dataplane.ports.port import MemoryPort
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import TIMEOUT_S, EntryBuilder, P4RuntimeClient, insert, program_config
from sdnator.testing.switch_double import SwitchDouble
from tests.dataplane.loading import MAKERS

PUNT = 15
PROGRAM = Path(__file__).parents[1] / "programs" / "features"


def frame(number=0):
    return bytes(12) + b"\x88\xb5" + bytes([PUNT, 0, 0]) + bytes(16) + number.to_bytes(4, "big") + bytes(30)


def number_of(packet):
    return int.from_bytes(packet.payload[33:37], "big")


def until(condition):
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.fixture
def lossless():
    port = MemoryPort(lossless=True)
    with SwitchDouble(
        programs=AnyProgram(), ports={1: port, 2: MemoryPort()}, driven=True, queue=100
    ) as switch:
        yield switch, port


def primary(switch, election_id=1, **options):
    controller = P4RuntimeClient(switch.address, election_id=election_id, **options)
    controller.arbitrate()
    return controller


def hold_up(switch):
    """The only stream finds nothing to send from now on: a primary as slow as can be."""
    (stream,) = switch.device._streams.values()
    with switch.device.control:
        stream.queue = None


def test_frames_of_a_capture_wait_for_a_primary_and_then_come_all(lossless):
    switch, port = lossless
    with primary(switch) as controller:
        controller.set_pipeline(program_config(PROGRAM))
    until(lambda: not switch.device.room())
    port.inject(*map(frame, range(1000)), time_us=1)
    time.sleep(0.05)
    assert port.counters.received == 0
    with primary(switch, 2) as controller:
        assert [number_of(controller.packets.get(timeout=TIMEOUT_S)) for _ in range(1000)] == list(
            range(1000)
        )
    # a frame's verdict comes after its packet-in has left
    until(lambda: len(port.verdicts) == 1000)
    assert port.verdicts == bytes([1]) * 1000
    assert switch.device.counts["packet_in_dropped"] == 0


def test_a_new_primary_gets_what_the_old_one_was_not_sent(lossless):
    switch, port = lossless
    with primary(switch) as controller:
        controller.set_pipeline(program_config(PROGRAM))
        port.inject(*map(frame, range(200)), time_us=1)
        first = [number_of(controller.packets.get(timeout=TIMEOUT_S)) for _ in range(200)]
        hold_up(switch)
        port.inject(*map(frame, range(200, 3000)), time_us=1)
        until(lambda: not switch.device.room())
        assert port.counters.received > 200
    with primary(switch, 2) as controller:
        second = [number_of(controller.packets.get(timeout=TIMEOUT_S)) for _ in range(2800)]
    assert first + second == list(range(3000))


def test_elsewhere_packet_ins_without_a_primary_are_counted():
    with SwitchDouble(programs=AnyProgram()) as switch:
        with primary(switch) as controller:
            controller.set_pipeline(program_config(PROGRAM))
        until(lambda: switch.device._arbitration.primary() is None)
        switch.memory[1].inject(*[frame()] * 50)
        until(lambda: switch.device.counts["packet_in_dropped"] == 50)
        assert switch.device.counts["packet_in"] == 50


def test_frames_before_the_first_pipeline_are_counted():
    with SwitchDouble(programs=AnyProgram()) as switch:
        switch.memory[1].inject(*[frame()] * 50)
        until(lambda: switch.loop.counts["without_pipeline"] == 50)


def test_a_slow_primary_loses_packets_of_live_ports_and_they_are_counted():
    with SwitchDouble(programs=AnyProgram(), queue=10) as switch, primary(switch) as controller:
        controller.set_pipeline(program_config(PROGRAM))
        hold_up(switch)
        switch.memory[1].inject(*[frame()] * 100)
        until(lambda: switch.device.counts["packet_in_dropped"] == 90)
        assert switch.device.counts["packet_in"] == 100


def test_what_is_shorter_than_the_packet_in_header_is_counted():
    with SwitchDouble(programs=AnyProgram()) as switch, primary(switch) as controller:
        controller.set_pipeline(program_config(PROGRAM))
        result = BatchResult(packet_ins=[b"", b"x", bytes(20)])
        switch.device.deliver(switch.device.pipeline, result, lossless=False)
        assert switch.device.counts["packet_in_malformed"] == 2
        assert len(controller.packets.get(timeout=TIMEOUT_S).payload) == 18


def test_each_role_s_primary_gets_the_packets():
    with (
        SwitchDouble(programs=AnyProgram()) as switch,
        primary(switch) as one,
        primary(switch, 1, role="guard") as two,
    ):
        one.set_pipeline(program_config(PROGRAM))
        switch.memory[1].inject(frame(5))
        assert [number_of(c.packets.get(timeout=TIMEOUT_S)) for c in (one, two)] == [5, 5]


def test_a_role_writes_with_its_own_election_id():
    with (
        SwitchDouble(programs=AnyProgram()) as switch,
        primary(switch, 4) as one,
        primary(switch, 9, role="guard") as two,
    ):
        config = program_config(PROGRAM)
        one.set_pipeline(config)
        names = EntryBuilder(config.p4info)
        two.write(insert(names.entry("I.ports", {"sm.ingress_port": 1}, "I.forward", [2])))


def test_setting_a_pipeline_drops_and_counts_what_the_old_one_left(lossless):
    switch, port = lossless
    with primary(switch) as controller:
        controller.set_pipeline(program_config(PROGRAM))
    until(lambda: not switch.device.room())
    port.inject(*[frame()] * 3, time_us=1)
    with primary(switch, 2) as controller:
        for _ in range(3):
            controller.packets.get(timeout=TIMEOUT_S)
        controller.set_pipeline(program_config(PROGRAM))
    assert switch.device.counts["packet_in"] == 3


def test_streams_are_limited():
    with SwitchDouble(programs=AnyProgram()) as switch:
        controllers = [primary(switch, n + 1) for n in range(16)]
        late = P4RuntimeClient(switch.address, election_id=99)
        assert late.ended.wait(TIMEOUT_S)
        assert late.error.code().name == "RESOURCE_EXHAUSTED"
        for controller in (*controllers, late):
            controller.close()


def test_a_claim_that_is_carried_out_after_its_stream_was_closed_makes_no_primary():
    device = Device(1, clock=lambda: 0)
    gone, here = device.open_stream(), device.open_stream()
    claim = p4runtime.MasterArbitrationUpdate(device_id=1)
    claim.election_id.low = 5
    device.close_stream(gone)
    device.arbitrate(gone, claim)
    claim.election_id.low = 1
    device.arbitrate(here, claim)
    with pytest.raises(Precondition, match="no pipeline"):  # and not that it may not write
        device.write(p4runtime.WriteRequest(device_id=1, election_id=claim.election_id))


def test_time_comes_with_the_frames(lossless):
    switch, port = lossless
    with primary(switch) as controller:
        config = program_config(PROGRAM)
        controller.set_pipeline(config)
        names = EntryBuilder(config.p4info)
        controller.write(
            insert(names.entry("I.route", {"h.ip.dst": (1, 32)}, "I.drop", idle_timeout_ns=60 * 10**9))
        )
        port.inject(frame(), time_us=59_000_000)
        controller.packets.get(timeout=TIMEOUT_S)
        assert controller.others.empty()
        port.inject(frame(), time_us=60_000_001)
        told = controller.others.get(timeout=TIMEOUT_S)
        assert told.table_entry[0].idle_timeout_ns == 60 * 10**9


@pytest.mark.parametrize("maker", MAKERS)
def test_an_entry_s_age_begins_when_it_is_written(maker):
    """Also on a pipeline that has not seen a frame yet, in the middle of a capture."""
    port = MemoryPort(lossless=True)
    with (
        SwitchDouble(programs=AnyProgram(), ports={1: port}, driven=True, maker=maker) as switch,
        primary(switch) as controller,
    ):
        config = program_config(PROGRAM)
        controller.set_pipeline(config)
        port.inject(frame(), time_us=500_000_000)
        controller.packets.get(timeout=TIMEOUT_S)
        controller.set_pipeline(config)
        entry = EntryBuilder(config.p4info).entry(
            "I.route", {"h.ip.dst": (1, 32)}, "I.drop", idle_timeout_ns=60 * 10**9
        )
        controller.write(insert(entry))
        port.inject(frame(), time_us=559_000_000)
        controller.packets.get(timeout=TIMEOUT_S)
        assert controller.others.empty()
        port.inject(frame(), time_us=560_000_001)
        assert len(controller.others.get(timeout=TIMEOUT_S).table_entry) == 1
