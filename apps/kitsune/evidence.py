"""A finding as a message: who, against whom, how strong, and in words."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Final, NamedTuple

from apps.evidence import Evidence, Kind
from apps.kitsune.behaviour.behaviour import CONTACTS
from apps.kitsune.behaviour.contacts import UNANSWERED, service_text
from apps.kitsune.behaviour.findings import Finding, Statistic
from apps.kitsune.behaviour.rows import SenderId, parts_of
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.roles import Roles
from apps.kitsune.victims import UsualTraffic
from apps.messages import Role, Sender

KINDS: Final[dict[Statistic, Kind]] = {
    "contacts": "scan",
    "ports": "scan",
    "targets": "scan",
    "logins": "guessing",
    "callbacks": "guessing",
    "one_way": "flood",
    "claims": "spoofing",
    "thefts": "spoofing",
    "strangers": "flood",
    "scores": "unlike_training",
    "threshold": "unlike_training",
    "fingerprint": "scan",
}
_SOURCES: Final = {**dict.fromkeys(CONTACTS, "contacts"), "callbacks": "logins"}
"""Statistics that are one source: views of the same packets; and what only counts on top of another."""
_SECOND: Final = 1_000_000_000


def address_text(address: int) -> str:
    """An address of `behaviour.rows` as text; empty for none."""
    return ip_text(*parts_of(address))


@lru_cache(maxsize=4_096)
def sender_of(sender: SenderId) -> Sender:
    """An identity of `behaviour.rows` as a message."""
    switch, port, mac, address = sender
    return Sender(switch=switch, port=port, mac=mac_text(mac), ip=address_text(address))


class SenderFacts(NamedTuple):
    """What evidence says of a sender; the same for all findings of a batch.  Without arguments: of nobody."""

    sender: Sender | None = None
    proven: bool = False
    """Its address has completed a TCP handshake."""
    forged: bool = False
    """The address is not that of the sender: it belonged to another in training, or to nobody here."""
    routed: bool = False
    """It is behind a gateway of training."""
    rate: float = 0.0
    """Packets a second now ..."""
    training_rate: float = 0.0
    """... and the most of any second of training."""
    mac_addresses: int = 0
    """Addresses behind its MAC."""
    role: Role = "host"


def facts_of(
    sender: SenderId, roles: Roles, *, proven: bool, forged: bool, rate: float, training_rate: float
) -> SenderFacts:
    """What is known of a sender, with what its MAC and address tell.

    Args:
        sender: an identity of `behaviour.rows`.
        roles: of senders, and the addresses behind their MACs.
        proven: as in `SenderFacts`.
        forged: as in `SenderFacts`; an address that a host here borrows is forged, too.
        rate: as in `SenderFacts`.
        training_rate: as in `SenderFacts`.
    """
    mac, parts = sender[2], parts_of(sender[3])
    return SenderFacts(
        sender_of(sender),
        proven,
        forged or roles.is_borrowed(mac, parts),
        roles.is_routed(mac, parts),
        rate,
        training_rate,
        roles.addresses(mac),
        roles.role(mac, parts),
    )


def evidence_of(finding: Finding, facts: SenderFacts, usual: UsualTraffic | None = None) -> Evidence:
    """The message of a finding.

    Args:
        finding: what was found.
        facts: of its sender; of nobody, with the rates of the victim, where it has none.
        usual: what came to the victim of a flood in training.
    """
    sender = finding.sender
    at = round(finding.time * _SECOND)
    victim = address_text(finding.victim) if finding.victim else ""
    name = f"{finding.statistic}-{at}-{finding.arrival}"
    return Evidence(
        id=f"kitsune-{name}" if sender is None else f"kitsune-{name}-{sender[2]:012x}",
        kind=KINDS[finding.statistic],
        source=_SOURCES.get(finding.statistic, finding.statistic),
        sender=facts.sender,
        forgeable=not facts.proven,
        routed=facts.routed,
        forged=facts.forged,
        supporting=finding.supporting,
        victims=(victim,) if victim else (),
        victim_count=1 if victim else 0,
        service=service_text(finding.service) if finding.service >= 0 else "",
        nats=min(finding.nats, 1_000.0),
        since=min(at, max(0, round(finding.begun * _SECOND))),
        event_time=at,
        packets=max(1, round(finding.count)),
        first_packet=finding.arrival,
        rate=facts.rate,
        training_rate=facts.training_rate,
        usual_sources=tuple(map(address_text, usual.sources)) if usual is not None else (),
        usual_rate=usual.training_rate if usual is not None and sender is not None else 0.0,
        usual_share=min(1.0, usual.share) if usual is not None else 0.0,
        mac_addresses=facts.mac_addresses,
        role=facts.role,
        text=_words(finding, victim),
    )


_TRIED: Final = {"icmp": "pinged", "arp": "got no ARP reply from"}
"""What a sender did to many hosts, by service; of others it is said that they were not reached."""


class _Told(NamedTuple):
    """A finding, and the names that its text needs."""

    finding: Finding
    who: str
    victim: str

    @property
    def service(self) -> str:
        return service_text(self.finding.service) if self.finding.service >= 0 else ""

    @property
    def within(self) -> str:
        return f"within {self.finding.window_s:g} s"

    @property
    def usual(self) -> str:
        most = f"{self.finding.usual:,.0f}"
        return "none in training" if most == "0" else f"at most {most} in training"

    def counted(self, nouns: str, noun: str = "") -> str:
        return _counted(math.ceil(self.finding.count), nouns, noun)


def _sweep(told: _Told) -> str:
    unanswered = told.finding.service == UNANSWERED
    tried = "got no echo reply from" if unanswered else _TRIED.get(told.service)
    tried = tried or f"failed to reach {told.service} at"
    return f"{told.who} {tried} {told.counted('new hosts')} {told.within}; {told.usual}"


_TEXTS: Final[dict[Statistic, Callable[[_Told], str]]] = {
    "contacts": lambda told: (
        f"{told.who} failed to reach {told.counted('new hosts or ports', 'new host or port')} {told.within}; {told.usual}"
    ),
    "ports": lambda told: (
        f"{told.who} failed to reach {told.counted('new ports')} of {told.victim} {told.within}; {told.usual}"
    ),
    "targets": _sweep,
    "logins": lambda told: (
        f"{told.who} opened {told.counted('short connections')} to {told.service} of {told.victim} {told.within}; {told.usual}"
    ),
    "callbacks": lambda told: (
        f"{told.victim} connected back to {told.who} {told.finding.window_s:.1f} s after its login to {told.service};"
        f" {_counted(round(told.finding.usual), 'hosts') if told.finding.usual >= 0.5 else 'no host'} did so in training"
    ),
    "one_way": lambda told: (
        f"{told.who} sent {told.counted('packets')} a second to {told.victim}, which does not answer; {told.usual}"
    ),
    "claims": lambda told: (
        f"{told.who} sent {told.counted('ARP replies', 'ARP reply')} that nobody had asked for {told.within}; {told.usual}"
    ),
    "thefts": lambda told: f"{told.who} claims the address of {told.victim}, which is present",
    "strangers": lambda told: (
        f"{told.counted('addresses', 'address')} unknown to training failed to reach {told.service} of {told.victim}"
        f" {told.within}; {told.usual}"
    ),
    "scores": lambda told: (
        f"the packets of {told.who} are unlike those of training ({told.finding.total:.0f} nats {told.within})"
    ),
    "threshold": lambda told: f"a packet of {told.who} scored {told.finding.count:.3g}",
    "fingerprint": lambda told: (
        f"{told.who} sent {told.counted('SYNs')} with the destination's address as sequence number, as Mirai does,"
        f" to {told.service} {told.within}; {told.usual}"
    ),
}


def _words(finding: Finding, victim: str) -> str:
    sender = finding.sender
    who = "" if sender is None else (address_text(sender[3]) or mac_text(sender[2]))
    return _TEXTS[finding.statistic](_Told(finding, who, victim))


def _counted(number: int, nouns: str, noun: str = "") -> str:
    return f"{number:,} {(noun or nouns.removesuffix('s')) if number == 1 else nouns}"
