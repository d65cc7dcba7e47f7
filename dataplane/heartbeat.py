"""Heartbeats for the supervisor: one byte per second on an inherited pipe, while all threads make progress.

    Heartbeat ── ask ──► event loop of P4Runtime ── turns ─┐
              ── ask ──► packet loop ─────────────── turns ─┴─► all went on since the last byte? write one

A thread that hangs, or a process that is stopped, sends no more; the supervisor's time-out does the rest.  Where the
program has reached beyond the end of an array, the byte is followed by how often, as `N;`.
"""

import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

from dataplane.errors import DataplaneError

INTERVAL_S = 1.0


class HeartbeatError(DataplaneError):
    """The descriptor is not open."""


class Turning(Protocol):
    """A loop in its own thread."""

    @property
    def turns(self) -> int:
        """Rounds made so far."""
        ...

    def ask(self) -> None:
        """Make a round soon, even without work; from any thread."""


class LivenessPipe:
    """Writes to `descriptor` in a thread of its own.

    descriptor: of a pipe's end for writing; one that is full is left as it is
    loops: that all have to turn
    out_of_range: accesses beyond the end of arrays so far

    Raises HeartbeatError.
    """

    def __init__(
        self,
        descriptor: int,
        loops: Sequence[Turning],
        interval_s: float = INTERVAL_S,
        out_of_range: Callable[[], int] = int,
    ) -> None:
        try:
            os.set_blocking(descriptor, False)
            os.set_inheritable(descriptor, False)
        except OSError as error:
            raise HeartbeatError(f"heartbeat descriptor {descriptor}: {error.strerror}") from error
        self._descriptor, self._loops, self._interval_s = descriptor, tuple(loops), interval_s
        self._out_of_range = out_of_range
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; the descriptor stays open."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        before = self._asked()
        while not self._stopping.wait(self._interval_s):
            if all(loop.turns != turns for loop, turns in zip(self._loops, before, strict=True)):
                before = self._asked()
                with suppress(BlockingIOError, BrokenPipeError):
                    beyond = self._out_of_range()
                    os.write(self._descriptor, b".%d;" % beyond if beyond else b".")

    def _asked(self) -> list[int]:
        turns = [loop.turns for loop in self._loops]
        for loop in self._loops:
            loop.ask()
        return turns
