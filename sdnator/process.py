"""One program of the pipeline as a child process: start, readiness, log, end."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sdnator.errors import PipelineError

START_SECONDS = 180.0
"""A part that lives is starting, however slowly: on a busy machine that took over half a minute."""
STOP_SECONDS = 10.0
_PARENT_VARIABLE = "DUE_PARENT"
"""`due.service.PARENT_VARIABLE`; importing that takes longer than `sdnator --help` may."""


class Child:
    """A Python program of ours that prints one JSON line when it is ready.

    Args:
        name: for messages and the log file's name.
        arguments: behind `python -m`.
        logs: folder for `<name>.log`, which takes the program's standard error.
    """

    def __init__(self, name: str, arguments: Sequence[str], logs: Path) -> None:
        self.name = name
        self.log = logs / f"{name}.log"
        with self.log.open("ab") as stderr:
            # A process group of its own: Ctrl-C reaches us only, and we stop the children in order.  Not a session
            # of its own: Linux shares processors out by session first (sched_autogroup), and then whoever sleeps
            # most of the time, as Data Updates do, waits 100 ms and more for a processor beside busy parts.
            self._process = subprocess.Popen(
                [sys.executable, "-m", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=stderr,
                process_group=0,
                env=os.environ | {_PARENT_VARIABLE: str(os.getpid())},
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def wait_ready(self, seconds: float = START_SECONDS) -> dict[str, Any]:
        """The JSON object of the ready line; raises PipelineError with the log's end otherwise."""
        assert self._process.stdout is not None  # noqa: S101 - opened as a pipe above
        descriptor = self._process.stdout.fileno()
        deadline = time.monotonic() + seconds
        line = b""
        while not line.endswith(b"\n"):
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([descriptor], [], [], left)[0]:
                raise PipelineError(f"{self.name} was not ready within {seconds:.0f} s{self._log_tail()}")
            read = os.read(descriptor, 65_536)
            if not read:
                raise self._ended()
            line += read
        ready: dict[str, Any] = json.loads(line)
        return ready

    def check(self) -> None:
        """Raise PipelineError if the program has ended."""
        if self._process.poll() is not None:
            raise self._ended()

    def _ended(self) -> PipelineError:
        code = self._process.wait()
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return PipelineError(f"{self.name} {how}{self._log_tail()}")

    def _log_tail(self) -> str:
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return ""
        return "; its last words:\n  " + "\n  ".join(lines[-5:]) if lines else " without a word"

    def stop(self) -> None:
        """Ask it to end, and make it."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
