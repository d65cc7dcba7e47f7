"""What the firewall itself finds, as evidence that every app can read: the object that decides is the one written.

    ARP bindings ──spoofing─┐
    SYN guard ────flood─────┼─► OwnEvidence ─► network.evidence.firewall.<kind>, and incidents
    archive ──────offence───┘

It never reaches the sequential test: who finds it acts on it at once, and what comes back by DUE is ignored.
"""

from collections.abc import Callable
from typing import Final

import due
from apps.evidence import EVIDENCE, Evidence
from apps.firewall.evidence.ongoing_findings import OngoingFindings, OwnFinding
from apps.firewall.incidents.incident_reports import IncidentReports
from due import Capability, Engine

OWN_APP: Final = "firewall"
OWN_EVIDENCE: Final = f"{EVIDENCE}.{OWN_APP}"
"""`<OWN_EVIDENCE>.<kind>`: spoofing, flood, offence."""
EVIDENCE_CAPABILITY: Final = Capability(f"{OWN_EVIDENCE}.*", delivery="reliable", archive="always")


class OwnEvidence:
    """Writes the firewall's own evidence, and tells incidents about it; the service's lock is held meanwhile.

    Args:
        engine: where it is written.
        incidents: what belongs together.
        bound: nats that a decision of the sequential test takes now.
    """

    def __init__(self, engine: Engine, incidents: IncidentReports, bound: Callable[[], float]) -> None:
        self._engine = engine
        self._incidents = incidents
        self._bound = bound
        self._ongoing = OngoingFindings()
        self._written = 0

    @property
    def bound(self) -> float:
        """The weight of a rule that decides by itself: what a decision takes."""
        return self._bound()

    def found(self, evidence: Evidence, *, again: bool = False) -> OwnFinding:
        """The evidence by which a finding that may go on is decided, and whether it is news; see `OngoingFindings`."""
        return self._ongoing.found(evidence, again=again)

    def health(self) -> dict[str, int]:
        """Counters for the operator and for Prometheus."""
        return {"own_evidence": self._written, "own_evidence_put_off": self._ongoing.put_off}

    def tell(self, evidence: Evidence, bound: float = 0.0) -> None:
        """Write evidence, before what is decided by it.

        Args:
            evidence: the object that decides.
            bound: what the sum needs that it is a part of; 0: what a decision takes now.
        """
        self._write(evidence)
        self._ongoing.told(evidence)
        bound = bound or self.bound
        self._incidents.own(evidence, evidence.nats if evidence.supporting else bound, bound)

    def spared(self, evidence: Evidence, why: str) -> None:
        """Evidence that was told would have led to a block, and an alert is all that may be done."""
        self._incidents.spared(evidence, self.bound, self.bound, why)

    def lapse(self, now: int) -> None:
        """Capture time has come to `now` (ns): write the last word about findings that are over."""
        for evidence in self._ongoing.over(now):
            self._write(evidence)

    def _write(self, evidence: Evidence) -> None:
        self._written += 1
        self._engine.write(
            f"{OWN_EVIDENCE}.{evidence.source}",
            evidence.to_value(),
            [due.NO_WAIT],
            event_time=evidence.event_time,
        )
