"""Logs of all parts in one order, and of one as it grows."""

import json
import signal
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from sdnator.cli.logs_command import in_order
from sdnator.cli.main import app


@pytest.fixture
def logs(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    folder = tmp_path / "sdnator" / "logs"
    folder.mkdir(parents=True)
    (folder / "kitsune.log").write_text("2026-01-01 10:00:01,000 kitsune INFO b\nTraceback:\n  in c\n")
    (folder / "firewall.log").write_text(
        "2026-01-01 10:00:00,500 firewall INFO a\n2026-01-01 10:00:02,000 firewall INFO d\n"
    )
    return folder


def run(*words):
    return CliRunner().invoke(app, ["logs", *words])


def test_lines_are_in_the_order_of_their_times_and_tracebacks_stay_whole(logs):
    lines = run().stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["firewall", "kitsune", "kitsune", "kitsune", "firewall"]
    assert lines[2].endswith("Traceback:")


def test_one_part_is_shown_as_it_is(logs):
    assert run("kitsune", "-n", "1").stdout == "  in c\n"
    assert json.loads(run("kitsune", "-n", "1", "--json").stdout) == {"part": "kitsune", "line": "  in c"}


def test_structured_lines_are_handed_on_parsed_and_ordered(logs):
    (logs / "kitsune.log").write_text('{"time": "2026-01-01T10:00:01.5Z", "level": "info"}\n')
    found = [json.loads(line) for line in run("--json").stdout.splitlines()]
    assert found[1] == {"part": "kitsune", "line": {"time": "2026-01-01T10:00:01.5Z", "level": "info"}}


def test_unknown_parts_are_named(logs):
    done = CliRunner().invoke(app, ["logs", "nobody"])
    assert "firewall, kitsune" in str(done.exception)


def test_following_sees_what_comes_and_a_log_begun_anew(logs):
    command = [sys.executable, "-m", "sdnator.cli.main", "logs", "kitsune", "--follow", "-n", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "  in c\n"
        log = logs / "kitsune.log"
        with log.open("a") as file:
            file.write("new\n")
        assert process.stdout.readline() == "new\n"
        log.replace(logs / "kitsune.log.1")
        log.write_text("begun anew\n")
        assert process.stdout.readline() == "begun anew\n"
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 0


def test_order_of_equal_times_is_by_part():
    assert in_order([("b", ["2026-01-01 10:00:00 x"]), ("a", ["2026-01-01 10:00:00 y"])])[0][0] == "a"
