"""An enforcer as a DUE app: history, decisions and the allow-list in; confirmations and reports out.  I/O."""

import logging
import re
import socket
import time
from collections import deque
from typing import Any, Final

import due
from apps.archive_question import ArchiveQuestion
from apps.enforcement import ALLOWED, CONFIRMED, ENFORCED, EnforcementReport
from apps.enforcers.arrivals import DECISIONS, allowed_in, decision_in, last_of_each
from apps.enforcers.enforcement_worker import EnforcementWorker, Spoken
from apps.enforcers.enforcer import Enforcer
from apps.messages import LONGEST_BLOCK_S, Confirmation, Decision, Intake, one_line
from due import Capability, Engine, Interest, Item

ENFORCER_WANTS: Final = (*(Interest(key) for key in DECISIONS), Interest(ALLOWED))
"""What every enforcer wants."""

_RESTORED: Final = 100_000
_LONGEST_NS: Final = (LONGEST_BLOCK_S + 86_400) * 1_000_000_000
_LOOK_EVERY_S: Final = 2.0
_LONGEST_PAUSE_S: Final = 10.0
_START_S: Final = 2.0
"""How long a start waits for the archive before it goes on without history, in seconds."""
_LATE_NS: Final = 60 * 1_000_000_000
"""How far before the last answered look for lifts the next one goes back, ns."""
_CLOCKS_DIFFER_NS: Final = 2 * 3600 * 1_000_000_000
"""The same, for the first look and every `_FAR_LOOK`th: the clock of a lift's writer may be that far behind, ns."""
_FAR_LOOK: Final = 30
_EARLY: Final = 1_000

log = logging.getLogger(__name__)


def enforcer_makes(app: str) -> tuple[Capability, ...]:
    """What the enforcer with this app id can make."""
    return (
        Capability(f"{CONFIRMED}.{app}.*", delivery="reliable", archive="always"),
        Capability(f"{ENFORCED}.{app}.*", archive="always"),
    )


