"""A reliable stream between two programs while its servers break: for `cluster_sentinel` and `cluster_kafka`."""

import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, Self

from benchmarks.faults_stage import ChildProgram, until

SIZE = 50
OUTLIVING_SIZE = 5_000
"""A frame for each item, so that the slow reader has not fetched the last ones when `flush` returns."""
SLOW_US = 1000
_QUIET_S = 60.0
"""What has not come by then is lost."""


class PartMissing(Exception):
    """This machine lacks what a part needs; the text says what."""


class Round(NamedTuple):
    """What came of one fault."""

    lost: int
    """Items that `flush` covered and the reader did not get."""
    pause_ms: float
    """The reader's longest."""


class StreamStage:
    """A reader and a producer of one reliable stream; a context manager.

    Args:
        folder: for what they say.
        url: of Data Updates.
        messages: how many the producer writes.
        size: bytes of each besides its number.
        delay_us: how long the reader works on each.
        before: how many more another producer writes, which the reader has before this one begins.
    """

    def __init__(
        self, folder: Path, url: str, messages: int, *, size: int = SIZE, delay_us: int = 0, before: int = 0
    ) -> None:
        self._folder, self._url = folder, url
        self._stack = ExitStack()
        self.messages = before + messages
        self._before = before
        self._size = size
        self._delay_us = delay_us

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self.consumer = self._start(stack, "consume", "consume", self._delay_us)
            self.consumer.wait(lambda line: "ready" in line)
            if self._before:
                self._produce(stack, 0, self._before)
                self.consumer.wait(lambda line: line.get("received", 0) >= self._before)
            self._stack = stack.pop_all()
        return self

    def begin(self) -> Self:
        """Start the producer."""
        self.producer = self._produce(self._stack, self._before, self.messages - self._before)
        return self

    def _produce(self, stack: ExitStack, first: int, count: int) -> ChildProgram:
        return self._start(stack, f"produce{first}", "produce", "reliable", first, count, self._size)

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def wait_for_quarter(self) -> None:
        """Return when the reader has a quarter."""
        self.consumer.wait(lambda line: line.get("received", 0) >= self.messages // 4)

    def wait_for_flush(self) -> None:
        """Return when the producer's `flush` has."""
        self.producer.wait(lambda line: "flushed" in line)

    def result(self) -> Round:
        """When everything has come, or nothing more does."""
        until(self._complete)
        end = self.consumer.finish()
        return Round(self.messages - int(end["numbers"]), 1000 * float(end["longest_pause_s"]))

    def _complete(self) -> bool:
        last = self.consumer.lines()[-1]
        quiet = time.monotonic() - float(last["at"])
        return int(last.get("received", 0)) >= self.messages or quiet > _QUIET_S

    def _start(self, stack: ExitStack, said: str, name: str, *rest: object) -> ChildProgram:
        program = ChildProgram(self._folder / f"{said}.jsonl", name, self._url, *rest)
        stack.callback(program.kill)
        return program


def rounds_of(
    faults: Iterable[str], run: Callable[[str, int], Round], rounds: int, end: float
) -> Mapping[str, Sequence[Round]]:
    """Run the faults in turn.

    Args:
        faults: their names.
        run: runs one, in the round of this number.
        rounds: how often.
        end: no further round begins after this time (s, monotonic).
    """
    found: dict[str, list[Round]] = {name: [] for name in faults}
    for number in range(rounds):
        if number and time.monotonic() > end:
            break
        for name, results in found.items():
            results.append(run(name, number))
            lost, pause = results[-1]
            print(f"{name}: lost {lost}, longest pause {pause:.0f} ms", file=sys.stderr, flush=True)
    return found


def lost_in(found: Mapping[str, Sequence[Round]]) -> int:
    """Items, in all rounds."""
    return sum(one.lost for results in found.values() for one in results)


def pauses_of(found: Mapping[str, Sequence[Round]]) -> dict[str, list[float]]:
    """Milliseconds, by fault."""
    return {name: [one.pause_ms for one in results] for name, results in found.items()}


def median_pause(found: Mapping[str, Sequence[Round]], fault: str) -> float:
    """Milliseconds."""
    return statistics.median(one.pause_ms for one in found[fault])
