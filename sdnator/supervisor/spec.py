"""Specification of a pipeline: parts, their needs, and their restarts.  Pure."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

START_SECONDS: float = 180.0
"""Seconds for a start: on a busy machine one took over half a minute."""


class PartProcess(Protocol):
    """A started process as the supervisor sees it; no method waits but `stop`."""

    log: Path
    """Its log, which takes standard error."""
    out_of_range: int
    """Accesses beyond the end of an array by a switch's program, as its heartbeats tell."""

    @property
    def pid(self) -> int:
        """Its process id."""
        ...

    def ready(self) -> Mapping[str, Any] | None:
        """Its ready line; None before."""
        ...

    def ended(self) -> str | None:
        """How it ended, with the end of its log; None while it runs."""
        ...

    def beaten(self) -> bool:
        """Whether a heartbeat has come since the last call."""
        ...

    def suspended(self) -> bool:
        """Whether a signal such as SIGSTOP keeps it from running."""
        ...

    def files(self) -> Sequence[int]:
        """Descriptors that become readable when it is ready or has ended."""
        ...

    def ask_to_end(self) -> None:
        """SIGTERM, also to a stopped one."""
        ...

    def kill(self) -> None:
        """SIGKILL: SIGTERM does not reach one that hangs."""
        ...

    def close(self) -> None:
        """Kill it if it still runs, reap it, and close its descriptors."""
        ...


class Reserve(Protocol):
    """Makes the next start of a part quick; no method waits."""

    def prepare(self) -> None:
        """Called about every second while the part runs."""
        ...

    def discard(self) -> None:
        """The next start is to use nothing that was prepared."""
        ...


@dataclass(frozen=True, kw_only=True)
class RestartPolicy:
    """A part that died is restarted after a pause that doubles with each death, without limit."""

    first_s: float = 0.5
    longest_s: float = 30.0
    at_once: bool = False
    """No pause after the first death: for the switch, which forwards nothing while it is down."""
    quick_s: float = 5.0
    """Nor, with `at_once`, after a death that comes later than this many seconds after it was ready."""
    well_s: float = 60.0
    """Seconds of running after which earlier deaths no longer count."""
    degraded_deaths: int = 3
    """Number of deaths from which the part is degraded, even while it runs."""

    def pause_s(self, deaths: int, ran_s: float = 0.0) -> float:
        """Seconds to wait after the death with this number, the first being 1, of a part that ran for `ran_s`."""
        doubled = deaths - 1
        if self.at_once:
            if deaths == 1 or ran_s >= self.quick_s:
                return 0.0
            doubled -= 1
        # the exponent is bounded, for a part may die for years
        return min(self.longest_s, self.first_s * 2.0 ** min(doubled, 32))


@dataclass(frozen=True, kw_only=True)
class LogLimits:
    """How much of a part's log is kept."""

    file_bytes: int = 16 << 20
    """Size at which a log is rotated, bytes."""
    files: int = 3
    """Logs kept for each part, including the one being written."""
    minute_bytes: int = 4 << 20
    """Bytes that a part may log in a minute; further lines are suppressed, and counted in the log."""


@dataclass(frozen=True, kw_only=True)
class PartSpec:
    """One part of a pipeline.

    Args:
        name: for messages, the log's name and `status`.
        start: starts the process and returns at once; called at every start, so that it may use what other
            parts said when they were ready.  Stop signals are deferred meanwhile.
        after: parts that must be ready before its first start.
        needs: parts that must be ready before every start.
        follows: parts whose restart means its own.
        restart: None: its death is an error of the whole pipeline (`PipelineError`).
        vital: if it fails to start, the whole start fails.
        silence_s: seconds without a heartbeat after which it counts as hung; 0: it has none.
        suspended_s: seconds for which it may be suspended; 0: as long as it may be silent.
        inside: entered around its start and what prepares it, such as a network namespace.
        reserve: prepares its next start while it runs.
    """

    name: str
    start: Callable[[], PartProcess]
    after: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    follows: tuple[str, ...] = ()
    restart: RestartPolicy | None = field(default_factory=RestartPolicy)
    vital: bool = True
    silence_s: float = 0.0
    suspended_s: float = 0.0
    inside: Callable[[], AbstractContextManager[object]] = nullcontext
    reserve: Reserve | None = None
