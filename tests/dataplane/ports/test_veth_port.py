"""Network interfaces as ports: whole frames, tags put back, nothing seen twice, the MTU kept."""

import contextlib
import os
import select
import socket
import struct
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from dataplane.ports.port import PortError
from dataplane.ports.veth_port import VethPort, tags_taken_out, with_vlan_tag
from tests.requirements import require_netns

SOL_PACKET, AUXDATA = 263, 8


def auxiliary(status, tci, tpid):
    data = struct.pack("=IIIHHHH", status, 64, 64, 0, 14, tci, tpid)
    return struct.pack("@Nii", 16 + len(data), SOL_PACKET, AUXDATA) + data


def test_a_tag_the_kernel_took_out_is_put_back():
    frame = bytes(range(12)) + b"\x08\x00rest"
    assert (
        with_vlan_tag(frame, auxiliary(0x10, 0x2064, 0)) == bytes(range(12)) + b"\x81\x00\x20\x64\x08\x00rest"
    )
    assert (
        with_vlan_tag(frame, auxiliary(0x50, 5, 0x88A8)) == bytes(range(12)) + b"\x88\xa8\x00\x05\x08\x00rest"
    )


def test_tags_are_found_among_many_frames():
    """A frame without auxiliary data, or with another's, has no tag to put back."""
    rows = [auxiliary(0x10, 1, 0), auxiliary(0, 1, 0x8100), bytes(36), auxiliary(0x50, 5, 0x88A8)]
    control = np.array([np.frombuffer(row, np.uint8) for row in rows])
    assert tags_taken_out(control).tolist() == [True, False, False, True]


def test_an_interface_that_is_not_there_is_said_plainly():
    with pytest.raises(PortError, match="no-such-if"):
        VethPort("no-such-if")


def carried(names):
    """Wait until both ends send: the kernel notices the cable some time after the interface is up."""
    deadline = time.monotonic() + 60
    for name in names:
        while Path(f"/sys/class/net/{name}/operstate").read_text().strip() != "up":
            assert time.monotonic() < deadline
            time.sleep(0.005)


@pytest.fixture
def pair():
    """Names of a veth pair that is up; frames of the kernel's own are kept off it."""
    require_netns()
    ours, theirs = f"sn{os.getpid() % 100000}a", f"sn{os.getpid() % 100000}b"

    def ip(*arguments):
        subprocess.run(["ip", *arguments], check=True, capture_output=True)

    ip("link", "add", ours, "type", "veth", "peer", "name", theirs)
    for name in (ours, theirs):
        with contextlib.suppress(OSError):
            Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1")
        ip("link", "set", name, "arp", "off", "up")
    carried((ours, theirs))
    yield ours, theirs
    ip("link", "delete", ours)


@pytest.fixture
def cable(pair):
    """(the port under test, a raw socket at the other end)."""
    port = VethPort(pair[0])
    # protocol 0 until it is bound, or frames of all interfaces would wait in it
    other = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    other.bind((pair[1], 3))
    other.settimeout(60)
    yield port, other
    other.close()
    port.close()


def received(port, count):
    frames, deadline = [], time.monotonic() + 60
    while len(frames) < count and time.monotonic() < deadline:
        select.select([port], [], [], 0.2)
        arrived = port.receive(100)
        frames += arrived.frames if arrived.block is None else arrived.block.frames()
    return frames


def test_frames_pass_both_ways(cable):
    port, other = cable
    frames = [os.urandom(60 + n) for n in range(50)]
    frames = [b"\x02" + frame[1:12] + b"\x88\xb5" + frame[14:] for frame in frames]
    for frame in frames:
        other.send(frame)
    assert received(port, 50) == frames
    port.send(frames[0])
    assert other.recv(2000) == frames[0]
    other.send(frames[1])
    assert received(port, 1) == [frames[1]], "a frame we sent was seen again"
    assert (port.counters.received, port.counters.sent) == (51, 1)


def test_tagged_frames_arrive_tagged(cable):
    port, other = cable
    tagged = b"\x02" * 12 + b"\x81\x00\x00\x64\x88\xb5" + bytes(60)
    twice = b"\x02" * 12 + b"\x88\xa8\x00\x05\x81\x00\x00\x64\x88\xb5" + bytes(60)
    other.send(tagged)
    other.send(twice)
    assert received(port, 2) == [tagged, twice]


def test_frames_over_the_mtu_are_counted(cable):
    port, other = cable
    header = b"\x02" * 12
    port.send(header + b"\x88\xb5" + bytes(1500))
    port.send(header + b"\x81\x00\x00\x01\x88\xb5" + bytes(1500))
    port.send(header + b"\x88\xb5" + bytes(1501))
    assert len(other.recv(4000)) == 1514
    assert (port.counters.sent, port.counters.oversized) == (2, 1)


def test_an_interface_that_goes_down_is_counted_and_comes_back(cable, pair):
    port, other = cable
    frame = b"\x02" * 12 + b"\x88\xb5" + bytes(60)
    subprocess.run(["ip", "link", "set", pair[0], "down"], check=True)
    port.receive(1)
    port.send(frame)
    assert port.counters.failed >= 1
    subprocess.run(["ip", "link", "set", pair[0], "up"], check=True)
    carried(pair)
    other.send(frame)
    assert received(port, 1) == [frame]


def test_more_frames_than_one_call_takes_pass_whole_and_in_order(cable):
    """Long and short ones mixed; what is over the MTU is left out, and what stands behind it is sent."""
    port, other = cable
    other.setsockopt(socket.SOL_SOCKET, 33, 8 << 20)  # SO_RCVBUFFORCE: nobody reads meanwhile
    random = np.random.default_rng(1)
    frames = [
        b"\x02" * 12 + b"\x88\xb5" + number.to_bytes(4, "big") + random.bytes(int(size))
        for number, size in enumerate(random.integers(42, 1_496, 600))
    ]
    for frame in frames:
        other.send(frame)
    assert received(port, 600) == frames
    wrong = b"\x02" * 12 + b"\x88\xb5" + bytes(1_600)
    sent = [*frames[:300], wrong, *frames[300:]]
    ends = np.cumsum([len(frame) for frame in sent])
    port.send_many(b"".join(sent), ends - [len(frame) for frame in sent], ends)
    assert [other.recv(2_000) for _ in frames] == frames
    assert (port.counters.sent, port.counters.oversized, port.counters.failed) == (600, 1, 0)


def test_frames_for_an_interface_that_is_down_are_counted(pair):
    port = VethPort(pair[0])
    subprocess.run(["ip", "link", "set", pair[0], "down"], check=True)
    port.send(b"\x02" * 12 + b"\x88\xb5" + bytes(46))
    port.receive(10)
    assert (port.counters.sent, port.counters.failed > 0) == (0, True)
    port.close()
