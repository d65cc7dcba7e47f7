"""Starts parts in the order of their needs, restarts those that die or hang, and stops all in order."""

import select
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

from sdnator.supervisor.log_rotation import LogKeeper
from sdnator.supervisor.part import Part, PartReport
from sdnator.supervisor.spec import LogLimits, PartSpec

_LOOK_SECONDS = 0.02
_LOGS_SECONDS = 1.0


class Supervisor:
    """The processes of a pipeline; a context manager that stops what it started, the last first.

    Args:
        parts: in an order in which no part stands before what it needs; `add` adds more.
        tell: gets a line for the console when a part dies, hangs, or runs again.
        logs: how much of each part's log is kept.

    Nothing blocks but `start` and `stop`: the slow start of one part delays no other.
    """

    def __init__(
        self, parts: tuple[PartSpec, ...], tell: Callable[[str], None], logs: LogLimits | None = None
    ) -> None:
        self._tell = tell
        self._parts: dict[str, Part] = {}
        self._keeper = LogKeeper(logs or LogLimits())
        self._kept = float("-inf")
        for part in parts:
            self.add(part)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def add(self, part: PartSpec) -> None:
        """One more part; it runs after `start`.  Raises ValueError for a name that is taken or unknown."""
        unknown = [name for name in (*part.after, *part.needs, *part.follows) if name not in self._parts]
        if part.name in self._parts or unknown:
            raise ValueError(
                f"part {part.name}: there are {list(self._parts)}, it needs {unknown or 'another name'}"
            )
        self._parts[part.name] = Part(part, self._tell)

    def start(self, *names: str) -> None:
        """Start these parts, or all, and return when they are ready.

        Raises:
            PipelineError: a vital part failed; the text has the end of its log.
        """
        wanted = [self._parts[name] for name in names or self._parts]
        while not all(part.was_ready or part.failed for part in wanted):
            self._step(wanted)
            self.wait(_LOOK_SECONDS)

    def watch(self) -> bool:
        """Check all parts once, and restart those that have died; True if anything has changed.

        Raises:
            PipelineError: a part without restart has died.
        """
        begun = [part for part in self._parts.values() if part.was_ready or part.deaths]
        return self._step(begun)

    def _step(self, wanted: list[Part]) -> bool:
        now = time.monotonic()
        changed = False
        for name, part in self._parts.items():
            if part.step(now):
                changed = True
                if part.state == "running" and part.restarts:
                    self._renew_followers(name, now)
        for part in wanted:
            if part.may_start(now) and self._has_what_it_needs(part):
                part.start(now)
                changed = True
        self._keep_logs(now)
        return changed

    def _renew_followers(self, name: str, now: float) -> None:
        for part in self._parts.values():
            if name in part.spec.follows:
                part.renew(now)

    def _has_what_it_needs(self, part: Part) -> bool:
        before = () if part.was_ready or part.deaths else part.spec.after
        return all(self._parts[name].state == "running" for name in part.spec.needs) and all(
            self._parts[name].was_ready or self._parts[name].failed for name in before
        )

    def _keep_logs(self, now: float) -> None:
        if now - self._kept < _LOGS_SECONDS:
            return
        self._kept = now
        for part in self._parts.values():
            if part.log is not None:
                self._keeper.look(part.log, now)

    def wait(self, seconds: float) -> None:
        """Return after a time limit, or as soon as a part has become ready or has ended."""
        files = [file for part in self._parts.values() if part.process for file in part.process.files()]
        poll = select.poll()
        for file in files:
            poll.register(file, select.POLLIN)
        poll.poll(seconds * 1_000)

    def renew(self, name: str) -> None:
        """Stop and restart a part, without waiting for either."""
        self._parts[name].renew(time.monotonic())

    def said(self, name: str) -> Mapping[str, Any]:
        """The last ready line of a part; empty before."""
        return self._parts[name].said

    def pids(self) -> dict[str, int]:
        """Process ids by name; the last one if a part does not run."""
        return {name: pid for name, part in self._parts.items() if (pid := part.report().pid)}

    def reports(self) -> list[PartReport]:
        """State of every part."""
        return [part.report() for part in self._parts.values()]

    def logs(self) -> dict[str, tuple[int, int]]:
        """By part: bytes of its logs, and lines that were suppressed."""
        found = {}
        for name, part in self._parts.items():
            if part.log is not None:
                found[name] = (self._keeper.size(part.log), self._keeper.suppressed(part.log))
        return found

    def stop(self) -> None:
        """Stop all parts, the last first."""
        for part in reversed(list(self._parts.values())):
            part.stop()
