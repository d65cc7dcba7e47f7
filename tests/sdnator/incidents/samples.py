"""An incident from its opening to its end, as the firewall reports it."""

from apps.firewall.incidents.incident_book import IncidentBook
from apps.incidents import Incident
from tests.apps.firewall.alerts import SECOND
from tests.apps.firewall.incidents import samples


def life() -> list[Incident]:
    """Opened, decided, confirmed, 70 packets dropped, block lifted, over."""
    book = IncidentBook()
    told = book.hear_evidence(samples.evidence(99.0, source="port_scan", nats=4.0), 4.0, samples.BOUND)
    told += book.hear_evidence(samples.evidence(), 10.0, samples.BOUND)
    told += book.decided(samples.decision())
    told += book.confirmed(samples.confirmation())
    told += book.count("d1", 70, 200 * SECOND)
    told += book.decided(samples.decision(701.0, action="unblock", reason="the block ran out"))
    return told + book.lapse(1400 * SECOND)
