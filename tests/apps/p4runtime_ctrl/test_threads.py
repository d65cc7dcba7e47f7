"""A thread of the controller that ends takes the process along, with a word and a code."""

import json
import subprocess
import sys

import pytest

from due.drivers.embedded_redis import EmbeddedServer
from sdnator.testing.product_program import P4INFO, PROGRAM
from tests.apps.p4runtime_ctrl.fake_switch import FakeSwitch

BROKEN = """
import sys
import apps.p4runtime_ctrl.{module} as broken
from apps.p4runtime_ctrl import service

def fails(*_, **__):
    raise RuntimeError("broken on purpose")

broken.{what} = fails
sys.exit(service.main())
"""


@pytest.mark.parametrize(
    ("module", "what"),
    [
        ("worker", "SwitchWorker._take_over"),
        ("southbound.connection", "Connection._arbitrated"),
        ("southbound.connection", "Connection._hand_over"),
    ],
)
def test_a_dead_thread_ends_the_process(module, what, tmp_path):
    """The worker of a switch, its stream, and what hands packets over: none dies alone."""
    with FakeSwitch() as switch, EmbeddedServer(tmp_path / "updates") as updates:
        mine = {"name": "s1", "address": switch.address}
        files = {"program": str(PROGRAM), "p4info": str(P4INFO)}
        path = tmp_path / "settings.json"
        path.write_text(json.dumps({"switches": [mine], **files}))
        command = [sys.executable, "-c", BROKEN.format(module=module, what=what), "--updates", updates.url]
        command += ["--archive", f"sqlite://{tmp_path / 'archive.db'}", "--settings", str(path)]
        command += ["--directory", str(tmp_path / "due")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "broken on purpose" in done.stderr
    assert "the controller ends: s1: a thread has ended with an error" in done.stderr
