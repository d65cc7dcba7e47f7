"""Worker processes, and how many inputs each decoder gets of them.

trial of every target ──► rates ──► shares ──► main part, half without and half with
                                               what the guided loop has found meanwhile
"""

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field

from benchmarks.hostile_job import Figures, Job

PLAIN, GUIDED, SANITIZED = "plain", "guided", "sanitized"
LEAST = 2000
"""Inputs of every target, however slow it is, where time and number of inputs allow it."""
_TRIAL_SHARE = 0.3
"""Of the time, for the least of all targets together."""
_GUIDED_SHARE = 0.15
_SHARE_OF_TIME = 0.85
_MOST_SHARE = 0.05
"""Of all inputs, for one target: a cheap one must not stand for the others."""
_ROUNDS = 5


@dataclass(frozen=True)
class ProcessKind:
    """Processes that have imported the same modules in the same way."""

    modules: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)
    guided: bool = False


@dataclass(frozen=True)
class Attack:
    """What all jobs share."""

    seed: int
    hang_s: float


class _Process:
    """One worker process, started with its first job, and again after its death."""

    def __init__(self, kind: ProcessKind) -> None:
        self._kind = kind
        self._process: subprocess.Popen[str] | None = None

    def run(self, job: Job) -> Figures:
        process = self._process or self._started()
        self._process = process
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(asdict(job)) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            self.close()
            raise RuntimeError(f"the worker process for {job.target} has ended: its words are above")
        return Figures(**json.loads(line))

    def _started(self) -> subprocess.Popen[str]:
        kind = self._kind
        program = "benchmarks.hostile_guided" if kind.guided else "benchmarks.hostile_worker"
        # more threads would wait for each other where every core has a worker
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **kind.environment}
        return subprocess.Popen(
            [sys.executable, "-m", program, *kind.modules],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )

    def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.stdin and process.stdin.close()
            process.wait()
            process.stdout and process.stdout.close()


class Pool:
    """As many worker threads as there are to be children at a time, each with a process of every kind.

    Args:
        targets: their kind by name.
        kinds: how to start the processes; called once, in a worker thread, for what takes time to prepare.
    """

    def __init__(
        self, targets: Mapping[str, str], kinds: Mapping[str, Callable[[], ProcessKind]], workers: int
    ) -> None:
        self._targets, self._kinds = targets, kinds
        self._ready: dict[str, Future[ProcessKind]] = {}
        self._lock = threading.Lock()
        self._local = threading.local()
        self._processes: list[_Process] = []
        self._threads = ThreadPoolExecutor(max(1, workers))

    def submit(self, *jobs: Job) -> "Future[dict[str, Figures]]":
        """Run jobs of different targets one after another; their figures by target."""
        return self._threads.submit(self._run, jobs)

    def _run(self, jobs: Sequence[Job]) -> dict[str, Figures]:
        return {
            job.target: self._process(GUIDED if job.guided else self._targets[job.target]).run(job)
            for job in jobs
        }

    def _process(self, name: str) -> _Process:
        mine: dict[str, _Process] = self._local.__dict__.setdefault("processes", {})
        if name not in mine:
            mine[name] = _Process(self._kind(name))
            with self._lock:
                self._processes.append(mine[name])
        return mine[name]

    def _kind(self, name: str) -> ProcessKind:
        with self._lock:
            first = name not in self._ready
            ready = self._ready.setdefault(name, Future())
        if first:
            try:
                ready.set_result(self._kinds[name]())
            except BaseException as error:
                ready.set_exception(error)
                raise
        return ready.result()

    def close(self) -> None:
        """End all processes."""
        self._threads.shutdown(cancel_futures=True)
        for process in self._processes:
            process.close()


