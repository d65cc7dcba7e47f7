"""The process in which decoders are attacked: it may die or hang, whoever started it sees at which input.

    python -m benchmarks.hostile_worker MODULE SEED SECONDS PROGRESS JOB …        JOB = [target, first index, count, seconds]

PROGRESS is a file of two numbers, job and index, written before each input.  Findings and figures are JSON lines
on standard output.
"""

import faulthandler
import gc
import importlib
import json
import logging
import mmap
import os
import struct
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from benchmarks.hostile_target import DecoderTarget

PLACE = struct.Struct("<QQ")
_MOST_FINDINGS = 50
"""Of one job in full; more of them are counted only."""
_PAGE = os.sysconf("SC_PAGE_SIZE")


def targets_of(module: str) -> tuple[DecoderTarget, ...]:
    """The targets that a module lists."""
    found: tuple[DecoderTarget, ...] = importlib.import_module(module).TARGETS
    return found


def finding(target: str, index: int, data: bytes, error: BaseException) -> dict[str, Any]:
    """What came out of a decoder and should not."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    return {
        "target": target,
        "index": index,
        "kind": "exception",
        "error": f"{type(error).__name__}: {error}"[:500],
        "where": where,
        "input": data.hex(),
        "traceback": "".join(traceback.format_exception(error))[-4000:],
    }


class _Worker:
    def __init__(self, module: str, seed: int, seconds: float, progress: Path) -> None:
        self._targets = {target.name: target for target in targets_of(module)}
        self._seed = seed
        self._end = time.monotonic() + seconds
        with progress.open("r+b") as file:
            self._place = mmap.mmap(file.fileno(), PLACE.size)
        self._in_threads: list[BaseException] = []
        threading.excepthook = self._thread_died

    def _thread_died(self, died: threading.ExceptHookArgs) -> None:
        error = died.exc_value
        if error is not None:
            trace: TracebackType | None = died.exc_traceback
            self._in_threads.append(error.with_traceback(trace))

    def run(self, jobs: Sequence[tuple[str, int, int, float]]) -> None:
        for number, (name, first, count, seconds) in enumerate(jobs):
            self._job(number, self._targets[name], range(first, first + count), seconds)

    def _job(self, number: int, target: DecoderTarget, indices: range, limit: float) -> None:
        began, crashes, resident_at_first, done = time.monotonic(), 0, 0, 0
        end = self._end
        for index in indices:
            if done == 1:
                # the first input waits for what is prepared once, such as a build under sanitizers
                began = time.monotonic()
                end = min(self._end, began + limit)
            if done == max(1, len(indices) // 10):
                resident_at_first = resident()
            if done and time.monotonic() > end:
                break
            PLACE.pack_into(self._place, 0, number, index)
            data = target.input(self._seed, index)
            for error in self._raised(target, data):
                crashes += 1
                if crashes <= _MOST_FINDINGS:
                    _tell({"finding": finding(target.name, index, data, error)})
            done += 1
        seconds = time.monotonic() - began
        growth = (resident() - resident_at_first) / (1 << 20) if resident_at_first else 0.0
        figures = {
            "job": number,
            "done": done,
            "crashes": crashes,
            "seconds": seconds,
            "rss_growth_mb": growth,
        }
        _tell({"figures": figures})

    def _raised(self, target: DecoderTarget, data: bytes) -> list[BaseException]:
        try:
            target.attack(data)
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 - also a panic of a compiled library
            return [error]
        if not self._in_threads:
            return []
        raised, self._in_threads = self._in_threads, []
        return raised


def resident() -> int:
    """Bytes of this process in memory, garbage not counted."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE


def _tell(line: dict[str, Any]) -> None:
    print(json.dumps(line), flush=True)


def main() -> None:
    """Run the jobs of the command line."""
    faulthandler.enable()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    module, seed, seconds, progress, *jobs = sys.argv[1:]
    worker = _Worker(module, int(seed), float(seconds), Path(progress))
    worker.run([tuple(json.loads(job)) for job in jobs])
    sys.stdout.flush()
    os._exit(0)  # a thread of a target that waits for ever is no finding of the last input


if __name__ == "__main__":
    main()
