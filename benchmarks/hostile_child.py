"""The loop that attacks one decoder, in a child process that may die or hang.

    child ── memory shared with its parent: index, counts, memory, the input itself ──► parent
          └─ findings and the last words: files without a name ─────────────────────────┘

Nothing is sent for each input.  The parent looks at the shared memory now and then.
"""

import faulthandler
import gc
import json
import mmap
import os
import random
import struct
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from benchmarks.hostile_job import Job
from benchmarks.hostile_mutation import mutate_bytes
from benchmarks.hostile_target import DecoderTarget

_HEAD = struct.Struct("<QQQQQ")
_SAMPLE = struct.Struct("<Q")
_MOST_SAMPLES = 64
_DATA_AT = _HEAD.size + _SAMPLE.size * _MOST_SAMPLES
_MOST_DATA = 1 << 20
"""Bytes of an input that are shown of one that kills."""
_MOST_FINDINGS = 50
"""Of one job in full; more of them are counted only."""
_MOST_CORPUS = 64
_LARGEST_OF_CORPUS = 1 << 14
_PAGE = os.sysconf("SC_PAGE_SIZE")


class SharedProgress:
    """Memory that the child writes and its parent reads, also after the child's death."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, _DATA_AT + _MOST_DATA)

    def begin(self, index: int, done: int, data: bytes) -> None:
        """The input that is tried now, and how many are done."""
        kept = data[:_MOST_DATA]
        self._memory[_DATA_AT : _DATA_AT + len(kept)] = kept
        _HEAD.pack_into(self._memory, 0, index, done, self.crashes, len(kept), self.samples)

    def end(self, done: int) -> None:
        """All is done: no input is under way."""
        _HEAD.pack_into(self._memory, 0, 0, done, self.crashes, 0, self.samples)

    crashes = 0
    samples = 0

    def sample(self, resident: int) -> None:
        """Bytes in memory now; every other sample is dropped where there are too many."""
        if self.samples == _MOST_SAMPLES:
            kept = self.resident()[::2]
            self.samples = 0
            for one in kept:
                self.sample(one)
        _SAMPLE.pack_into(self._memory, _HEAD.size + self.samples * _SAMPLE.size, resident)
        self.samples += 1

    def resident(self) -> list[int]:
        """The samples so far."""
        return [
            _SAMPLE.unpack_from(self._memory, _HEAD.size + number * _SAMPLE.size)[0]
            for number in range(self.samples)
        ]

    def read(self) -> tuple[int, int, int, bytes, list[int]]:
        """Index, inputs done, crashes, the input that is tried, samples of memory; for the parent."""
        index, done, crashes, size, self.samples = _HEAD.unpack_from(self._memory)
        return index, done, crashes, self._memory[_DATA_AT : _DATA_AT + size], self.resident()

    def moved(self) -> bytes:
        """Differs as soon as another input is tried."""
        return self._memory[:16]

    def close(self) -> None:
        """Give the memory back."""
        self._memory.close()


class Attacker:
    """The loop, in the child."""

    def __init__(self, target: DecoderTarget, job: Job, place: SharedProgress, out: IO[bytes]) -> None:
        self._target, self._job, self._place, self._out = target, job, place, out
        self._in_threads: list[BaseException] = []
        self._done = 0
        self._next_sample = 0.0
        self._pause = 0.0
        threading.excepthook = self._thread_died

    def run(self) -> None:
        """One block of inputs after another, each from target, seed and index alone."""
        job = self._job
        target = self._target
        if job.corpus:
            target = target._replace(seeds=(*target.seeds, *map(bytes.fromhex, job.corpus)))
        genuine = len(self._target.seeds)
        end = time.process_time() + job.seconds
        for index in range(job.first, job.first + job.count):
            if self._done and (time.process_time() > end or time.monotonic() > job.until):
                break
            # the genuine ones are the first, however many others were found
            self._try(index, (self._target if index < genuine else target).input(job.seed, index))
            if self._done == 1 and job.seconds < 1e9:
                # what is prepared once does not count
                end = time.process_time() + job.seconds
        self._place.sample(resident())
        self._place.end(self._done)

    def guided(self, folder: Path) -> None:
        """The same with libFuzzer's choice of what to mutate; inputs that reach new code are told at the end."""
        import atheris

        corpus, seeds = folder / "corpus", folder / "seeds"
        for each in (corpus, seeds):
            each.mkdir(exist_ok=True)
            for old in each.iterdir():
                old.unlink()
        for number, seed in enumerate(self._target.seeds):
            (seeds / str(number)).write_bytes(seed)
        largest = max(4096, *(2 * len(seed) for seed in self._target.seeds))
        job = self._job
        count, end = job.count, time.process_time() + job.seconds

        def one(data: bytes) -> None:
            if self._done >= count or time.process_time() > end or time.monotonic() > job.until:
                self._tell_corpus(corpus)
                self._place.sample(resident())
                self._place.end(self._done)
                os._exit(0)
            self._try(self._done, data)

        atheris.Setup(
            ["hostile", f"-seed={job.seed}", f"-max_len={largest}", "-rss_limit_mb=0", "-timeout=1000000",
             "-verbosity=0", "-handle_abrt=0", "-handle_segv=0", str(corpus), str(seeds)],
            one,
            # looked up with each call: Setup exchanges it
            custom_mutator=_mutator(self._target, lambda data, most: atheris.Mutate(data, most)),  # noqa: PLW0108
        )  # fmt: skip
        faulthandler.enable()
        atheris.Fuzz()

    def _tell_corpus(self, folder: Path) -> None:
        found = [path.read_bytes() for path in sorted(folder.iterdir())]
        chosen = sorted((one for one in found if len(one) <= _LARGEST_OF_CORPUS), key=len)
        step = max(1, len(chosen) // _MOST_CORPUS)
        self._tell({"corpus": [one.hex() for one in chosen[::step][:_MOST_CORPUS]]})

    def _try(self, index: int, data: bytes) -> None:
        place = self._place
        place.begin(index, self._done, data)
        try:
            self._target.attack(data)
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 - also a panic of a compiled library
            self._note(index, data, error)
        while self._in_threads:
            self._note(index, data, self._in_threads.pop())
        self._done += 1
        now = time.monotonic()
        if now >= self._next_sample:
            place.sample(resident())
            # collecting garbage for it must not take more than a small part of the time
            self._pause = max(0.2, 20 * (time.monotonic() - now))
            self._next_sample = time.monotonic() + self._pause

    def _note(self, index: int, data: bytes, error: BaseException) -> None:
        self._place.crashes += 1
        if self._place.crashes <= _MOST_FINDINGS:
            self._tell({"finding": finding(self._target.name, index, data, error)})

    def _tell(self, line: dict[str, Any]) -> None:
        self._out.write(json.dumps(line).encode() + b"\n")
        self._out.flush()

    def _thread_died(self, died: threading.ExceptHookArgs) -> None:
        error = died.exc_value
        if error is not None:
            trace: TracebackType | None = died.exc_traceback
            self._in_threads.append(error.with_traceback(trace))


def _mutator(
    target: DecoderTarget, libfuzzer: Callable[[bytes, int], bytes]
) -> Callable[[bytes, int, int], bytes]:
    def mutate(data: bytes, most: int, seed: int) -> bytes:
        chance = random.Random(seed)
        if chance.random() < 0.4:
            return libfuzzer(data, most)
        try:
            return target.mutate(chance, (data, *target.seeds) if data else target.seeds)[:most]
        except Exception:  # noqa: BLE001 - the structure of damaged data cannot always be changed
            return mutate_bytes(chance, (data, *target.seeds))[:most]

    return mutate


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


def resident() -> int:
    """Bytes of this process in memory, garbage not counted."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE
