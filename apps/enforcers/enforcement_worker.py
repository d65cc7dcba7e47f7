"""Carries decisions out with one enforcer, reads back, confirms, reports.  I/O: one worker thread, a bounded queue.

Callbacks of DUE only put into the queue; whatever the enforcer does, and however long it takes, no decision of
anybody else waits for it.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from apps.enforcement import EnforcementReport, HeldBlock
from apps.enforcers.desired_blocks import AllowedSenders, DesiredBlock, DesiredBlocks, desired_block_of
from apps.enforcers.enforcer import Enforcer, EnforcerAway, HeldCount
from apps.messages import Confirmation, Decision, State, one_line

_FIRST_PAUSE_S: Final = 0.2
_LONGEST_PAUSE_S: Final = 30.0
_REPORT_EVERY_S: Final = 10.0
_TOGETHER: Final = 1_000
"""Decisions that are carried out at once, at most."""
_CLOSE_S: Final = 10.0
_MOST_LIFTED: Final = 100_000
_NO_HISTORY: Final = "Data Archives have not answered since the start: what was in force before is left alone, and not read back"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Spoken:
    """A decision, and the wall time (ns) at which it was written."""

    decision: Decision
    written: int
    restored: bool = False
    """From the archive, at a start: it may stand already."""


Job = Spoken | tuple[str, ...] | None
"""A decision, the allow-list, or None: look around."""


@dataclass
class _Outlook:
    """When to try, to read back and to report again: monotonic seconds."""

    try_at: float = 0.0
    pause: float = _FIRST_PAUSE_S
    check_at: float = 0.0
    report_at: float = 0.0
    problem: str = ""
    """Why nothing can be done now."""
    found: str = ""
    """What the last reading found and put right."""
    told: object = None
    since: dict[str, float] = field(default_factory=dict)
    """Since when a decision waits."""


class EnforcementWorker:
    """Between the messages and one enforcer.

    Args:
        enforcer: adds, removes, lists back.
        names: the app's id and its place, for confirmations and reports.
        confirm: called with every confirmation, from the worker thread.
        report: called with every report, from the worker thread.
        check_s: seconds between two readings.
        patience_s: seconds after which a decision that cannot be carried out is answered as failed.
        size: most decisions that may wait.
        limit: most blocks that may stand.
    """

    def __init__(
        self,
        enforcer: Enforcer,
        names: tuple[str, str],
        confirm: Callable[[Confirmation], None],
        report: Callable[[EnforcementReport], None],
        *,
        check_s: float,
        patience_s: float,
        size: int = 10_000,
        limit: int = 65_536,
    ) -> None:
        self._enforcer = enforcer
        self._app, self._place = names
        self._confirm = confirm
        self._tell = report
        self._check_s = check_s
        self._patience_s = patience_s
        self._limit = limit
        self._jobs: queue.Queue[Job] = queue.Queue(size)
        self._desired = DesiredBlocks()
        self._allowed = AllowedSenders()
        self._held: Mapping[str, HeldCount] = {}
        self._outlook = _Outlook()
        self._closing = threading.Event()
        self._allow_again = False
        self._archived: tuple[tuple[str, ...], tuple[Spoken, ...]] | None = None
        """History that has come and is not taken up yet."""
        self._history_known = False
        self._allow_heard = False
        self._lifted: dict[str, None] = {}
        """Ids lifted before history came; the archive may not have these lifts yet."""
        self._counts = dict.fromkeys(
            ("installed", "removed", "expired", "failed", "restored", "refused_full", "tries_failed"), 0
        )
        self._thread = threading.Thread(target=self._work, name=f"enforcer {self._app}", daemon=True)

    def restore(self, allowed: tuple[str, ...], spoken: Iterable[Spoken]) -> None:
        """Take up the archive's allow-list and its last decision of each id, however many.

        Until then what already stands is left alone, except for what is lifted.
        """
        self._archived = allowed, tuple(spoken)
        self.put(None)

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    def put(self, job: Job) -> bool:
        """Queue a decision or an allow-list; never waits.  What does not fit is counted and answered as failed.

        Returns:
            Whether it fitted.
        """
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            if isinstance(job, Spoken):
                self._counts["refused_full"] += 1
                self._answer(job.decision, "failed", f"{self._jobs.maxsize:,} decisions are already waiting")
            return False
        return True

    def knows(self, decision_id: str) -> bool:
        """Whether a block of this id stands or shall stand, and is not being removed; may be a moment old."""
        desired = self._desired
        return decision_id not in desired.removing and (
            decision_id in desired.standing or decision_id in desired.adding
        )

    def check(self) -> None:
        """Raises `RuntimeError` if the worker thread has ended with an error."""
        if not self._thread.is_alive() and not self._closing.is_set():
            raise RuntimeError(f"the thread of {self._app} has ended with an error; the log has the reason")

    def close(self) -> None:
        """Carry out what waits, within ten seconds, and end."""
        self._closing.set()
        self.put(None)
        if self._thread.ident is not None:
            self._thread.join(_CLOSE_S)

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return {
            "blocks": len(self._held),
            "waiting": self._jobs.qsize() + len(self._desired.adding) + len(self._desired.removing),
            "working": not self._problem,
            "problem": self._problem,
            **self._counts,
        }

    # -- the worker ---------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._closing.is_set():
            self._take_up_history()
            self._take(self._wait_s())
            self._step()
        self._take(0.0)
        self._step(last=True)
        try:
            self._enforcer.end(list(self._desired.standing.values()))
        except EnforcerAway as error:
            log.warning("the enforcer did not end cleanly: %s", one_line(str(error)))

    def _wait_s(self) -> float:
        """Seconds until there is something to do by time alone."""
        now, outlook = time.monotonic(), self._outlook
        moments = [outlook.report_at]
        if self._history_known:
            moments.append(outlook.check_at)
        if self._waits():
            moments.append(outlook.try_at)
        if (end := self._desired.next_end()) and not self._desired.removing:
            moments.append(now + (end - time.time_ns()) / 1e9)
        return max(0.0, min(moments) - now)

    def _waits(self) -> bool:
        return bool(self._desired.adding or self._desired.removing or self._allow_again)

    def _take(self, wait_s: float) -> None:
        """Everything that has come, after waiting for the first of it."""
        try:
            job = self._jobs.get(timeout=wait_s) if wait_s > 0 else self._jobs.get_nowait()
            for _ in range(_TOGETHER):
                self._hear(job)
                job = self._jobs.get_nowait()
            self._hear(job)
        except queue.Empty:
            pass

    def _take_up_history(self) -> None:
        archived, self._archived = self._archived, None
        if archived is None:
            return
        self._history_known = True
        allowed, decisions = archived
        self._allow(self._allowed.entries if self._allow_heard else allowed)
        for each in decisions:
            name = each.decision.id
            if each.decision.action != "block":
                self._desired.remove(name)
            elif name not in self._lifted and not self.knows(name):  # what was heard is newer
                self._decide(each)
        self._lifted.clear()

    def _hear(self, job: Job) -> None:
        if isinstance(job, tuple):
            self._allow_heard = True
            self._allow(job)
        elif job is not None and not job.decision.dry_run:
            self._decide(job)

    def _allow(self, entries: tuple[str, ...]) -> None:
        self._allowed.replace(entries)
        self._allow_again = self._history_known
        for desired_block in [*self._desired.standing.values(), *self._desired.adding.values()]:
            if self._allowed.cover(desired_block.target):
                self._desired.remove(desired_block.id)

    def _decide(self, spoken: Spoken) -> None:
        decision = spoken.decision
        if decision.action == "unblock":
            self._lift(decision)
            return
        if decision.action != "block":
            return
        desired_block = desired_block_of(decision, min(spoken.written, time.time_ns()))
        if self._allowed.cover(desired_block.target):
            self._answer(decision, "failed", "it is on the allow-list")
        elif not desired_block.lasts(time.time_ns()):
            if not spoken.restored:
                self._answer(decision, "failed", "it had expired when it arrived")
        elif len(self._desired) >= self._limit and decision.id not in self._desired.standing:
            self._answer(decision, "failed", f"{self._limit:,} blocks are already in force")
        elif self._desired.add(desired_block):
            self._outlook.since.setdefault(desired_block.id, time.monotonic())
        else:
            self._answer(decision, "exists")

    def _lift(self, decision: Decision) -> None:
        found = self._desired.remove(decision.id)
        if self._history_known:
            if not found:
                self._answer(decision, "removed", "it was not in force here")
            return
        if len(self._lifted) >= _MOST_LIFTED:
            self._lifted.pop(next(iter(self._lifted)))
        self._lifted[decision.id] = None
        if not found and len(self._desired.removing) < self._limit:
            # it may stand since before the start
            self._desired.removing[decision.id] = DesiredBlock(decision, 0)

    def _step(self, *, last: bool = False) -> None:
        now, outlook = time.monotonic(), self._outlook
        for name in self._desired.ended(time.time_ns()):
            self._desired.remove(name)
        try:
            if self._waits() and (last or now >= outlook.try_at):
                self._carry_out()
            if self._history_known and not last and now >= outlook.check_at:
                self._read_back()
        except EnforcerAway as error:
            self._away(str(error))
        self._report()

    def _carry_out(self) -> None:
        if self._allow_again:
            self._enforcer.allow(self._allowed.entries)
        adding, removing = dict(self._desired.adding), dict(self._desired.removing)
        refused = self._enforcer.change(list(adding.values()), list(removing.values()))
        self._allow_again = False
        stood = set(self._desired.standing)
        self._desired.carried_out(refused)
        self._held = {name: self._held.get(name, HeldCount()) for name in self._desired.standing}
        self._answer_all(adding, removing, refused, stood)
        self._works()

    def _works(self) -> None:
        if self._outlook.problem:
            log.info("the enforcer works again")
            self._outlook.problem = ""
        self._outlook.pause, self._outlook.try_at = _FIRST_PAUSE_S, 0.0

    def _answer_all(
        self,
        adding: Mapping[str, DesiredBlock],
        removing: Mapping[str, DesiredBlock],
        refused: Mapping[str, str],
        stood: set[str],
    ) -> None:
        now = time.time_ns()
        for name, desired_block in removing.items():
            if name not in adding:
                self._answer(desired_block.decision, "removed" if desired_block.lasts(now) else "expired")
        for name, desired_block in adding.items():
            self._outlook.since.pop(name, None)
            state: State = "failed" if name in refused else "exists" if name in stood else "installed"
            self._answer(desired_block.decision, state, refused.get(name, ""))

    def _read_back(self) -> None:
        self._outlook.check_at = time.monotonic() + self._check_s
        wanted = {
            name: desired_block
            for name, desired_block in self._desired.standing.items()
            if name not in self._desired.removing
        }
        held = self._enforcer.held(list(wanted.values()))
        now = time.time_ns()
        missing = [
            desired_block
            for name, desired_block in wanted.items()
            if name not in held and desired_block.lasts(now)
        ]
        said = ""
        if missing:
            self._enforcer.change(missing, ())
            self._counts["restored"] += len(missing)
            said = f"restored {len(missing)} of {len(wanted)} blocks that somebody else had removed"
            log.error("%s", said)
            held = {**held, **{desired_block.id: HeldCount() for desired_block in missing}}
        self._outlook.found = said
        self._held = held
        self._works()

    def _away(self, cause: str) -> None:
        now, outlook = time.monotonic(), self._outlook
        self._counts["tries_failed"] += 1
        if outlook.problem != cause:
            outlook.problem = cause
            log.error("%s", one_line(cause))
        outlook.try_at = now + outlook.pause
        outlook.check_at = max(outlook.check_at, outlook.try_at)
        outlook.pause = min(2 * outlook.pause, _LONGEST_PAUSE_S)
        for name, since in list(outlook.since.items()):
            if now - since >= self._patience_s:
                del outlook.since[name]
                desired_block = self._desired.adding.pop(name, None)
                if desired_block is not None:
                    self._desired.standing.pop(name, None)
                    self._answer(desired_block.decision, "failed", cause)

    def _answer(self, decision: Decision, state: State, cause: str = "") -> None:
        if state in self._counts:
            self._counts[state] += 1
        self._confirm(
            Confirmation(
                id=decision.id,
                switch=self._place,
                state=state,
                action=decision.action,
                target=decision.target,
                handle=place_handle(self._app, decision),
                cause=cause,
                event_time=decision.event_time,
            )
        )

    @property
    def _problem(self) -> str:
        return self._outlook.problem or ("" if self._history_known else _NO_HISTORY)

    def _report(self) -> None:
        now, outlook = time.monotonic(), self._outlook
        standing = self._desired.standing
        held = [(standing[name], count) for name, count in self._held.items() if name in standing]
        waiting = len(self._desired.adding) + len(self._desired.removing)
        problem = self._problem or outlook.found
        what = (problem, tuple((desired_block.id, count) for desired_block, count in held), waiting)
        if what == outlook.told and now < outlook.report_at:
            return
        outlook.told, outlook.report_at = what, now + _REPORT_EVERY_S
        blocks = tuple(_held_block(desired_block, count) for desired_block, count in held)
        self._tell(
            EnforcementReport(
                enforcer=self._app,
                place=self._place,
                working=not self._problem,
                problem=problem,
                blocks=blocks,
                waiting=waiting,
                restored=self._counts["restored"],
                event_time=time.time_ns(),
            )
        )


def place_handle(app: str, decision: Decision) -> str:
    """The block as the enforcer knows it."""
    return f"{app} {decision.target.kind} {decision.target.address}"


def _held_block(desired_block: DesiredBlock, count: HeldCount) -> HeldBlock:
    return HeldBlock(
        id=desired_block.id, target=desired_block.target, packets=count.packets, bytes=count.bytes
    )
