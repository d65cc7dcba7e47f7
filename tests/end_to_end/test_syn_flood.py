"""Real SYN floods in network namespaces: without the product nobody connects, with it nobody notices."""

import os
import signal
import subprocess
import sys

import pytest

from sdnator.syn_flood import VOID_FROM, SynFloodOptions, run_syn_flood
from tests.requirements import require_netns, require_program


def options(**changes) -> SynFloodOptions:
    return SynFloodOptions(
        **({"seconds": 7.0, "unprotected_seconds": 5.0, "learning_seconds": 5.0} | changes)
    )


def namespaces() -> str:
    return subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout


@pytest.fixture(autouse=True)
def needs():
    """Root, namespaces, iproute2; and nothing may be left of them."""
    require_netns()
    require_program("ss")
    yield
    assert f"sdn{os.getpid()}-" not in namespaces()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_leaves_nothing_behind(number, tmp_path):
    """Neither namespaces nor processes, whenever it is stopped."""
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sdnator.syn_flood import SynFloodOptions, run_syn_flood\n"
        "run_syn_flood(SynFloodOptions(), lambda line: print(line, flush=True))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as run:
        assert run.stdout is not None
        assert run.stdout.readline()
        assert f"sdn{run.pid}-victim" in namespaces()
        run.send_signal(number)
        assert run.wait(60) != 0
    assert f"sdn{run.pid}-" not in namespaces()
    assert list(tmp_path.iterdir()) == []
    running = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(tmp_path) not in running


@pytest.mark.slow
@pytest.mark.parametrize("version", [4, 6])
def test_spoofed_flood_hurts_nobody_when_the_service_is_guarded(version):
    """Known clients connect at once, new ones at their second SYN; the backlog stays nearly empty."""
    seen = run_syn_flood(options(sources="spoofed", version=version))
    assert seen.void == ""
    assert seen.client_success_unprotected is not None
    assert seen.client_success_unprotected < VOID_FROM
    assert seen.known_client_success is not None
    assert seen.known_client_success >= 0.99
    assert seen.new_client_success is not None
    assert seen.new_client_success >= 0.95
    assert seen.half_open_peak <= 64
    assert seen.challenged > 0
    assert seen.entries_peak < 5000


@pytest.mark.slow
def test_one_source_is_found_and_blocked():
    """Nothing was guarded: the query sees the flood, the policy blocks its only source."""
    seen = run_syn_flood(options(armed=False, seconds=11.0))
    assert seen.void == ""
    assert any(text.startswith("block 10.2.0.10:") for text in seen.decisions)
    assert not any(text.startswith("block 10.1.") for text in seen.decisions)
    assert seen.time_to_mitigate_ms is not None
