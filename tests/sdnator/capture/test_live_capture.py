"""Frames of an interface arrive as batches, VLAN tags put back, our own left out."""

import os
import subprocess
import sys

import pytest

from sdnator.capture.live_capture import LiveSource, _whole
from sdnator.errors import BadInput
from tests.requirements import require_netns

SCRIPT = """
import socket, sys, time
from sdnator.capture.live_capture import LiveSource
got = []
source = LiveSource("left", lambda: sum(len(batch["length"]) for batch in got) >= 3 or time.monotonic() > end)
end = time.monotonic() + 20
sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
sender.bind(("right", 0))
own = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
own.bind(("left", 0))
mac = bytes.fromhex("02000000aa01")
own.send(b"\\xff" * 6 + mac + b"\\x88\\xb5" + bytes(50))
for tag in (b"", b"\\x81\\x00\\x00\\x64", b""):
    sender.send(b"\\xff" * 6 + mac + tag + b"\\x88\\xb5" + bytes(60))
for batch in source:
    keep = batch["eth_src"] == 0x02000000AA01
    got.append({name: column[keep] for name, column in batch.items()})
vlans = [int(vlan) for batch in got for vlan in batch["vlan"]]
lengths = [int(length) for batch in got for length in batch["length"]]
print(vlans, lengths)
"""


def test_frames_of_a_veth_pair():
    require_netns()
    setup = (
        "ip link add left type veth peer name right && "
        "sysctl -q -w net.ipv6.conf.all.disable_ipv6=1 2>/dev/null; ip link set left up && ip link set right up && "
        f"exec {sys.executable} -c '{SCRIPT}'"
    )
    command = ["unshare", "--net", "sh", "-c", setup]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ, timeout=60)
    assert done.stdout.strip() == "[-1, 100, -1] [74, 78, 74]", done.stderr


def test_an_interface_that_is_not_there_is_named():
    if os.geteuid() != 0:
        with pytest.raises(BadInput, match="needs root"):
            LiveSource("none0")
    else:
        with pytest.raises(BadInput, match="none0: cannot listen"):
            LiveSource("none0")


def test_frames_without_auxiliary_data_are_taken_as_they_are():
    assert _whole(bytes(70), []) == (bytes(70), 70)
