"""One program of the pipeline as a child process: start, readiness, heartbeat, log, end."""

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sdnator.errors import PipelineError
from sdnator.supervisor.spec import START_SECONDS

STOP_SECONDS = 10.0
SECRET_VARIABLES = (
    "DUE_UPDATES",
    "DUE_ARCHIVE",
    "DUE_CREDENTIAL",
    "DUE_COORDINATOR_TOKEN",
    "SDNATOR_UP_UPDATES",
    "SDNATOR_UP_ARCHIVE",
    "SDNATOR_DASHBOARD_TOKEN",
)
"""Variables not passed on to children: URLs may hold passwords, which parts read from a file."""
_PARENT_VARIABLE = "DUE_PARENT"
"""`due.service.PARENT_VARIABLE`; importing that takes longer than `sdnator --help` may."""
_LONGEST_LINE = 1 << 20
_LAST_LINES = 5
_COUNT = re.compile(rb"\.([0-9]{1,18});")
"""See `dataplane.heartbeat`."""


def suspended(pid: int) -> bool:
    """Whether the kernel says that a process is stopped by job control; no where it does not tell (no /proc)."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return fields.rpartition(")")[2].split()[:1] == ["T"]  # the name before may hold anything


class Child:
    """A Python program of ours that prints one JSON line when it is ready.

    Args:
        name: for messages and the log file's name.
        arguments: behind `python -m`.
        logs: folder for `<name>.log`, which takes the program's standard error.
        heartbeat: give it the writing end of a pipe as `--heartbeat-fd N`; it writes a byte about every second
            while it makes progress.
        environment: added to ours.
        waits: it prepares itself, and goes on at `begin`.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        logs: Path,
        *,
        heartbeat: bool = False,
        environment: Mapping[str, str] | None = None,
        waits: bool = False,
    ) -> None:
        self.name = name
        self.log = logs / f"{name}.log"
        self.waits = waits
        """Whether it goes on, or went on, at `begin` only."""
        self.out_of_range = 0
        """See `PartProcess.out_of_range`."""
        self._line = b""
        self._said: dict[str, Any] | None = None
        self._beats = -1
        beat = -1
        command = [sys.executable, "-m", *arguments]
        if heartbeat:
            self._beats, beat = os.pipe()
            os.set_blocking(self._beats, False)
            command += ["--heartbeat-fd", str(beat)]
        inherited = {key: value for key, value in os.environ.items() if key not in SECRET_VARIABLES}
        try:
            with self.log.open("ab") as stderr:
                # Its own process group: Ctrl-C reaches us only, and we stop the children in order.  Not a
                # new session: Linux first divides CPU time between sessions (sched_autogroup), and then a part
                # that mostly sleeps, such as Data Updates, waits 100 ms and more beside busy parts.
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE if waits else subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=stderr,
                    process_group=0,
                    pass_fds=(beat,) if heartbeat else (),
                    env=inherited | {_PARENT_VARIABLE: str(os.getpid())} | dict(environment or {}),
                )
        finally:
            if heartbeat:
                os.close(beat)
        if self._process.stdout is not None:
            os.set_blocking(self._process.stdout.fileno(), False)
        self._exit = os.pidfd_open(self.pid) if hasattr(os, "pidfd_open") else -1

    @property
    def pid(self) -> int:
        return self._process.pid

    def begin(self) -> None:
        """What was waiting goes on."""
        if self._process.stdin is not None:
            with suppress(OSError):  # it has ended: `ended` tells
                self._process.stdin.write(b"\n")
                self._process.stdin.close()
            self._process.stdin = None

    def ready(self) -> Mapping[str, Any] | None:
        """The JSON object of its ready line; None before.  Raises PipelineError for a line that is none."""
        while self._said is None and self._process.stdout is not None:
            try:
                read = os.read(self._process.stdout.fileno(), 65_536)
            except BlockingIOError:
                break
            if not read:
                self._close_output()
            self._line += read
            if b"\n" in read or len(self._line) > _LONGEST_LINE:
                self._said = self._parsed()
        return self._said

    def _close_output(self) -> None:
        if self._process.stdout is not None:
            self._process.stdout.close()
            self._process.stdout = None

    def _parsed(self) -> dict[str, Any]:
        try:
            said = json.loads(self._line.partition(b"\n")[0])
        except (ValueError, RecursionError):
            said = None
        if not isinstance(said, dict):
            raise PipelineError(f"{self.name} did not print its ready line first{self._log_tail()}")
        return said

    def wait_ready(self, seconds: float = START_SECONDS) -> Mapping[str, Any]:
        """The JSON object of the ready line; raises PipelineError with the log's end otherwise."""
        deadline = time.monotonic() + seconds
        while (said := self.ready()) is None:
            self.check()
            left = deadline - time.monotonic()
            if left <= 0:
                raise PipelineError(f"{self.name} was not ready within {seconds:.0f} s{self._log_tail()}")
            select.select(self.files(), [], [], min(left, 1.0))
        return said

    def files(self) -> Sequence[int]:
        """Descriptors that signal its end, and its ready line until it has come."""
        files = [self._exit] if self._exit >= 0 else []
        if self._said is None and self._process.stdout is not None:
            files.append(self._process.stdout.fileno())
        return files

    def beaten(self) -> bool:
        """Whether a heartbeat has come since the last call."""
        if self._beats < 0:
            return False
        with suppress(BlockingIOError):
            beats = os.read(self._beats, 65_536)
            for told in _COUNT.findall(beats):
                self.out_of_range = int(told)
            return bool(beats)
        return False

    def suspended(self) -> bool:
        """Whether a signal such as SIGSTOP keeps it from running."""
        return suspended(self.pid)

    def check(self) -> None:
        """Raise PipelineError if the program has ended."""
        ended = self.ended()
        if ended is not None:
            raise PipelineError(ended)

    def ended(self) -> str | None:
        """How it ended, with the end of its log; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        return f"{self.name} {how_ended(code)}{self._log_tail()}"

    def _log_tail(self) -> str:
        return last_words(self.log)

    def ask_to_end(self) -> None:
        """Send SIGTERM, and SIGCONT so that a stopped process can end."""
        if self._process.poll() is None:
            self._process.terminate()
            self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """SIGKILL."""
        self._process.kill()

    def stop(self) -> None:
        """Ask it to end, then kill it if necessary."""
        self.ask_to_end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(STOP_SECONDS)
        self.close()

    def close(self) -> None:
        """Kill it if it still runs, reap it, close what is open."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._close_output()
        if self._process.stdin is not None:
            self._process.stdin.close()
        for name in ("_beats", "_exit"):
            if getattr(self, name) >= 0:
                os.close(getattr(self, name))
                setattr(self, name, -1)


def how_ended(code: int) -> str:
    """An exit code, negative for a signal, as the predicate of a sentence."""
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:  # most real-time signals have no name
        return f"was killed by signal {-code}"


def last_words(log: Path) -> str:
    """The end of a log, as the second half of a message."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 8192))
            last = file.read().decode("utf-8", "replace").splitlines()[-_LAST_LINES:]
    except OSError:
        return ""
    return "; its last log lines:\n  " + "\n  ".join(last) if last else " with an empty log"
