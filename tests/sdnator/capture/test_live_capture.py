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


def said_inside(script):
    """What a script prints in a network namespace with a pair of interfaces."""
    require_netns()
    setup = (
        "ip link add left type veth peer name right && "
        "sysctl -q -w net.ipv6.conf.all.disable_ipv6=1 2>/dev/null; "
        "ip link set lo up && ip link set left up && ip link set right up && "
        f'exec {sys.executable} -c "$SCRIPT"'
    )
    command = ["unshare", "--net", "sh", "-c", setup]
    given = {**os.environ, "SCRIPT": script}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=given, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_frames_of_a_veth_pair():
    assert said_inside(SCRIPT) == "[-1, 100, -1] [74, 78, 74]"


FLOOD = """
import socket
with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as flood:
    flood.bind(("lo", 0))
    while True:
        flood.send(bytes(60))
"""
LISTENERS = f"""
import subprocess, sys
from sdnator.capture.live_capture import LiveSource
flood = subprocess.Popen([sys.executable, "-c", {FLOOD!r}])
came = 0
for _ in range(20):
    answers = iter((False, True))
    source = LiveSource("left", lambda: next(answers))
    shown = subprocess.run(["ip", "-d", "link", "show", "left"], capture_output=True, text=True).stdout
    came += sum(len(batch["length"]) for batch in source)
flood.kill()
print(came, shown.partition("promiscuity ")[2].split()[0])
"""


def test_frames_of_others_are_taken_but_none_of_other_interfaces():
    """Nor in the moment in which it is opened."""
    assert said_inside(LISTENERS) == "0 1"


def test_an_interface_that_is_not_there_is_named():
    if os.geteuid() != 0:
        with pytest.raises(BadInput, match="needs root"):
            LiveSource("none0")
    else:
        with pytest.raises(BadInput, match="none0: cannot listen"):
            LiveSource("none0")


def test_frames_without_auxiliary_data_are_taken_as_they_are():
    assert _whole(bytes(70), []) == (bytes(70), 70)
