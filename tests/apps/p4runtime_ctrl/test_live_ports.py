"""Frames that come in through a real interface reach DUE whole and in order, from either kind of switch."""

import socket
from contextlib import ExitStack

import numpy as np
import pytest

from apps.packets import PACKET_COLUMNS, read_frames
from sdnator.capture.interfaces import VethPair
from sdnator.testing.controller_run import PACKETS, ControllerRun, Heard, frame
from sdnator.testing.switch_target import KINDS
from sdnator.testing.waiting import wait_for
from tests.requirements import optional_program, require_netns

COUNT = 500
WINDOW = 25
"""Frames in flight: few enough for BMv2 on a busy machine."""


@pytest.fixture
def veth():
    """Two ends of a cable; nobody else talks on it."""
    require_netns()
    with ExitStack() as stack:
        cable = VethPair.make(stack, "live")
        yield cable.near, cable.far


@pytest.mark.parametrize("telemetry", ["packet-in", "digest"])
@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_an_interface(kind, telemetry, veth, tmp_path):
    if kind == "bmv2":
        optional_program("simple_switch_grpc")
    near, far = veth
    with ControllerRun(tmp_path, kind=kind, veth=far, forward={}) as stage:
        stage.controller(telemetry=telemetry)
        heard = Heard(stage.engine("listener"), PACKETS, "network.switch.p4runtime_ctrl.s1")
        wait_for(lambda: any(v["telemetry"] == ["packets"] for v in heard.values("switch")), why=stage.log)
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as wire:
            wire.bind((near, 0))
            for number in range(COUNT):
                wire.send(frame(1 + number % 200))
                if number % WINDOW == WINDOW - 1:
                    sent = number + 1
                    wait_for(lambda: len(heard.arrivals()) == sent, why=stage.log)  # noqa: B023 - run at once
        batches = [item.value for item in heard.items if item.key == PACKETS]
        got = {name: np.concatenate([batch[name] for batch in batches]) for name in PACKET_COLUMNS}
        assert got["sequence"].tolist() == list(range(1, COUNT + 1))
        assert (np.diff(got["time_us"]) >= 0).all()
        want = read_frames(
            [frame(1 + number % 200) for number in range(COUNT)],
            lengths=np.full(COUNT, 60),
            times_us=got["time_us"],
            ports=np.ones(COUNT),
            sequence=got["sequence"],
            arrival=np.arange(COUNT),
        )
        assert not [name for name in PACKET_COLUMNS if (got[name] != want[name]).any()]
