"""An enforcer as a DUE app: history, decisions and the allow-list in; confirmations and reports out.  I/O."""

import logging
import re
import socket
import time
from collections import deque
from typing import Any, Final

import due
from apps.enforcement import ALLOWED, CONFIRMED, ENFORCED, EnforcementReport
from apps.enforcers.arrivals import DECISIONS, allowed_in, decision_in, last_of_each
from apps.enforcers.enforcement_worker import EnforcementWorker, Spoken
from apps.enforcers.enforcer import Enforcer
from apps.messages import LONGEST_BLOCK_S, Confirmation, Decision, Intake, one_line, read_latest
from due import Capability, DueError, Engine, Interest, Item

ENFORCER_WANTS: Final = (*(Interest(key) for key in DECISIONS), Interest(ALLOWED))
"""What every enforcer wants."""

_RESTORED: Final = 100_000
_LONGEST_NS: Final = (LONGEST_BLOCK_S + 86_400) * 1_000_000_000
_LOOK_EVERY_S: Final = 2.0
_CLOCKS_DIFFER_NS: Final = 60 * 1_000_000_000
_LIFTED_READ: Final = 1_000
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
        self._looked_at = time.monotonic()
        self._lifted_since = time.time_ns()
        self._archive_away = 0
        self._active = False
        self._early: deque[Spoken] = deque(maxlen=_EARLY)
        """What came while this instance was not active; the archive may not have the newest of it yet."""

    def start(self) -> None:
        """Subscribe, and restore from Data Archives what is in force; a standby does so when it becomes active."""
        while self._engine.health()["phase"] == "waiting":
            time.sleep(0.01)
        for key in DECISIONS:
            self._engine.observe(key).subscribe(
                self._intake.reading("decision", decision_in, self._on_decision)
            )
        self._engine.observe(ALLOWED).subscribe(
            self._intake.reading("allowed", allowed_in, lambda _, entries: self._desk.put(entries))
        )
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
        self._restore()
        for spoken in self._early:
            self._desk.put(spoken)
        self._early.clear()
        self._desk.start()

    def _restore(self) -> None:
        began = time.time_ns()
        for entries in self._read(ALLOWED, 0, 1):
            allowed = self._intake.read("allowed", allowed_in, entries)
            self._desk.restore_allowed(allowed or ())
        items = [item for key in DECISIONS for item in self._read(key, began - _LONGEST_NS, _RESTORED)]
        standing = [each for each in last_of_each(items, self._intake) if each[0].action == "block"]
        self._desk.restore(Spoken(decision, written, restored=True) for decision, written in standing)
        log.info("%s %s: %d blocks in the archive", self._app, self._place, len(standing))

    def tick(self) -> None:
        """Look for what was lifted while nobody could tell us, such as `blocks panic` without a firewall."""
        self._stand()
        if not self._active:
            return
        self._desk.check()
        if time.monotonic() - self._looked_at < _LOOK_EVERY_S:
            return
        self._looked_at, since = time.monotonic(), self._lifted_since - _CLOCKS_DIFFER_NS
        self._lifted_since = time.time_ns()
        for key in DECISIONS:
            query = {"dataKey": key, "value.action": "unblock"}
            for decision, written in last_of_each(self._read(query, since, _LIFTED_READ), self._intake):
                if self._desk.knows(decision.id):
                    self._desk.put(Spoken(decision, written))

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

    def _read(self, query: str | dict[str, Any], since: int, most: int) -> list[Item]:
        try:
            return read_latest(
                self._engine, {"dataKey": query} if isinstance(query, str) else query, since, most
            )
        except DueError as error:
            self._archive_away += 1
            log.warning("Data Archives do not answer: %s", one_line(str(error)))
            return []

    def _confirm(self, confirmation: Confirmation) -> None:
        key = f"{CONFIRMED}.{self._app}.{self._place}"
        at = confirmation.event_time or None
        self._engine.write(key, confirmation.to_value(), [due.NO_WAIT], event_time=at)

    def _report(self, report: EnforcementReport) -> None:
        self._engine.write(f"{ENFORCED}.{self._app}.{self._place}", report.to_value(), [due.NO_WAIT])
