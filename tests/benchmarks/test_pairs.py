"""A server that cuts the consumer off costs a benchmark best-effort messages, and does not end it."""

import subprocess
import sys
import threading
from pathlib import Path

from benchmarks.pairs import MeasuredRun
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_wire import Wire

_ROOT = Path(__file__).parents[2]


def _delivery(url: str, count: int) -> MeasuredRun:
    """In a process of its own, which ends with whatever multiprocessing starts."""
    program = (
        f"from benchmarks.pairs import due_delivery; print(*due_delivery({url!r}, 1000, {count}, still=3.0))"
    )
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, cwd=_ROOT, check=True, capture_output=True, text=True, timeout=300).stdout
    rate, lost = said.split()
    return MeasuredRun(float(rate), int(lost))


def test_what_a_cut_off_consumer_missed_is_counted_and_the_run_goes_on(tmp_path):
    with EmbeddedServer(tmp_path / "u") as server:
        over = threading.Event()

        def cut() -> None:
            wire = Wire(server.url)
            while not over.wait(0.05):
                wire.call("CLIENT", "KILL", "TYPE", "pubsub")
            wire.close()

        thread = threading.Thread(target=cut)
        thread.start()
        try:
            found = _delivery(server.url, 60_000)
        finally:
            over.set()
            thread.join(10)
        assert 0 < found.lost < 60_000
        assert found.rate > 0
        assert _delivery(server.url, 1000).lost == 0
