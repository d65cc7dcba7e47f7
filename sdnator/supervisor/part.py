"""One part and the states it goes through; nothing here waits.

    waiting ──start──► starting ──ready──► running ──renew──► ending ──► waiting
       ▲                   │                  │
       └──── pause ────────┴─── death, hang ──┘

A part that hangs is killed; `ending` lasts until the kernel has reaped it.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sdnator.errors import PipelineError, SdnatorError
from sdnator.p4_program import P4ProgramError
from sdnator.supervisor.deferred_signals import deferred_signals
from sdnator.supervisor.spec import START_SECONDS, PartProcess, PartSpec

State = Literal["waiting", "starting", "running", "ending"]
Shown = Literal["waiting", "starting", "running", "restarting", "degraded"]
_LONGEST_LOOK_S = 1.0
_END_SECONDS = 10.0
_PREPARE_AFTER_S = 3.0
"""For this long after a restart no spare is prepared, so that the part has the machine to itself."""
_PREPARE_EVERY_S = 1.0
_PREPARE_AGAIN_S = 60.0
_TOLD_DEATHS = 5
_TOLD_SECONDS = 300.0


class Silence:
    """How long a part has been silent while it was observed.

    If the observer itself was stopped, that time does not count as silence of the part.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._silent_s = 0.0
        self._looked: float | None = None

    def too_long(self, now: float, *, beaten: bool) -> bool:
        """Whether the limit is reached; `now` in seconds."""
        if self._looked is not None:
            self._silent_s += min(now - self._looked, _LONGEST_LOOK_S)
        self._looked = now
        if beaten:
            self._silent_s = 0.0
        return self._silent_s >= self._limit_s > 0


@dataclass(frozen=True, kw_only=True)
class PartReport:
    """State of a part, for `status` and metrics."""

    name: str
    pid: int
    """Process id; the last one if it does not run."""
    state: Shown
    restarts: int
    """Restarts in this run, for any reason."""
    cause: str
    """Cause of the last death; empty: none."""
    out_of_range: int = 0
    """Accesses beyond the end of an array by a switch's program, since it was started."""


