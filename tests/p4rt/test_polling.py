"""gRPC is told how to wait before it is loaded, and only where it understands that."""

import os
import subprocess
import sys

import pytest

from p4rt import polling


@pytest.fixture
def environment(monkeypatch):
    monkeypatch.delenv(polling.VARIABLE, raising=False)


@pytest.mark.parametrize("release", ["1.80.0", "1.85.1"])
def test_known_versions_are_told(monkeypatch, environment, release):
    monkeypatch.setattr(polling, "version", lambda _: release)
    polling.choose()
    assert os.environ[polling.VARIABLE] == polling.FORMER_WAY


@pytest.mark.parametrize("release", ["1.62.3", "1.86.0rc1", "2.0.0"])
def test_other_versions_are_left_alone(monkeypatch, environment, release):
    monkeypatch.setattr(polling, "version", lambda _: release)
    polling.choose()
    assert polling.VARIABLE not in os.environ


def test_a_choice_of_the_user_stays(monkeypatch):
    monkeypatch.setenv(polling.VARIABLE, "-tcp_rcv_lowat")
    polling.choose()
    assert os.environ[polling.VARIABLE] == "-tcp_rcv_lowat"


@pytest.mark.parametrize("module", ["p4rt", "dataplane.__main__", "apps.p4runtime_ctrl.service"])
def test_it_is_said_before_grpc_is_loaded_and_grpc_does_not_complain(module):
    program = (
        "import os, sys\n"
        "class Watch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == 'grpc': print(os.environ.get({polling.VARIABLE!r}))\n"
        "sys.meta_path.insert(0, Watch())\n"
        f"import {module}, grpc\n"
        "grpc.insecure_channel('127.0.0.1:1').close()\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != polling.VARIABLE}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    polling.choose()
    assert done.stdout.strip() == str(os.environ.get(polling.VARIABLE))
    assert "Unknown experiment" not in done.stderr
