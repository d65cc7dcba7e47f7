"""os-ken's event API as a peer: one app sends events, another's handler counts them, in one process.

The extra `peers` brings it: `pip install -e .[peers]`.  OSKEN_PYTHON may name the Python of another environment that has
it.  Without either it is left out with the reason.
"""

import importlib
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ABSENT = "os-ken left out: install the extra `peers` (pip install -e .[peers])"


def available() -> bool:
    """Whether there is an interpreter with os-ken."""
    return bool(os.environ.get("OSKEN_PYTHON")) or importlib.util.find_spec("os_ken") is not None


def events_per_second(size: int, count: int = 50_000) -> float:
    """Events a second from `send_event` to the handler."""
    times = _measured(size, count, gap=0.0)
    return count / (times[-1][1] - times[0][0])


def latency_us(size: int, count: int = 1000) -> list[float]:
    """One-way times of events sent one by one, µs."""
    return [(arrived - sent) * 1e6 for sent, arrived in _measured(size, count, gap=0.001)]


def _measured(size: int, count: int, gap: float) -> list[tuple[float, float]]:
    python = os.environ.get("OSKEN_PYTHON") or sys.executable
    command = [python, "-m", "benchmarks.osken", str(size), str(count), str(gap)]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[1], check=True, stdout=subprocess.PIPE, text=True, timeout=120
    )
    return [(sent, arrived) for sent, arrived in json.loads(done.stdout.splitlines()[-1])]


def _run(size: int, count: int, gap: float) -> list[tuple[float, float]]:
    app_manager: Any = importlib.import_module("os_ken.base.app_manager")
    event: Any = importlib.import_module("os_ken.controller.event")
    handler: Any = importlib.import_module("os_ken.controller.handler")
    hub: Any = importlib.import_module("os_ken.lib.hub")

    class Message(event.EventBase):  # type: ignore[misc]
        def __init__(self, payload: bytes) -> None:
            super().__init__()
            self.payload = payload
            self.sent = time.monotonic()

    times: list[tuple[float, float]] = []

    class Receiver(app_manager.OSKenApp):  # type: ignore[misc]
        @handler.set_ev_handler(Message)  # type: ignore[untyped-decorator]
        def on_message(self, message: Any) -> None:
            times.append((message.sent, time.monotonic()))

    receiver = Receiver()
    receiver.register_handler(Message, receiver.on_message)
    receiver.start()
    payload = os.urandom(size)
    for _ in range(count):
        receiver._send_event(Message(payload), None)
        hub.sleep(gap) if gap else None
    while len(times) < count:
        hub.sleep(0.001)
    receiver.stop()
    return times


if __name__ == "__main__":
    print(json.dumps(_run(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))))