class Campaign:
    """All inputs for all targets in the time that there is.

    Args:
        pool: where jobs run.
        targets: all names.
        guided: those that also get inputs by coverage.
        inputs: of all targets together.
        seconds: the longest that all of it may take.
        workers: of the pool.
    """

    def __init__(
        self,
        pool: Pool,
        targets: Sequence[str],
        attack: Attack,
        *,
        guided: Sequence[str],
        inputs: int,
        seconds: float,
        workers: int,
    ) -> None:
        self._pool, self._attack, self._guided = pool, attack, guided
        self._inputs, self._seconds, self._workers = inputs, seconds, max(1, workers)
        self._end = time.monotonic() + seconds
        self._next = dict.fromkeys(targets, 0)
        self.results = {name: Figures() for name in targets}

    def run(self) -> None:
        """Trial, main part, and what is still missing then."""
        results, inputs = self.results, self._inputs
        least = min(LEAST, max(1, inputs // max(1, len(results))))
        longest = self._seconds * self._workers * _TRIAL_SHARE / max(1, len(results))
        self._wait([self._pool.submit(self._job(name, least, longest)) for name in results])
        for number in range(_ROUNDS):
            part = inputs if number else (inputs + sum(one.inputs for one in results.values())) // 2
            counts = shares(results, part, self._left() * self._workers * _SHARE_OF_TIME / (2 - bool(number)))
            if not counts and number:
                break
            # the longest first, so that no worker is left alone with it
            slow = sorted(counts, key=lambda name: counts[name] / rate(results[name]), reverse=True)
            jobs = [(self._job(name, counts[name], self._seconds),) for name in slow]
            found = self._guided_jobs(min(counts.values(), default=0)) if not number else ()
            self._wait([self._pool.submit(*each) for each in ((found, *jobs) if found else jobs)])

    def _left(self) -> float:
        return max(0.0, self._end - time.monotonic())

    def _job(self, name: str, count: int, seconds: float) -> Job:
        corpus = tuple(self.results[name].corpus)
        first, self._next[name] = self._next[name], self._next[name] + count
        attack = self._attack
        return Job(name, first, count, seconds, self._end, attack.seed, attack.hang_s, corpus=corpus)

    def _guided_jobs(self, count: int) -> tuple[Job, ...]:
        """For one process after another: it takes long to start, for all that it imports is instrumented."""
        seconds = self._seconds * self._workers * _GUIDED_SHARE / max(1, len(self._guided))
        most = min(count, LEAST) or LEAST
        attack = self._attack
        return tuple(
            Job(name, 0, most, seconds, self._end, attack.seed, attack.hang_s, guided=True)
            for name in self._guided
        )

    def _wait(self, futures: "Sequence[Future[dict[str, Figures]]]") -> None:
        for future in futures:
            for name, figures in future.result().items():
                self.results[name].add(figures)


def rate(figures: Figures) -> float:
    """Inputs a second."""
    return max(0.1, figures.inputs / max(figures.seconds, 1e-6))


def shares(results: Mapping[str, Figures], inputs: int, seconds: float) -> dict[str, int]:
    """How many inputs each target gets of those that are left: fast ones more, as much as the time asks for.

    Args:
        results: with inputs and seconds so far.
        inputs: of all targets together, those included that were made already.
        seconds: of one process, that are left.
    """
    missing = inputs - sum(one.inputs for one in results.values())
    if missing <= 0 or seconds <= 0:
        return {}
    rates = {name: rate(one) for name, one in results.items() if one.inputs}
    least = min(200, max(1, missing // max(1, len(rates))))
    counts: dict[str, int] = {}
    for power in range(5, 21):
        weights = {name: one ** (power / 10) for name, one in rates.items()}
        whole = math.fsum(weights.values())
        most = max(least, round(inputs * _MOST_SHARE), round(missing / len(rates)))
        counts = {
            name: min(most, max(least, round(missing * weight / whole))) for name, weight in weights.items()
        }
        if sum(count / rates[name] for name, count in counts.items()) <= seconds:
            break
    return counts
