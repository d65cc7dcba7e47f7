"""The firewall's incidents as items of DUE and lines for SIEMs: the book's hands.

The service tells it what happens, in the order in which it happens; it publishes what the book returns.
"""

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Final

import due
from apps.evidence import Evidence
from apps.firewall.enforcement.announcer import Announcer
from apps.firewall.enforcement.eve import EveFormat, decision_event, incident_event, line_of
from apps.firewall.incidents.incident_book import IncidentBook
from apps.incidents import INCIDENT, Incident
from apps.messages import Alert, Confirmation, Decision
from due import Capability, Engine

INCIDENT_CAPABILITY: Final = Capability(f"{INCIDENT}.firewall.*", delivery="reliable", archive="always")
_MOST_ALONE: Final = 8_192
IMPORTANT: Final = ("decided", "over")
"""Changes of which the webhook hears too."""


class IncidentReports:
    """Tells the book what happens, and the world what the book says.

    Args:
        engine: where incidents are written.
        lines: takes their EVE lines.
        form: `eve`, or `ecs` for the field names of the Elastic Common Schema.
        book: the book, for tests; a new one if None.
    """

    def __init__(
        self, engine: Engine, lines: Announcer, form: EveFormat = "eve", book: IncidentBook | None = None
    ) -> None:
        self._engine = engine
        self._lines = lines
        self._form: EveFormat = form
        self._book = book or IncidentBook()
        self._written = 0
        self._alone: OrderedDict[str, tuple[Decision, tuple[str, ...]]] = OrderedDict()
        """Standing decisions that belong to no incident, and the places that were reported for them."""

    def restore(self, incidents: Iterable[Incident]) -> None:
        """Go on with what was open before a restart.

        Args:
            incidents: as archived, in the order of writing.
        """
        self._book.restore(incidents)

    def evidence(self, evidence: Evidence, total_nats: float, bound: float) -> None:
        """The sequential test has added a piece of evidence.

        Args:
            evidence: the piece.
            total_nats: the sum against its sender with it; for its victim, if it names no sender.
            bound: what that sum must reach for a decision.
        """
        self._publish(self._book.hear_evidence(evidence, total_nats, bound))

    def own(self, evidence: Evidence, share: float, bound: float) -> None:
        """The firewall acts on evidence of its own, which the sequential test does not add up.

        Args:
            evidence: the piece.
            share: what its source makes up of the sum, beside what the test has added up.
            bound: what that sum must reach for a decision.
        """
        self._publish(self._book.hear_own(evidence, share, bound))

    def spared(self, evidence: Evidence, total_nats: float, bound: float, why: str) -> None:
        """The sum has reached its bound, and an alert is all that may be done.

        Args:
            evidence: the piece that led to the decision, passed to `evidence()` before.
            total_nats: the sum with it.
            bound: the bound.
            why: why nothing stronger is done, in words.
        """
        self._publish(self._book.spared(evidence, total_nats, bound, why))

    def alert(self, alert: Alert) -> None:
        """Kitsune has raised an alert."""
        self._publish(self._book.hear_alert(alert))

    def decided(self, decision: Decision) -> None:
        """The firewall has decided, extended or lifted something; to be called for every decision.

        What belongs to no incident gets a line of its own.
        """
        self._publish(self._book.decided(decision))
        if not self._book.has(decision.id):
            self._note_alone(decision)
            self._lines.event(line_of(decision_event(decision), self._form), important=True)

    def confirmed(self, confirmation: Confirmation, places: Sequence[str] = ()) -> None:
        """An enforcer has answered a decision.

        Args:
            confirmation: the answer.
            places: where the decision is in force now.
        """
        self._publish(self._book.confirmed(confirmation, places))
        decision, told = self._alone.get(confirmation.id, (None, ()))
        if decision is None or tuple(places) == told:
            return
        self._alone[decision.id] = decision, tuple(places)
        if set(places) - set(told):
            self._lines.event(line_of(decision_event(decision, places), self._form))

    def _note_alone(self, decision: Decision) -> None:
        _, told = self._alone.pop(decision.id, (None, ()))
        if decision.action in ("block", "protect") and not decision.dry_run:
            self._alone[decision.id] = decision, told
            if len(self._alone) > _MOST_ALONE:
                self._alone.popitem(last=False)

    def count(self, decision: str, packets: int, now: int) -> None:
        """A switch has counted packets that a decision dropped, challenged or metered so far.

        Args:
            decision: id of the decision.
            packets: the counter.
            now: capture time of the reading, ns.
        """
        self._publish(self._book.count(decision, packets, now))

    def lapse(self, now: int) -> None:
        """Capture time has come to `now` (ns): end what is over, publish news that waited."""
        self._publish(self._book.lapse(now))

    def flush(self) -> None:
        """Publish news that waits, because the firewall ends; what is open stays open."""
        self._publish(self._book.flush())

    def health(self) -> dict[str, int]:
        """Counters for the operator and for Prometheus."""
        return {
            "incidents_open": len(self._book),
            "suspicions": self._book.suspicions,
            "incident_reports": self._written,
            "incident_openings_put_off": self._book.left_out,
        }

    def _publish(self, incidents: Iterable[Incident]) -> None:
        for one in incidents:
            self._written += 1
            self._engine.write(
                f"{INCIDENT}.firewall.{one.kind}", one.to_value(), [due.NO_WAIT], event_time=one.event_time
            )
            if one.change != "more":
                line = line_of(incident_event(one), self._form)
                self._lines.event(line, important=one.change in IMPORTANT)
