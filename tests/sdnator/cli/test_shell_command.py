"""The shell gets an environment of its own, once; what is missing is said in one line."""

import sys

import pytest

from sdnator.cli import shell_command
from sdnator.cli.shell_command import environment, folder, shell
from sdnator.errors import PipelineError
from tests.apps.p4runtime_ctrl.fake_switch import FakeSwitch


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


@pytest.fixture
def steps(monkeypatch):
    done = []

    def step(command):
        done.append(command)
        (folder() / "bin").mkdir(exist_ok=True)

    monkeypatch.setattr(shell_command, "_step", step)
    return done


def test_the_environment_is_made_once(steps, capsys):
    python = environment()
    assert python == folder() / "bin" / "python"
    assert [command[1:3] for command in steps] == [["-m", "venv"], ["-m", "pip"]]
    assert "once" in capsys.readouterr().out
    assert environment() == python
    assert len(steps) == 2
    environment(again=True)
    assert len(steps) == 4


def test_half_an_environment_is_made_again(steps):
    (folder() / "bin").mkdir(parents=True)
    environment()
    assert len(steps) == 2


def test_where_it_cannot_be_made_the_reason_is_said():
    command = [sys.executable, "-c", "import sys; sys.exit('no such index')"]
    with pytest.raises(PipelineError, match=r"(?s)no such index.*pip's settings"):
        shell_command._step(command)


def test_a_switch_that_is_not_there_is_said_before_anything_is_made(steps):
    with pytest.raises(PipelineError, match="UNAVAILABLE"):
        shell("127.0.0.1:1", insecure=True)
    assert not steps


def test_it_is_started_as_the_lowest_of_controllers(steps, tmp_path):
    said = tmp_path / "said"
    with FakeSwitch() as switch:
        python = environment()
        python.write_text(f'#!/bin/sh\necho "$@" > {said}\nexit 3\n')
        python.chmod(0o700)
        with pytest.raises(Exception) as ended:
            shell(switch.address)
    assert ended.value.exit_code == 3
    words = said.read_text().split()
    assert words[:4] == ["-m", "p4runtime_sh", "--grpc-addr", switch.address]
    assert words[words.index("--election-id") + 1].startswith("0,")
