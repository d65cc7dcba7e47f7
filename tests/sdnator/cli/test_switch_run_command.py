"""A switch started by hand says where it serves, and ends at Ctrl-C with its counts."""

import json
import os
import signal
import subprocess
import sys

import pytest

_RUN = "import typer; from sdnator.cli.switch_run_command import switch; typer.run(switch)"


def start(*arguments):
    command = [
        sys.executable,
        "-c",
        _RUN,
        "--grpc",
        "127.0.0.1:0",
        "--insecure",
        *arguments,
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_runs_until_it_is_stopped(number):
    with start("--port", "1=null", "--port", "7=null", "--json") as process:
        ready = json.loads(process.stdout.readline())
        assert ready["ready"]
        assert ready["grpc"].startswith("127.0.0.1:")
        process.send_signal(number)
        counts = json.loads(process.stdout.readline())
        assert process.wait(60) == 0
    assert list(counts["ports"]) == ["1", "7"]
    with pytest.raises(ProcessLookupError):
        os.kill(ready["pid"], 0)


def test_people_are_told_in_words():
    with start("--ports", "1=null") as process:
        assert "P4Runtime on 127.0.0.1:" in process.stdout.readline()
        assert process.stdout.readline() == "  port 1=null\n"
        process.send_signal(signal.SIGINT)
        said = process.stdout.read()
        assert process.wait(60) == 0
    assert "received" in said


def test_a_port_that_cannot_be_is_named():
    with start("--port", "1=wormhole") as process:
        said = process.stderr.read()
        assert process.wait(60) == 2
    assert "wormhole" in said
