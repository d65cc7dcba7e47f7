"""The launcher of BMv2: bound to loopback, ended when told; a missing program is said plainly."""

import os
import signal
from pathlib import Path

import pytest

from dataplane.bmv2 import PROGRAM, Bmv2, Bmv2Error
from sdnator.testing.p4runtime_client import P4RuntimeClient
from tests.requirements import optional_program


def test_a_missing_program_is_said_plainly(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Bmv2Error, match="not on the PATH"):
        Bmv2({})


def test_a_program_that_ends_at_once_is_said_with_its_words(monkeypatch, tmp_path):
    script = tmp_path / PROGRAM
    script.write_text("#!/bin/sh\necho it hurts\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    with pytest.raises(Bmv2Error, match="it hurts"):
        Bmv2({})


def test_its_death_is_told():
    optional_program(PROGRAM)
    with Bmv2({}, device_id=4) as switch:
        switch.check()
        os.kill(switch.pid, signal.SIGKILL)
        os.waitid(os.P_PID, switch.pid, os.WEXITED | os.WNOWAIT)
        with pytest.raises(Bmv2Error, match="ended with exit code"):
            switch.check()


def test_it_serves_on_loopback_and_ends():
    optional_program(PROGRAM)
    with Bmv2({}, device_id=3) as switch:
        assert switch.address.startswith("127.0.0.1:")
        with P4RuntimeClient(switch.address, device_id=3) as controller:
            assert controller.arbitrate().status.code == 0
        pid = switch.pid
    assert not Path(f"/proc/{pid}").exists()
