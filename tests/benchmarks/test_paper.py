"""The paper's benchmark: how findings are judged, and the forwarder that delays the star's links."""

import math
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from benchmarks import paper_report
from benchmarks.paper_cases import run_ending
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


def test_the_page_shows_every_finding_and_what_was_drawn(tmp_path):
    """A row for each claim; a picture for each group with cells, none for the others, and no dead link."""
    one = Measured((2.0, 1.0, 3.0)).to_value()
    message = {"latency_p50_us": one, "per_second": one}
    cells = {
        "messages": {"due reliable 100 B batch 1": message, "os-ken 100 B batch 1": message},
        "archive": {
            "sqlite": {"batch 1": one, "off": one, "on": one},
            "mongodb": "nx-27017 is not installed",
        },
        "cases": {
            "workflow 1": {"packets_lost": 0, "alerts": 510, "mitigation": True},
            "workflow 2": {"failed": "no <root>"},
        },
        "star": {"link_mbit": 5.0, "runs": [{"pairs": 2, "one_way_s": 0.05, "sum_mbit": 9.0, "jain": 1.0}]},
    }
    results = {
        "machine": {"cores": 2},
        "versions": {"sdnator": "0"},
        "findings_reported": 0,
        "findings_reproduced": 0,
        "findings": [msgspec.to_builtins(judge(claim, {}, "no <time>")) for claim in CLAIMS],
        "cells": cells,
    }
    page = paper_report.write(results, tmp_path).read_text()
    assert page.count("<tr><td>") == len(CLAIMS)
    assert "no &lt;time&gt;" in page
    assert re.findall(r'<img src="([^"]+)"', page) == ["messages.png", "archive.png", "star.png"]
    assert all((tmp_path / f"{name}.png").stat().st_size > 5_000 for name in ("messages", "archive", "star"))
    assert "packets lost 0, alerts 510" in page
    assert "failed no &lt;root&gt;" in page
    page = paper_report.write(results | {"cells": {}}, tmp_path / "empty").read_text()
    assert "<img" not in page


CHILD = """
import pathlib, signal, sys, time
def leave(number, frame):
    pathlib.Path("unwound").touch()
    sys.exit(3)
signal.signal(signal.SIGTERM, leave)
pathlib.Path("begun").touch()
time.sleep(600)
"""


def test_a_case_that_takes_too_long_is_asked_to_end(tmp_path):
    """It has the time to remove its namespaces, and its end is told."""
    code, _, problem = run_ending((sys.executable, "-c", CHILD), tmp_path, 5.0)
    assert (code, (tmp_path / "unwound").exists()) == (3, True)
    assert "asked to end after 5 s" in problem


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_case_ends_with_the_benchmark(tmp_path, number):
    """Whether the benchmark is asked to end or killed, what it runs unwinds."""
    parent = (
        "import sys; from pathlib import Path; from benchmarks.paper_cases import run_ending; "
        "from sdnator.demos.syn_flood.demo import terminable\n"
        f"with terminable(): run_ending((sys.executable, '-c', {CHILD!r}), Path({str(tmp_path)!r}), 600.0)"
    )
    process = subprocess.Popen([sys.executable, "-c", parent], cwd=ROOT)
    wait_for((tmp_path / "begun").exists, 60)
    process.send_signal(number)
    process.wait(60)
    wait_for((tmp_path / "unwound").exists, 60)


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
