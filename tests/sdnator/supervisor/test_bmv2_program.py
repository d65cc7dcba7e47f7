"""BMv2 as a part: it serves at the address it had, beats, and is killed where it no longer answers."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from sdnator.supervisor import Child
from tests.requirements import optional_program

MODULE = "sdnator.supervisor.bmv2_program"


def test_without_bmv2_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    child = Child("switch", [MODULE], tmp_path)
    try:
        with pytest.raises(Exception, match="install BMv2 or use the embedded switch"):
            child.wait_ready()
    finally:
        child.stop()


def test_one_that_is_stopped_is_killed_and_its_end_told(tmp_path):
    """SIGSTOP to BMv2 itself, which no signal to its starter would end."""
    optional_program("simple_switch_grpc")
    child = Child("switch", [MODULE], tmp_path, heartbeat=True)
    try:
        address = child.wait_ready()["grpc"]
        (bmv2,) = children(child.pid)
        os.kill(bmv2, signal.SIGSTOP)
        assert subprocess_ended(child)
        assert "has not answered" in child.log.read_text()
        assert not Path(f"/proc/{bmv2}").exists()
    finally:
        child.stop()
    again = Child("switch", [MODULE, "--grpc", address], tmp_path, heartbeat=True)
    try:
        assert again.wait_ready()["grpc"] == address
    finally:
        again.stop()


def children(pid):
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(each) for each in listed]


def subprocess_ended(child):
    try:
        child._process.wait(60)
    except subprocess.TimeoutExpired:
        return False
    return True
