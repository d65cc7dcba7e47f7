"""Data Updates on several servers under faults: `python -m benchmarks.cluster --json FILE [--rounds N]`.

A primary, two replicas and three sentinels on this machine, which miss a primary after a second.  In each round a
producer writes a reliable stream to a reader, and the primary is killed, frozen, or killed together with the
producer right after its `flush`.

`sentinel_acknowledged_lost`: items that `flush` covered and the reader never got, in all rounds.  `failover_ms_p50`:
the median of the reader's longest pauses, where the primary was killed.
"""

import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmarks.faults_stage import ChildProgram, until
from benchmarks.measure import arguments, machine, table, write_json
from sdnator.testing.sentinel_servers import SentinelServers

_MESSAGES = 200_000
_SIZE = 50
_OUTLIVING = 2_000
_OUTLIVING_SIZE = 5_000
"""A frame for each item, so that the slow reader has not fetched the last ones when `flush` returns."""
_SLOW_US = 1000
_QUIET_S = 30.0
"""What has not come by then is lost."""


class ClusterStage:
    """The servers of one round, a reader and a producer; a context manager."""

    def __init__(self, folder: Path, messages: int, *, size: int = _SIZE, delay_us: int = 0) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self.servers = SentinelServers(folder / "servers")
        self.messages = messages
        self._size = size
        self._delay_us = delay_us

    def __enter__(self) -> "ClusterStage":
        self._stack.enter_context(self.servers)
        self.consumer = self._start("consume", self._delay_us)
        self.consumer.wait(lambda line: "ready" in line)
        self.producer = self._start("produce", "reliable", 0, self.messages, self._size)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def result(self) -> tuple[int, float]:
        """Items that the reader did not get, and its longest pause in milliseconds."""
        until(self._complete)
        end = self.consumer.finish()
        return self.messages - int(end["numbers"]), 1000 * float(end["longest_pause_s"])

    def _complete(self) -> bool:
        last = self.consumer.lines()[-1]
        quiet = time.monotonic() - float(last["at"])
        return int(last.get("received", 0)) >= self.messages or quiet > _QUIET_S

    def _start(self, name: str, *rest: object) -> ChildProgram:
        program = ChildProgram(self._folder / f"{name}.jsonl", name, self.servers.url, *rest)
        self._stack.callback(program.kill)
        return program


def killed(folder: Path, scale: float) -> tuple[int, float]:
    """kill -9 of the primary under load."""
    with ClusterStage(folder, round(scale * _MESSAGES)) as stage:
        _at_a_quarter(stage)
        stage.servers.kill(stage.servers.primary)
        stage.producer.wait(lambda line: "flushed" in line)
        return stage.result()


def frozen(folder: Path, scale: float) -> tuple[int, float]:
    """SIGSTOP of the primary under load; its connections stay open."""
    with ClusterStage(folder, round(scale * _MESSAGES)) as stage:
        _at_a_quarter(stage)
        stage.servers.freeze([stage.servers.primary])
        stage.producer.wait(lambda line: "flushed" in line)
        return stage.result()


def killed_together(folder: Path, scale: float) -> tuple[int, float]:
    """kill -9 of producer and primary as soon as `flush` has returned, while the reader is far behind."""
    with ClusterStage(folder, round(scale * _OUTLIVING), size=_OUTLIVING_SIZE, delay_us=_SLOW_US) as stage:
        stage.producer.wait(lambda line: "flushed" in line)
        stage.producer.process.send_signal(signal.SIGKILL)
        stage.servers.kill(stage.servers.primary)
        return stage.result()


FAULTS: dict[str, Callable[[Path, float], tuple[int, float]]] = {
    "killed": killed,
    "frozen": frozen,
    "killed_together": killed_together,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run all rounds, print, write; 1 where something was lost."""
    options = arguments("cluster", __doc__, rounds=5).parse_args(argv)
    lost = 0
    pauses: dict[str, list[float]] = {name: [] for name in FAULTS}
    for _ in range(options.rounds):
        for name, fault in FAULTS.items():
            with tempfile.TemporaryDirectory(prefix="cluster-") as folder:
                missing, pause = fault(Path(folder), options.scale)
            print(f"{name}: lost {missing}, longest pause {pause:.0f} ms", file=sys.stderr, flush=True)
            lost += missing
            pauses[name].append(pause)
    table(["primary", "pause ms p50"], [[name, statistics.median(found)] for name, found in pauses.items()])
    figures = {
        "sentinel_acknowledged_lost": lost,
        "failover_ms_p50": {"sentinel": statistics.median(pauses["killed"])},
        "sentinel_pauses_ms": pauses,
        "machine": machine(),
    }
    write_json(options.json, figures)
    return int(lost > 0)


def _at_a_quarter(stage: ClusterStage) -> None:
    stage.producer.wait(lambda line: line.get("written", 0) >= stage.messages // 4)


if __name__ == "__main__":
    sys.exit(main())