def place_name(given: str) -> str:
    """The place as a segment of keys; this host's name if none is given."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", given or socket.gethostname()) or "host"


class EnforcerApp:
    """Between DUE and an `EnforcementWorker`.

    Args:
        engine: initialised.
        app: the app's id.
        place: where it enforces, a segment of keys.
        enforcer: what does it.
        options: further arguments of `EnforcementWorker`.
    """

    def __init__(self, engine: Engine, app: str, place: str, enforcer: Enforcer, **options: Any) -> None:
        self._engine = engine
        self._app = app
        self._place = place
        self._intake = Intake(log)
        self._desk = EnforcementWorker(enforcer, (app, place), self._confirm, self._report, **options)
        self._question: ArchiveQuestion | None = None
        self._ask_at = 0.0
        self._pause = _LOOK_EVERY_S
        self._restored = False
        self._lifted_since = 0
        """Wall time of the last question that was answered, ns."""
        self._looks = 0
        self._told: set[str] = set()
        """Lifts that the last look has queued; each look finds them again."""
        self._archive_away = 0
        self._active = False
        self._early: deque[Spoken] = deque(maxlen=_EARLY)
        """What came while this instance was not active; the archive may not have the newest of it yet."""

    def start(self) -> None:
        """Subscribe, and restore from Data Archives what is in force; a standby does so when it becomes active.

        If the archive does not answer, it is asked again, and until then what stands is left as it is.
        """
        while self._engine.health()["phase"] == "waiting":
            time.sleep(0.01)
        for key in DECISIONS:
            self._engine.observe(key).subscribe(
                self._intake.reading("decision", decision_in, self._on_decision)
            )
        self._engine.observe(ALLOWED).subscribe(self._intake.reading("allowed", allowed_in, self._on_allowed))
        self._stand()

    def _stand(self) -> None:
        """Two instances must not write into one place: a standby leaves it alone."""
        health = self._engine.health()
        if health["asking"] or health["active"] == self._active:
            return
        if self._active:
            raise RuntimeError(
                "another instance is active now: this one ends, to be started again as a standby"
            )
        self._active = True
        self._ask().join(_START_S)
        self._hear_archive()
        for spoken in self._early:
            self._desk.put(spoken)
        self._early.clear()
        self._desk.start()

    def tick(self) -> None:
        """Look for what was lifted while nobody could tell us, such as `blocks panic` without a firewall."""
        self._stand()
        if not self._active:
            return
        self._desk.check()
        if self._question is not None:
            self._hear_archive()
        elif time.monotonic() >= self._ask_at:
            self._ask()

    def _ask(self) -> ArchiveQuestion:
        now = time.time_ns()
        if self._restored:
            back = _LATE_NS if self._looks % _FAR_LOOK else _CLOCKS_DIFFER_NS
            since = min(self._lifted_since, now) - back  # this machine's clock may have been set back
            queries = [({"dataKey": key, "value.action": "unblock"}, since, _RESTORED) for key in DECISIONS]
        else:
            queries = [({"dataKey": key}, now - _LONGEST_NS, _RESTORED) for key in DECISIONS]
            queries.append(({"dataKey": ALLOWED}, 0, 1))
        self._question = ArchiveQuestion(self._engine, now, queries)
        return self._question

    def _hear_archive(self) -> None:
        question = self._question
        if question is None or question.is_alive():
            return
        self._question = None
        if question.found is None:
            self._archive_away += 1
            log.warning("Data Archives do not answer: %s", one_line(question.problem))
            self._ask_at = time.monotonic() + self._pause
            self._pause = min(2 * self._pause, _LONGEST_PAUSE_S)
            return
        self._pause, self._ask_at = _LOOK_EVERY_S, time.monotonic() + _LOOK_EVERY_S
        self._lifted_since = question.asked_at
        if self._restored:
            self._looks += 1
            self._lift([item for items in question.found for item in items])
        else:
            self._restored = True
            self._restore(*question.found)

    def _restore(self, *found: list[Item]) -> None:
        *decided, listed = found
        latest = last_of_each((item for items in decided for item in items), self._intake)
        allowed = [self._intake.read("allowed", allowed_in, item) or () for item in listed]
        self._desk.restore(
            allowed[-1] if allowed else (),
            [Spoken(decision, written, restored=True) for decision, written in latest],
        )
        blocks = sum(decision.action == "block" for decision, _ in latest)
        log.info("%s %s: %d blocks in the archive", self._app, self._place, blocks)

    def _lift(self, items: list[Item]) -> None:
        told, self._told = self._told, set()
        for decision, written in last_of_each(items, self._intake):
            if self._desk.knows(decision.id) and (
                decision.id in told or self._desk.put(Spoken(decision, written))
            ):
                self._told.add(decision.id)

    def stop(self) -> None:
        """Carry out what waits."""
        self._desk.close()

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return {
            "place": self._place,
            "enforcing": self._active,
            **self._desk.health(),
            "archive_unanswered": self._archive_away,
            **self._intake.health(),
        }

    def _on_decision(self, _: Item, spoken: tuple[Decision, int]) -> None:
        if self._active:
            self._desk.put(Spoken(*spoken))
        else:
            self._early.append(Spoken(*spoken, restored=True))

    def _on_allowed(self, _: Item, entries: tuple[str, ...]) -> None:
        self._desk.put(entries)

    def _confirm(self, confirmation: Confirmation) -> None:
        key = f"{CONFIRMED}.{self._app}.{self._place}"
        at = confirmation.event_time or None
        self._engine.write(key, confirmation.to_value(), [due.NO_WAIT], event_time=at)

    def _report(self, report: EnforcementReport) -> None:
        self._engine.write(f"{ENFORCED}.{self._app}.{self._place}", report.to_value(), [due.NO_WAIT])
