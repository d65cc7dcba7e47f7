"""The process that imports the decoders once, and forks a child for each job that it reads.

    python -m benchmarks.hostile_worker MODULE …     jobs on standard input, figures on standard output

A child is watched: it is killed where it hangs or grows, and another one goes on behind the input that did it.
"""

import ctypes
import faulthandler
import gc
import importlib
import json
import logging
import os
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.hostile_child import Attacker, SharedProgress
from benchmarks.hostile_job import Figures, Job
from benchmarks.hostile_target import DecoderTarget

_LOOK_S = 0.05
_CLOCK_FACTOR = 12
"""A machine may be busy: an input that waits gets more time by the clock than by the CPU."""
_START_S = 60.0
"""CPU seconds for what a target prepares with its first input."""
_MOST_RESIDENT = 4 << 30
_PAGE = os.sysconf("SC_PAGE_SIZE")
_TICKS = os.sysconf("SC_CLK_TCK")
_MB = 1 << 20
_TAIL = 6000
_MOST_RESTARTS = 20
"""Of one job: a target that dies so often is no use to attack further."""
_PR_SET_PDEATHSIG = 1


def targets_of(module: str) -> tuple[DecoderTarget, ...]:
    """The targets that a module lists."""
    found: tuple[DecoderTarget, ...] = importlib.import_module(module).TARGETS
    return found


class _Ended(NamedTuple):
    cause: str
    """Empty where it ended well."""
    at: int
    data: bytes
    words: str
    left_s: float


