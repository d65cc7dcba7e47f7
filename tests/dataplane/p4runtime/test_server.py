"""The server's one thread waits for nobody: neither for a busy device nor for packet-outs that are crowded."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from dataplane.p4runtime.device import MAX_STREAMS, Device
from dataplane.p4runtime.server import Servicer
from dataplane.p4runtime.trust import AnyProgram
from p4rt import p4runtime
from sdnator.testing.p4runtime_client import TIMEOUT_S, P4RuntimeClient, program_config
from sdnator.testing.switch_double import SwitchDouble
from tests.dataplane.p4runtime.test_device import PROGRAM, frame, number_of, until


@pytest.fixture
def switch():
    with SwitchDouble(programs=AnyProgram()) as made:
        yield made


@pytest.fixture
def controller(switch):
    with P4RuntimeClient(switch.address) as made:
        made.arbitrate()
        made.set_pipeline(program_config(PROGRAM))
        yield made


@contextmanager
def held(lock):
    """Another thread is in the middle of something long."""
    taken, enough = threading.Event(), threading.Event()

    def hold():
        with lock:
            taken.set()
            enough.wait(TIMEOUT_S)

    thread = threading.Thread(target=hold)
    thread.start()
    taken.wait(TIMEOUT_S)
    try:
        yield
    finally:
        enough.set()
        thread.join()


def test_packet_ins_go_on_while_another_controller_waits_for_the_device(switch, controller):
    with P4RuntimeClient(switch.address, election_id=2) as other:
        with held(switch.device.control):
            other.ask_for_arbitration()
            switch.memory[1].inject(*map(frame, range(50)))
            came = [number_of(controller.packets.get(timeout=TIMEOUT_S)) for _ in range(50)]
            assert other.arbitrations.empty()
        assert came == list(range(50))
        assert other.arbitrations.get(timeout=TIMEOUT_S).status.code == 0


class Silent:
    """The context of a call whose client takes nothing."""

    async def write(self, message):
        raise AssertionError(message)


def test_clients_that_give_up_while_a_program_compiles_leave_no_stream_behind():
    device, pool = Device(1, clock=lambda: 0), ThreadPoolExecutor(2 * MAX_STREAMS)

    async def claims():
        yield p4runtime.StreamMessageRequest(arbitration=p4runtime.MasterArbitrationUpdate(device_id=1))

    async def come_and_go():
        servicer = Servicer(device, pool)
        with held(device.control):
            calls = [
                asyncio.create_task(servicer.StreamChannel(claims(), Silent())) for _ in range(MAX_STREAMS)
            ]
            for _ in range(10):
                await asyncio.sleep(0)
            for call in calls:
                call.cancel()
        await asyncio.gather(*calls, return_exceptions=True)

    asyncio.run(come_and_go())
    pool.shutdown()
    for _ in range(MAX_STREAMS):
        device.open_stream()


def test_other_calls_go_on_while_packet_outs_are_crowded_and_none_of_those_is_lost(switch, controller):
    most = 10_000
    with held(switch.device.running):
        for _ in range(most):
            controller.packet_out(frame(), {1: b"\x03", 2: b"\x00"})
        until(switch.device.crowded)
        for _ in range(50):  # while they come, the switch could read on if it did not wait
            assert controller.stub.Capabilities(p4runtime.CapabilitiesRequest(), timeout=TIMEOUT_S)
        assert len(switch.loop._packet_outs) < most
    until(lambda: len(switch.memory[3].outgoing) == most)


def test_servers_come_and_go_in_one_process():
    for _ in range(3):
        with (
            SwitchDouble(programs=AnyProgram()) as one,
            SwitchDouble(programs=AnyProgram()) as two,
            P4RuntimeClient(one.address) as first,
        ):
            with P4RuntimeClient(two.address) as second:
                assert first.arbitrate().status.code == second.arbitrate().status.code == 0
            first.set_pipeline(program_config(PROGRAM))
