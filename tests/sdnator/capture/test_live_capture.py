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


OUTAGE = """
import socket, subprocess, time
from sdnator.capture.live_capture import LiveSource
got, told, end = [], [], time.monotonic() + 20
def send(last):
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as sender:
        sender.bind(("right", 0))
        sender.send(bytes(6) + bytes.fromhex("02000000aa") + last + bytes(60))
def enough():
    send(b"\\1")
    return bool(got) or time.monotonic() > end
source = LiveSource("left", enough, told.append)
send(b"\\2")
subprocess.run(COMMAND, shell=True, check=True)
for batch in source:
    got += [sender for sender in batch["eth_src"] if sender == 0x02000000AA01]
print(told, bool(got))
"""
UP = "ip link set left up && ip link set right up"


@pytest.mark.parametrize(
    "command",
    [
        f"ip link set left down && {UP}",
        f"ip link delete left && ip link add left type veth peer name right && {UP}",
    ],
    ids=["down", "replaced"],
)
def test_an_interface_that_was_away_is_listened_to_again(command):
    """A cable that is pulled, or an adapter that is plugged in anew, does not end a run of hours."""
    told = said_inside(OUTAGE.replace("COMMAND", repr(command)))
    assert told == "['left is down: waiting until it is back'] True"


TERMINATED = """
import json, socket, subprocess, sys, time
from pathlib import Path
def queued():
    rows = [line.split() for line in Path("/proc/net/packet").read_text().splitlines()[1:]]
    return [int(row[6]) for row in rows if row[3] == "0003"]
lengths = ["--fm-grace", "20", "--ad-grace", "80"]
command = [sys.executable, "-m", "sdnator.cli.main", "detect", "--interface", "left", "--out", OUT, *lengths, "--json"]
detect = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
while not queued() and detect.poll() is None:
    time.sleep(0.02)
with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as sender:
    sender.bind(("right", 0))
    for number in range(300):
        sender.send(bytes(6) + bytes.fromhex("0200000000%02x" % (number % 4)) + bytes(60))
while any(queued()):
    time.sleep(0.02)
detect.terminate()
told = json.loads(detect.communicate(timeout=50)[0])
print(detect.returncode, told["scored"] >= 150)
"""


def test_sigterm_ends_a_run_with_results(tmp_path):
    """As Ctrl-C does: a service manager sends it, and hours of scores are not thrown away."""
    assert said_inside(TERMINATED.replace("OUT", repr(str(tmp_path / "scores")))) == "0 True"
    assert (tmp_path / "scores" / "scores.csv").exists()


def test_an_interface_that_is_not_there_is_named():
    if os.geteuid() != 0:
        with pytest.raises(BadInput, match="needs root"):
            LiveSource("none0")
    else:
        with pytest.raises(BadInput, match="none0: cannot listen"):
            LiveSource("none0")


def test_frames_without_auxiliary_data_are_taken_as_they_are():
    assert _whole(bytes(70), []) == (bytes(70), 70)
