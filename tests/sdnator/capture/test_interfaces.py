"""Frames onto a real interface, and veth pairs that do not outlive who made them."""

import os
import socket
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from sdnator.capture.interfaces import ETH_P_ALL, MTU, VethPair, WireFeed
from sdnator.errors import BadInput, PipelineError
from tests.requirements import require_netns

HEADER = b"\x02" * 12 + b"\x88\xb5"


@pytest.fixture
def cable():
    require_netns()
    with ExitStack() as stack:
        yield VethPair.make(stack, "wire")


def test_cut_frames_are_sent_as_long_as_they_were(cable):
    """A capture keeps the first bytes of a frame; the wire carries its whole length."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL)) as far:
        far.bind((cable.far, 0))
        far.settimeout(5)
        feed = WireFeed(cable.near)
        feed.send([0, 1], [100, 70], [HEADER + b"cut", HEADER + bytes(56)])
        assert far.recv(2000) == (HEADER + b"cut").ljust(100, b"\0")
        assert far.recv(2000) == HEADER + bytes(56)
        assert feed.verdicts() == b""
        feed.close()


def test_frame_that_does_not_fit_says_what_to_change(cable):
    feed = WireFeed(cable.near)
    with pytest.raises(PipelineError, match=f"a frame of {MTU + 100} bytes .*raise the interface's MTU"):
        feed.send([0], [MTU + 100], [HEADER])
    feed.close()


def test_interface_that_cannot_be_used_is_named():
    words = "see `ip link`" if os.geteuid() == 0 else "run as root"
    with pytest.raises(BadInput, match=f"--inject none0: .*{words}"):
        WireFeed("none0")


def test_pair_is_gone_with_its_stack():
    require_netns()
    with ExitStack() as stack:
        pair = VethPair.make(stack, "gone")
        assert Path("/sys/class/net", pair.far).exists()
        with pytest.raises(BadInput, match=r"ip link add .*veth pairs need root"):
            VethPair(pair.near.removesuffix("a"))
    assert not Path("/sys/class/net", pair.near).exists()


def test_pair_of_a_dead_process_is_removed_by_the_next():
    """Whoever is killed cannot remove his own."""
    require_netns()
    with subprocess.Popen(["true"]) as dead:
        pass
    orphan = f"sdnold{dead.pid}"
    ends = (f"{orphan}a", "type", "veth", "peer", "name", f"{orphan}b")
    subprocess.run(["ip", "link", "add", *ends], check=True)
    with ExitStack() as stack:
        VethPair.make(stack, "next")
        assert not Path("/sys/class/net", ends[0]).exists()
