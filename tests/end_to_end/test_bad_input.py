"""What a user can get wrong, and what he is told."""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from tests.end_to_end.command import figures, sdnator

MARK = "SDNATOR_TEST_RUN"
SECONDS = 120


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A short generated capture: a few thousand packets, no attack."""
    path = tmp_path_factory.mktemp("capture") / "home.pcap"
    make(MiraiLikeOptions(seed=9, benign_seconds=200, attack_seconds=0), path)
    return path


def told(done: subprocess.CompletedProcess[str]) -> str:
    """The one line of the error; there is no traceback, no progress bar and nothing on standard output."""
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("sdnator: ")
    return lines[0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        (b"", "the file is empty"),
        (b"#!/bin/sh\nexit 0\n" * 10, "not a capture"),
        (b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00" + bytes(8) + b"\xff\xff\x00\x00\x01\x00\x00\x00", "no packets"),
    ],
)
def test_useless_capture_is_told_in_one_line(tmp_path, content, words):
    """Missing, empty, something else, or without packets: exit code 2."""
    path = tmp_path / "given.pcap"
    if content is not None:
        path.write_bytes(content)
    done = sdnator("replay", path)
    assert done.returncode == 2
    assert words in told(done)
    assert str(path) in told(done)


def test_capture_shorter_than_training_names_the_options(capture):
    """The user learns how many packets are needed and what to change."""
    done = sdnator("replay", capture)
    assert done.returncode == 2
    for word in ("55,001", "--train", "--fm-grace", "--ad-grace"):
        assert word in told(done)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--switch", "127.0.0.1:9"), "--inject"),
        (("--report", "/proc/report"), "--report"),
    ],
)
def test_wrong_option_is_named(capture, options, word):
    """Before anything is started; tests/sdnator/cli/test_replay_command.py has the other options."""
    done = sdnator("replay", capture, "--train", "1000", *options)
    assert done.returncode == 2
    assert word in told(done)


def test_cut_capture_is_used_as_far_as_it_is_whole(capture, tmp_path):
    """The note says where it ends."""
    cut = tmp_path / "cut.pcap"
    cut.write_bytes(capture.read_bytes()[:-7])
    found = figures("replay", cut, "--train", "1000")
    assert found["packets_lost"] == 0
    assert any("cut off at byte" in note for note in found["notes"])


def test_labels_of_another_capture_are_refused(capture, tmp_path):
    """Not as many labels as packets."""
    labels = tmp_path / "labels.csv"
    labels.write_text("0\n1\n")
    done = sdnator("replay", capture, "--labels", labels, "--train", "1000")
    assert done.returncode == 2
    assert "2 labels" in told(done)


def processes_of(run: str) -> list[int]:
    """All processes that inherited the mark of a test run."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/environ"):
        try:
            if f"{MARK}={run}".encode() in entry.read_bytes():
                found.append(int(entry.parent.name))
        except OSError:
            continue
    return found


def parts_of(replay: int, part: str) -> list[int]:
    """Processes that a replay itself has started as this part; a part's own children are none."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == replay and f"\0{part}\0".encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:  # it has ended meanwhile
            continue
    return found


@pytest.fixture
def running(capture, tmp_path):
    """A replay in real time, which takes minutes; its pipeline keeps its files in the test's folder."""
    keep = tmp_path / "keep"
    report = tmp_path / "report"
    command = [
        sys.executable, "-m", "sdnator.cli.main", "replay", str(capture),
        "--train", "1000", "--pace", "1x", "--report", str(report), "--keep", str(keep), "--json",
    ]  # fmt: skip
    run = uuid.uuid4().hex
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {MARK: run}
    )
    log = keep / "dry-run" / "logs" / "p4runtime_ctrl.log"
    deadline = time.monotonic() + SECONDS
    while not (log.exists() and "primary" in log.read_text()):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.1)
    yield process, run, report
    if process.poll() is None:
        process.kill()
    process.communicate()


def test_ctrl_c_leaves_nothing_behind(running):
    """Exit code 130, one line, no process, no half-written report."""
    process, run, report = running
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=SECONDS)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert error.rstrip().endswith("sdnator: interrupted; all processes are stopped")
    assert out == ""
    assert not report.exists()
    assert processes_of(run) == []


def test_killed_replay_takes_its_pipeline_along(running):
    """Even kill -9 leaves no switch, server or app running."""
    process, run, _ = running
    process.kill()
    process.communicate(timeout=SECONDS)
    deadline = time.monotonic() + SECONDS
    while processes_of(run) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert processes_of(run) == []


@pytest.mark.parametrize("part", ["apps.kitsune.service", "dataplane"])
def test_death_of_a_part_is_told(running, part):
    """An app, or the switch: which part died, and how; exit code 1."""
    process, _, _ = running
    deadline = time.monotonic() + SECONDS
    while not (pids := parts_of(process.pid, part)):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    (pid,) = pids
    os.kill(pid, signal.SIGKILL)
    _, error = process.communicate(timeout=SECONDS)
    assert process.returncode == 1
    assert "Traceback" not in error
    assert "was killed by SIGKILL" in error


def test_json_is_one_object(capture):
    """Standard output holds nothing else."""
    done = sdnator("replay", capture, "--train", "1000", "--json")
    assert done.returncode == 0
    assert isinstance(json.loads(done.stdout), dict)
