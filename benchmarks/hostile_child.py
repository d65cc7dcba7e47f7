"""One child process that attacks decoders, watched: it is killed where it hangs or grows, and started again behind."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.hostile_worker import PLACE, targets_of

_LOOK_S = 0.05
_START_S = 600.0
"""For imports, and for what a target prepares with its first input."""
_MOST_RESIDENT = 4 << 30
_PAGE = os.sysconf("SC_PAGE_SIZE")
_TAIL = 6000
_MOST_RESTARTS = 20
"""Of one job: a target that dies so often is no use to attack further."""


@dataclass
class Figures:
    """What became of one job."""

    inputs: int = 0
    crashes: int = 0
    hangs: int = 0
    seconds: float = 0.0
    rss_growth_mb: float = 0.0
    findings: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Job:
    """Inputs `first` to `first + count` of one target."""

    target: str
    first: int
    count: int
    seconds: float = 1e9
    """It stops after these, however many inputs are left."""


@dataclass(frozen=True)
class Attack:
    """What all children share."""

    seed: int
    hang_s: float
    environment: Mapping[str, str] = field(default_factory=dict)


def run_jobs(module: str, jobs: Sequence[Job], attack: Attack, seconds: float) -> list[Figures]:
    """Attack in a child process, in another one where it dies or hangs; figures in the order of the jobs.

    Args:
        module: where the targets are listed.
        jobs: in their order.
        attack: seed, and seconds after which one input hangs.
        seconds: for all jobs together; what is not done then is left undone.
    """
    found = [Figures() for _ in jobs]
    left, end = list(jobs), time.monotonic() + seconds
    restarts, number = 0, 0
    while number < len(jobs) and time.monotonic() < end:
        stopped = _Child(module, left[number:], attack, end - time.monotonic()).watch(found[number:])
        if stopped is None:
            break
        number, restarts = (number + stopped.job, 0) if stopped.job else (number, restarts + 1)
        job = left[number]
        left[number] = replace(job, first=stopped.index + 1, count=job.first + job.count - stopped.index - 1)
        if left[number].count <= 0 or restarts >= _MOST_RESTARTS:
            number, restarts = number + 1, 0
    return found


@dataclass(frozen=True)
class _Stopped:
    job: int
    index: int


class _Child:
    def __init__(self, module: str, jobs: Sequence[Job], attack: Attack, seconds: float) -> None:
        self._module, self._jobs, self._attack, self._seconds = module, jobs, attack, seconds

    def watch(self, figures: Sequence[Figures]) -> _Stopped | None:
        """Until it ends; where it did not end well, at which input."""
        with tempfile.TemporaryDirectory(prefix="hostile-") as made:
            folder = Path(made)
            progress = folder / "progress"
            progress.write_bytes(PLACE.pack(0, self._jobs[0].first))
            with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
                process = self._started(progress, out, err, folder)
                began = time.monotonic()
                cause = self._wait(process, progress)
                seconds = time.monotonic() - began
            place = PLACE.unpack(progress.read_bytes())
            self._collect(folder / "out", figures)
            if process.returncode == 0:
                return None
            stopped = _Stopped(*place)
            words = (folder / "err").read_bytes()[-_TAIL:].decode(errors="replace")
            self._note(stopped, cause or _ending(process.returncode), words, figures, seconds)
            return stopped

    def _started(self, progress: Path, out: Any, err: Any, folder: Path) -> subprocess.Popen[bytes]:
        jobs = [json.dumps([job.target, job.first, job.count, job.seconds]) for job in self._jobs]
        command = [sys.executable, "-m", "benchmarks.hostile_worker", self._module, str(self._attack.seed)]
        environment = {
            **os.environ,
            **self._attack.environment,
            "TMPDIR": str(folder),
            "PYTHONFAULTHANDLER": "1",
        }
        return subprocess.Popen(
            [*command, str(self._seconds), str(progress), *jobs], stdout=out, stderr=err, env=environment
        )

    def _wait(self, process: subprocess.Popen[bytes], progress: Path) -> str:
        """Why it was killed; empty where it ended by itself."""
        seen, since = b"", time.monotonic()
        while process.poll() is None:
            time.sleep(_LOOK_S)
            now, place = time.monotonic(), progress.read_bytes()
            if place != seen:
                seen, since = place, now
            job, index = PLACE.unpack(place)
            first = index == self._jobs[job].first
            cause = ""
            if now - since > (_START_S if first else self._attack.hang_s):
                cause = "hang"
            elif _resident(process.pid) > _MOST_RESIDENT:
                cause = "memory"
            if cause:
                process.send_signal(signal.SIGABRT)  # faulthandler tells where it is
                try:
                    process.wait(5)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                return cause
        return ""

    def _collect(self, out: Path, figures: Sequence[Figures]) -> None:
        numbers = {job.target: number for number, job in enumerate(self._jobs)}
        shown: Counter[int] = Counter()
        for line in out.read_text().splitlines(keepends=True):
            if not line.endswith("\n"):
                break  # it was killed while it wrote
            told = json.loads(line)
            if "finding" in told:
                number = numbers[told["finding"]["target"]]
                mine, shown[number] = figures[number], shown[number] + 1
                mine.findings.append(told["finding"])
                mine.crashes += 1
            else:
                one = told["figures"]
                mine = figures[one["job"]]
                mine.inputs += one["done"]
                mine.seconds += one["seconds"]
                mine.rss_growth_mb = max(mine.rss_growth_mb, one["rss_growth_mb"])
                mine.crashes += one["crashes"] - shown[one["job"]]

    def _note(
        self, stopped: _Stopped, cause: str, words: str, figures: Sequence[Figures], seconds: float
    ) -> None:
        job, mine = self._jobs[stopped.job], figures[stopped.job]
        target = next(each for each in targets_of(self._module) if each.name == job.target)
        mine.inputs += stopped.index - job.first + 1
        mine.seconds += seconds
        mine.hangs += cause == "hang"
        mine.crashes += cause != "hang"
        data = target.input(self._attack.seed, stopped.index)
        shown = {"kind": "hang" if cause == "hang" else "death", "error": cause, "where": cause}
        mine.findings.append(
            {"target": job.target, "index": stopped.index, **shown, "input": data.hex(), "traceback": words}
        )


def _resident(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE
    except (OSError, IndexError, ValueError):
        return 0


def _ending(code: int) -> str:
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
