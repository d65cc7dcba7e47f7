"""`benchmarks.cluster`: a primary, two replicas and three sentinels, which miss a primary after a second."""

import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.cluster_stage import (
    OUTLIVING_SIZE,
    SLOW_US,
    Round,
    StreamStage,
    lost_in,
    median_pause,
    pauses_of,
    rounds_of,
)
from sdnator.testing.sentinel_servers import SentinelServers

_MESSAGES = 200_000
_OUTLIVING = 2_000


def figures(rounds: int, scale: float, end: float) -> dict[str, Any]:
    """Losses and pauses of all rounds; no further one begins after `end` (s, monotonic)."""

    def run(name: str, _number: int) -> Round:
        with (
            tempfile.TemporaryDirectory(prefix="cluster-") as folder,
            SentinelServers(Path(folder) / "servers") as servers,
        ):
            return FAULTS[name](Path(folder), servers, scale)

    found = rounds_of(FAULTS, run, rounds, end)
    return {
        "sentinel_acknowledged_lost": lost_in(found),
        "failover_ms_p50": {"sentinel": median_pause(found, "killed")},
        "sentinel_pauses_ms": pauses_of(found),
    }


def killed(folder: Path, servers: SentinelServers, scale: float) -> Round:
    """kill -9 of the primary under load."""
    with StreamStage(folder, servers.url, round(scale * _MESSAGES)) as stage:
        stage.begin().wait_for_quarter()
        servers.kill(servers.primary)
        stage.wait_for_flush()
        return stage.result()


def frozen(folder: Path, servers: SentinelServers, scale: float) -> Round:
    """SIGSTOP of the primary under load; its connections stay open."""
    with StreamStage(folder, servers.url, round(scale * _MESSAGES)) as stage:
        stage.begin().wait_for_quarter()
        servers.freeze([servers.primary])
        stage.wait_for_flush()
        return stage.result()


def killed_together(folder: Path, servers: SentinelServers, scale: float) -> Round:
    """kill -9 of producer and primary as soon as `flush` has returned, while the reader is far behind."""
    messages = round(scale * _OUTLIVING)
    with StreamStage(folder, servers.url, messages, size=OUTLIVING_SIZE, delay_us=SLOW_US) as stage:
        stage.begin().wait_for_flush()
        stage.producer.process.send_signal(signal.SIGKILL)
        servers.kill(servers.primary)
        return stage.result()


FAULTS: dict[str, Callable[[Path, SentinelServers, float], Round]] = {
    "killed": killed,
    "frozen": frozen,
    "killed_together": killed_together,
}
