"""The packet thread: no fault of it goes unnoticed, and an atomic batch is never seen half."""

import threading
from itertools import count
from pathlib import Path

import pytest

from dataplane.p4runtime.device import Device
from dataplane.p4runtime.trust import AnyProgram
from dataplane.packet_loop import PacketClock, PacketLoop, gathering_s
from dataplane.ports.port import MemoryPort
from sdnator.testing.p4runtime_client import (
    TIMEOUT_S,
    EntryBuilder,
    P4RuntimeClient,
    insert,
    modify,
    program_config,
)
from sdnator.testing.switch_double import SwitchDouble
from tests.dataplane.p4runtime.test_device import until

PROGRAM = Path(__file__).parent / "programs" / "features"


class Broken(MemoryPort):
    def receive(self, limit):  # noqa: ARG002
        raise RuntimeError("a fault")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_fault_ends_the_loop_loudly():
    clock, ended = PacketClock(driven=False), threading.Event()
    port = Broken()
    loop = PacketLoop(Device(1, clock=clock.now), {1: port}, clock, on_end=ended.set)
    loop.start()
    port.inject(b"x")
    assert ended.wait(TIMEOUT_S)
    assert loop.failed
    loop.stop()


def test_stopping_is_no_fault():
    clock, ended = PacketClock(driven=False), threading.Event()
    loop = PacketLoop(Device(1, clock=clock.now), {1: MemoryPort()}, clock, on_end=ended.set)
    loop.start()
    loop.stop()
    assert ended.is_set()
    assert not loop.failed


def test_frames_of_a_stream_are_gathered_and_single_ones_are_not():
    """A millisecond from one round to the next; what took longer does not wait, either."""
    assert gathering_s(1, 0.0002) == 0.0
    assert gathering_s(7, 0.0002) == 0.0
    assert gathering_s(8, 0.0002) == pytest.approx(0.0008)
    assert gathering_s(500, 0.002) == 0.0


def test_a_stream_is_moved_whole_and_in_order():
    """Gathered or not, every frame passes once."""
    with SwitchDouble(programs=AnyProgram()) as switch, P4RuntimeClient(switch.address) as controller:
        config = program_config(PROGRAM)
        controller.arbitrate()
        controller.set_pipeline(config)
        names = EntryBuilder(config.p4info)
        controller.write(insert(names.entry("I.ports", {"sm.ingress_port": 1}, "I.forward", [2])))
        frames = [number.to_bytes(12, "big") + bytes(48) for number in range(1000)]
        for first in range(0, 1000, 20):
            switch.memory[1].inject(*frames[first : first + 20])
        until(lambda: len(switch.memory[2].outgoing) == 1000)
        assert list(switch.memory[2].outgoing) == frames


def test_frames_for_ports_that_do_not_exist_are_counted():
    with SwitchDouble(programs=AnyProgram()) as switch, P4RuntimeClient(switch.address) as controller:
        config = program_config(PROGRAM)
        controller.arbitrate()
        controller.set_pipeline(config)
        names = EntryBuilder(config.p4info)
        controller.write(insert(names.entry("I.ports", {"sm.ingress_port": 1}, "I.forward", [99])))
        controller.write(insert(names.entry("I.ports", {"sm.ingress_port": 2}, "I.forward", [3])))
        switch.memory[1].inject(bytes(60))
        switch.memory[2].inject(bytes(60))
        # either port may be read first
        until(lambda: switch.memory[3].outgoing)
        until(lambda: switch.device.pipeline.switch.statistics()["no_such_port"] == 1)


def test_no_frame_sees_half_of_an_atomic_batch():
    """One of two tables drops every frame, in turns; only a half batch would let a frame through."""
    with SwitchDouble(programs=AnyProgram()) as switch, P4RuntimeClient(switch.address) as controller:
        config = program_config(PROGRAM)
        controller.arbitrate()
        controller.set_pipeline(config)
        names = EntryBuilder(config.p4info)

        def port(action, params=()):
            return names.entry("I.ports", {"sm.ingress_port": 1}, action, params)

        def route(action, params=()):
            return names.entry("I.route", {"h.ip.dst": (0x0A000000, 8)}, action, params)

        port_drops = [port("I.stop"), route("I.counted", [2])]
        route_drops = [port("I.forward", [2]), route("I.drop")]
        other = names.entry("I.ports", {"sm.ingress_port": 9}, "I.forward", [1])
        filler = modify(other)
        controller.write(*map(insert, [*port_drops, other]))
        stop, incoming = threading.Event(), switch.memory[1]
        frame = bytes(12) + b"\x08\x00\x45" + bytes(15) + b"\x0a\x00\x00\x01" + bytes(26)

        def traffic():
            while not stop.is_set():
                if len(incoming._incoming) < 50:
                    incoming.inject(frame)

        sender = threading.Thread(target=traffic)
        sender.start()
        try:
            for turn in count():
                # going back the other way round: either order has a half that leaks
                first, last = reversed(port_drops) if turn % 2 else route_drops
                updates = [modify(first), *[filler] * 1000, modify(last)]
                controller.write(*updates, atomicity="DATAPLANE_ATOMIC")
                if turn >= 39 and incoming.counters.received > 100:
                    break
        finally:
            stop.set()
            sender.join()
        assert not switch.memory[2].outgoing
