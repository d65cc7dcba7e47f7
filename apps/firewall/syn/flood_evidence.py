"""SYN floods as evidence: of the service that they fill, or of one source that repeats.  Pure.

Anybody can forge the source of a SYN, so all of this evidence is forgeable.  Times are capture time in ns.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from apps.evidence import Evidence
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.syn_policy import Sample
from apps.messages import Exhibit, Target


@dataclass(frozen=True)
class Suspicion:
    """A flood towards a host; times are capture time in ns."""

    host: str
    evidence: Exhibit
    now: int
    since: int
    count: int = 0
    """SYNs that were counted."""


class Examined(Protocol):
    """A suspicion and the capture time up to which its SYNs were examined."""

    suspicion: Suspicion
    now: int


class SynFinding(NamedTuple):
    """Evidence, and what is to be done about it."""

    evidence: Evidence
    reason: str
    """Of the decision, in words."""
    exhibit: Exhibit
    source: str = ""
    """The address or prefix that is to be blocked; empty: the service is to be guarded."""

    @property
    def service(self) -> TcpService:
        """The service that is flooded."""
        return TcpService(self.evidence.victims[0], int(self.evidence.service.partition("/")[2]))

    @property
    def target(self) -> Target:
        """What a block matches."""
        return Target(kind="ip", address=self.evidence.address or self.source)


def flood_evidence(sample: Sample, reason: str, watch: Examined, nats: float) -> SynFinding:
    """A flood whose senders nobody can tell.

    Args:
        sample: SYNs towards a service that no handshake has followed.
        reason: why it is a flood, and what is done.
        watch: what it was suspected by, and when it was examined.
        nats: its weight.
    """
    evidence = _evidence(sample.service, watch, nats, sample.total, reason)
    return SynFinding(evidence, reason, watch.suspicion.evidence)


def source_evidence(source: str, sample: Sample, reason: str, watch: Examined, nats: float) -> SynFinding:
    """A source that repeats and finishes no handshake; a prefix stands for many, which the evidence cannot name.

    Args:
        source: address or prefix.
        sample: SYNs towards a service that no handshake has followed.
        reason: why its sources are blocked.
        watch: what the flood was suspected by, and when it was examined.
        nats: its weight.
    """
    if "/" in source:
        return flood_evidence(sample, reason, watch, nats)._replace(source=source)
    syns = sample.syns.get(source, 0)
    text = f"{source}, which others may have forged, sent {syns:,} SYNs and finished no handshake; {reason}"
    evidence = _evidence(sample.service, watch, nats, syns, text, source)
    return SynFinding(evidence, reason, watch.suspicion.evidence, source)


def _evidence(
    service: TcpService, watch: Examined, nats: float, packets: int, text: str, address: str = ""
) -> Evidence:
    at = watch.now
    return Evidence(
        id=f"firewall-flood-{at}-{service}{address and '-'}{address}",
        kind="flood",
        source="flood",
        address=address,
        forgeable=True,
        victims=(service.address,),
        victim_count=1,
        service=f"tcp/{service.port}",
        nats=nats,
        since=min(watch.suspicion.since, at),
        event_time=at,
        packets=packets,
        text=text,
    )
