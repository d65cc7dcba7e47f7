"""The paper's benchmark: how findings are judged, and the forwarder that delays the star's links."""

import math
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.paper_findings import CLAIMS, Measured, judge
from benchmarks.paper_star import jain
from sdnator.testing.waiting import wait_for
from tests.requirements import require_netns

ROOT = Path(__file__).resolve().parent.parent.parent
PROTOCOL = 0x88B5
"""EtherType for local experiments."""


def verdict(number, *values):
    claim = CLAIMS[number - 1]
    figures = {one.figure: Measured((value,)) for one, value in zip(claim.criteria, values, strict=False)}
    return judge(claim, figures, "no time")


def test_there_are_twelve_claims_each_with_a_criterion():
    """Numbered 1 to 12."""
    assert [claim.number for claim in CLAIMS] == list(range(1, 13))
    assert all(claim.criteria for claim in CLAIMS)


@pytest.mark.parametrize(
    ("values", "reproduced"),
    [((1.0, 1.1), "yes"), ((1.0, 1.2), "in part"), ((1.2, 1.2), "no"), ((1.0,), "not measured")],
)
def test_a_finding_is_what_its_figures_say(values, reproduced):
    """All criteria, some, none; a missing figure is never a verdict."""
    assert verdict(2, *values).reproduced == reproduced


def test_a_finding_tells_figure_and_bar():
    """The sentence has both, and the reason why it was not measured where it was not."""
    assert "per_second is 476, at least 100000 was wanted" in verdict(4, 476.0).sentence
    assert verdict(4).sentence == "no time"
    assert Measured((3.0, 1.0, 2.0)).to_value() == {
        "median": 2.0, "least": 1.0, "most": 3.0, "rounds": [3.0, 1.0, 2.0],
    }  # fmt: skip


def test_jain_is_one_for_equal_shares():
    """And 1/n where one of n has it all."""
    assert math.isclose(jain([5.0] * 8), 1.0)
    assert math.isclose(jain([1.0, 0.0, 0.0, 0.0]), 0.25)


@pytest.fixture
def cables():
    """Two veth pairs: what is sent into a0 comes out at a1 only if somebody forwards from b0 to b1."""
    require_netns()
    names = [f"rl{letter}{number}" for letter in "ab" for number in (0, 1)]
    for number in (0, 1):
        pair = (f"rla{number}", f"rlb{number}")
        subprocess.run(["ip", "link", "add", pair[0], "type", "veth", "peer", "name", pair[1]], check=True)
        for name in pair:
            Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1")
            subprocess.run(["ip", "link", "set", name, "up"], check=True)
    yield names
    for number in (0, 1):
        subprocess.run(["ip", "link", "del", f"rla{number}"], check=True)


def test_the_relay_delays_and_keeps_the_order(cables):
    """Frames arrive whole, in order, and none sooner than the delay."""
    ends = [socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(PROTOCOL)) for _ in range(2)]
    for number, end in enumerate(ends):
        end.bind((f"rla{number}", PROTOCOL))
        end.settimeout(60)
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.paper_relay", "rlb0,rlb1"],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "ready\n"
        process.stdin.write("0.05\n")
        process.stdin.flush()
        head = b"\xff" * 12 + PROTOCOL.to_bytes(2, "big")

        def delayed():
            begun = time.monotonic()
            ends[0].send(head + b"first".ljust(60))
            ends[1].recv(2000)
            return time.monotonic() - begun >= 0.05

        wait_for(delayed, 60)  # the new delay has been read
        frames = [head + bytes([number]) * 1_000 for number in range(20)]
        begun = time.monotonic()
        for frame in frames:
            ends[0].send(frame)
        assert [ends[1].recv(2000) for _ in frames] == frames
        assert time.monotonic() - begun >= 0.05
        process.stdin.close()
        assert process.stdout.read() == "0\n"
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        for end in ends:
            end.close()