class Part:
    """A part's process and history.  `tell` gets lines for the console."""

    def __init__(self, spec: PartSpec, tell: Callable[[str], None]) -> None:
        self.spec = spec
        self.state: State = "waiting"
        self.process: PartProcess | None = None
        self.said: Mapping[str, Any] = {}
        self.restarts = 0
        self.deaths = 0
        """Since it last ran well."""
        self.was_ready = False
        self.failed = ""
        """How its first start failed, for a part that is not vital."""
        self.log: Path | None = None
        self._fatal = ""
        self._tell = tell
        self._pid = 0
        self._cause = ""
        self._start_at = 0.0
        self._since = 0.0
        self._ran_s = 0.0
        self._prepare_at = 0.0
        self._silence = Silence(spec.silence_s)
        self._suspension = Silence(spec.suspended_s)
        self._reason = ""
        self._quiet_until = 0.0
        self._untold = 0

    def report(self) -> PartReport:
        """Its present state."""
        return PartReport(
            name=self.spec.name,
            pid=self._pid,
            state=self._shown(),
            restarts=self.restarts,
            cause=self._cause,
            out_of_range=self.process.out_of_range if self.process is not None else 0,
        )

    def _shown(self) -> Shown:
        policy = self.spec.restart
        if policy is not None and self.deaths >= policy.degraded_deaths:
            return "degraded"
        if self.state == "running":
            return "running"
        if self.was_ready or self.deaths:
            return "restarting"
        return "starting" if self.state == "starting" else "waiting"

    def may_start(self, now: float) -> bool:
        """Whether its pause is over."""
        return self.state == "waiting" and now >= self._start_at

    def start(self, now: float) -> None:
        """Start its process; raises PipelineError if that fails at the first start."""
        self._ran_s = 0.0
        try:
            with self.spec.inside(), deferred_signals():
                self.process = self.spec.start()
        except (SdnatorError, P4ProgramError, OSError) as error:
            self._died(f"{self.spec.name} could not be started: {error}", now)
            return
        self.state, self._since, self._pid = "starting", now, self.process.pid
        self.log = self.process.log

    def step(self, now: float) -> bool:
        """Check its process; True if its state has changed.  Raises PipelineError for a part without restart."""
        if self._fatal:
            raise PipelineError(self._fatal)
        if self.process is None:
            return False
        if self.state == "starting":
            return self._step_starting(self.process, now)
        if self.state == "running":
            return self._step_running(self.process, now)
        return self._step_ending(self.process, now)

    def _step_starting(self, process: PartProcess, now: float) -> bool:
        try:
            said = process.ready()
        except PipelineError as error:
            self._end(str(error), now)
            process.kill()
            return True
        if said is not None:
            self.state, self._since, self.said = "running", now, said
            self._prepare_at = now + _PREPARE_AFTER_S
            self._silence = Silence(self.spec.silence_s)
            self._suspension = Silence(self.spec.suspended_s)
            if self.deaths:
                self._say(f"{self.spec.name} is running again", now)
            self.was_ready = True
            return True
        if (ended := process.ended()) is not None:
            self._died(ended, now)
            return True
        if now - self._since > START_SECONDS:
            self._end(f"{self.spec.name} was not ready within {START_SECONDS:.0f} s", now)
            process.kill()
            return True
        return False

    def _step_running(self, process: PartProcess, now: float) -> bool:
        policy = self.spec.restart
        if (ended := process.ended()) is not None:
            self._died(ended, now)
            return True
        self._prepare(now)
        if self._silence.too_long(now, beaten=process.beaten()):
            self._end(
                f"{self.spec.name} hung: no heartbeat for {self.spec.silence_s:g} s, so it was killed", now
            )
            process.kill()
            return True
        if self.spec.suspended_s and self._suspension.too_long(now, beaten=not process.suspended()):
            self._end(
                f"{self.spec.name} was suspended for {self.spec.suspended_s:g} s (SIGSTOP?), so it was killed",
                now,
            )
            process.kill()
            return True
        if policy is not None and self.deaths and now - self._since > policy.well_s:
            degraded = self._shown() == "degraded"
            self.deaths = 0
            return degraded
        return False

    def _prepare(self, now: float) -> None:
        if self.spec.reserve is None or now < self._prepare_at:
            return
        self._prepare_at = now + _PREPARE_EVERY_S
        try:
            with self.spec.inside(), deferred_signals():
                self.spec.reserve.prepare()
        except (SdnatorError, OSError):  # its next start takes longer, that is all
            self._prepare_at = now + _PREPARE_AGAIN_S

    def _step_ending(self, process: PartProcess, now: float) -> bool:
        if process.ended() is None:
            if now - self._since > _END_SECONDS:
                process.kill()
            return False
        if self._reason:
            self._died(self._reason, now)
        else:
            self._close()
            self.restarts += 1
            self.state, self._start_at = "waiting", now
        return True

    def renew(self, now: float) -> None:
        """Stop and restart it, for instance with new settings."""
        self._discard()
        if self.process is not None and self.state in ("starting", "running"):
            self._end("", now)
            self.process.ask_to_end()

    def _discard(self) -> None:
        if self.spec.reserve is not None:
            self.spec.reserve.discard()

    def _end(self, reason: str, now: float) -> None:
        self._note_run(now)
        self.state, self._reason, self._since = "ending", reason, now

    def _note_run(self, now: float) -> None:
        if self.state == "running":
            self._ran_s = now - self._since

    def _close(self) -> None:
        if self.process is not None:
            self.process.close()
            self.process = None

    def _died(self, how: str, now: float) -> None:
        self._close()
        policy, first = self.spec.restart, not self.was_ready and not self.restarts
        self._note_run(now)
        self._cause, self._reason = first_line(how), ""
        if policy is None or (first and self.spec.vital):
            self.state, self._start_at, self._fatal = "waiting", float("inf"), how
            raise PipelineError(how)
        if first:
            self.failed = how
        self.deaths += 1
        self.restarts += 1
        pause = policy.pause_s(self.deaths, self._ran_s)
        self.state, self._start_at = "waiting", now + pause
        self._say(f"{self._cause}: restarting it {f'in {pause:g} s' if pause else 'at once'}", now)

    def _say(self, text: str, now: float) -> None:
        """Report each of the first deaths in full, then one in five minutes."""
        if self.deaths > _TOLD_DEATHS and now < self._quiet_until:
            self._untold += 1
            return
        more = f" ({self._untold} lines like this were left out)" if self._untold else ""
        self._untold, self._quiet_until = 0, now + _TOLD_SECONDS
        self._tell(text + more)

    def stop(self) -> None:
        """Stop it; it is not restarted."""
        self._discard()
        if self.process is not None:
            stop(self.process)
            self.process = None
        self.state, self._start_at = "waiting", float("inf")


def stop(process: PartProcess) -> None:
    """Ask a process to end, wait for it, and kill it if it does not end."""
    process.ask_to_end()
    deadline = time.monotonic() + _END_SECONDS
    while process.ended() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    process.close()


def first_line(text: str) -> str:
    """The cause, without log lines."""
    return text.partition("\n")[0].removesuffix("; its last log lines:")