class _Watch:
    """Jobs on the targets, one child at a time."""

    def __init__(self, targets: Mapping[str, DecoderTarget], folder: Path) -> None:
        self._targets, self._folder = targets, folder

    def attacked(self, job: Job) -> Figures:
        """All of a job, in as many children as it takes."""
        found, restarts = Figures(), 0
        while job.count > 0 and restarts < _MOST_RESTARTS and time.monotonic() < job.until:
            before = found.inputs
            ended = self._child(job, found)
            if not ended.cause:
                break
            self._note(job, ended, found)
            done = found.inputs - before
            first = job.first if job.guided else ended.at + 1
            job = replace(
                job,
                first=first,
                count=job.count - done if job.guided else job.first + job.count - first,
                seed=job.seed + job.guided,
                seconds=ended.left_s,
            )
            restarts += 1
        return found

    def _child(self, job: Job, found: Figures) -> _Ended:
        place, began = SharedProgress(), time.monotonic()
        with os.fdopen(os.memfd_create("out"), "w+b") as out, os.fdopen(os.memfd_create("err"), "w+b") as err:
            pid = os.fork()
            if not pid:
                self._in_child(job, place, out, err.fileno())
            cause, code, used = _waited(pid, place, job)
            index, done, crashes, data, samples = place.read()
            seconds = time.monotonic() - began
            cause = cause or _ending(code)
            found.inputs += done + bool(cause)
            found.guided += (done + bool(cause)) * job.guided
            found.crashes += crashes
            found.seconds += seconds
            found.cpu_s += used.ru_utime + used.ru_stime
            found.peak_mb = max(found.peak_mb, used.ru_maxrss / 1024)
            if samples:
                found.rss_first_mb, found.rss_last_mb = samples[len(samples) // 4] / _MB, samples[-1] / _MB
            for line in _lines(out):
                if "finding" in line:
                    found.findings.append(line["finding"])
                else:
                    found.corpus += line["corpus"]
            err.seek(0)
            words = err.read()[-_TAIL:].decode(errors="replace")
        place.close()
        return _Ended(cause, index, data, words, max(0.0, job.seconds - seconds))

    def _in_child(self, job: Job, place: SharedProgress, out: Any, words: int) -> None:
        """Never returns."""
        code = 1
        try:
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
            os.dup2(words, 2)
            faulthandler.enable()
            attacker = Attacker(self._targets[job.target], job, place, out)
            if job.guided:
                attacker.guided(self._folder)
            else:
                attacker.run()
            code = 0
        except BaseException:  # noqa: BLE001 - told by the exit code and the words
            logging.disable(logging.NOTSET)
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stderr.flush()
            os._exit(code)  # a thread of a target that waits for ever is no finding

    def _note(self, job: Job, ended: _Ended, found: Figures) -> None:
        hang = ended.cause == "hang"
        found.hangs += hang
        found.crashes += not hang
        shown = {"kind": "hang" if hang else "death", "error": ended.cause, "where": ended.cause}
        found.findings.append(
            {"target": job.target, "index": ended.at, **shown, "input": ended.data.hex(),
             "traceback": ended.words}
        )  # fmt: skip


def _waited(pid: int, place: SharedProgress, job: Job) -> tuple[str, int, Any]:
    """Why it was killed (empty where it ended by itself), its exit code, what it used."""
    seen, since, cpu = place.moved(), time.monotonic(), 0.0
    first, parent = True, os.getppid()
    while True:
        ended, status, used = os.wait4(pid, os.WNOHANG)
        if ended:
            return "", os.waitstatus_to_exitcode(status), used
        time.sleep(_LOOK_S if not first else 0.002)
        moved = place.moved()
        now = time.monotonic()
        if moved != seen:
            first = False
            seen, since, cpu = moved, now, _cpu(pid)
        cause = ""
        if os.getppid() != parent:
            os.kill(pid, signal.SIGKILL)
            os._exit(1)  # nobody waits for figures any more
        limit, silent = _START_S if first or moved[8:] == bytes(8) else job.hang_s, now - since
        if silent > limit and (_cpu(pid) - cpu > limit or silent > limit * _CLOCK_FACTOR):
            cause = "hang"
        if not cause and _resident(pid) > _MOST_RESIDENT:
            cause = "memory"
        if cause:
            return cause, *_killed(pid)


def _killed(pid: int) -> tuple[int, Any]:
    os.kill(pid, signal.SIGABRT)  # faulthandler tells where it is
    end = time.monotonic() + 5
    while time.monotonic() < end:
        ended, status, used = os.wait4(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), used
        time.sleep(_LOOK_S)
    os.kill(pid, signal.SIGKILL)
    _, status, used = os.wait4(pid, 0)
    return os.waitstatus_to_exitcode(status), used


def _lines(file: Any) -> list[dict[str, Any]]:
    file.seek(0)
    # one without an end was cut off by a death
    return [json.loads(line) for line in file.read().splitlines(keepends=True) if line.endswith(b"\n")]


def _resident(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE
    except (OSError, IndexError, ValueError):
        return 0


def _cpu(pid: int) -> float:
    """CPU seconds of a process so far."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS
    except (OSError, IndexError, ValueError):
        return 0.0


def _ending(code: int) -> str:
    if not code:
        return ""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def main(arguments: Sequence[str]) -> None:
    """Import, then serve jobs until the end of standard input."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    # files of targets stay in memory, and are all gone at the end
    shared = Path("/dev/shm")  # noqa: S108 - mkdtemp makes a folder of our own in it
    tempfile.tempdir = tempfile.mkdtemp(prefix="hostile-", dir=shared if shared.is_dir() else None)
    try:
        listed = [targets_of(module) for module in arguments]
        watch = _Watch({one.name: one for targets in listed for one in targets}, Path(tempfile.tempdir))
        gc.collect()
        gc.freeze()  # children share it, and do not look through it for garbage
        for line in sys.stdin:
            given = json.loads(line)
            figures = watch.attacked(Job(**{**given, "corpus": tuple(given["corpus"])}))
            answers.write(json.dumps(asdict(figures)) + "\n")
            answers.flush()
    finally:
        shutil.rmtree(tempfile.tempdir, ignore_errors=True)


if __name__ == "__main__":
    main(sys.argv[1:])
