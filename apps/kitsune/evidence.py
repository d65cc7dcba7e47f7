"""A finding as a message: who, against whom, how strong, and in words."""

import math
from typing import Final

from apps.evidence import Evidence, Kind
from apps.kitsune.behaviour.behaviour import CONTACTS
from apps.kitsune.behaviour.contacts import UNANSWERED, service_text
from apps.kitsune.behaviour.findings import Finding, Statistic
from apps.kitsune.behaviour.rows import SenderId, parts_of
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.roles import Roles
from apps.kitsune.victims import UsualTraffic
from apps.messages import Sender

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
}
_SOURCES: Final = {**dict.fromkeys(CONTACTS, "contacts"), "callbacks": "logins"}
"""Statistics that are one source: views of the same packets; and what only counts on top of another."""
_SECOND: Final = 1_000_000_000


def address_text(address: int) -> str:
    """An address of `behaviour.rows` as text; empty for none."""
    return ip_text(*parts_of(address))


def sender_of(sender: SenderId) -> Sender:
    """An identity of `behaviour.rows` as a message."""
    switch, port, mac, address = sender
    return Sender(switch=switch, port=port, mac=mac_text(mac), ip=address_text(address))


def evidence_of(
    finding: Finding,
    roles: Roles,
    *,
    proven: bool,
    forged: bool,
    rate: float,
    training_rate: float,
    usual: UsualTraffic | None = None,
) -> Evidence:
    """The message of a finding.

    Args:
        finding: what was found.
        roles: of senders, and the addresses behind their MACs.
        proven: whether the sender's address has completed a TCP handshake.
        forged: whether the address is not that of the sender: it belonged to another in training, or to nobody here.
        rate: packets a second of the sender now.
        training_rate: the highest of training.
        usual: what came to the victim of a flood in training.
    """
    sender = finding.sender
    at = round(finding.time * _SECOND)
    victim = address_text(finding.victim) if finding.victim else ""
    name = f"{finding.statistic}-{at}-{finding.arrival}"
    mac, parts = (sender[2], parts_of(sender[3])) if sender is not None else (0, (0, 0, 0))
    return Evidence(
        id=f"kitsune-{name}" if sender is None else f"kitsune-{name}-{mac:012x}",
        kind=KINDS[finding.statistic],
        source=_SOURCES.get(finding.statistic, finding.statistic),
        sender=None if sender is None else sender_of(sender),
        forgeable=not proven,
        routed=sender is not None and roles.is_routed(mac, parts),
        forged=forged,
        supporting=finding.supporting,
        victims=(victim,) if victim else (),
        victim_count=1 if victim else 0,
        service=service_text(finding.service) if finding.service >= 0 else "",
        nats=min(finding.nats, 1_000.0),
        since=min(at, max(0, round(finding.begun * _SECOND))),
        event_time=at,
        packets=max(1, round(finding.count)),
        first_packet=finding.arrival,
        rate=rate,
        training_rate=training_rate,
        usual_sources=tuple(map(address_text, usual.sources)) if usual is not None else (),
        usual_rate=usual.training_rate if usual is not None and sender is not None else 0.0,
        usual_share=min(1.0, usual.share) if usual is not None else 0.0,
        mac_addresses=roles.addresses(mac) if sender is not None else 0,
        role=roles.role(mac, parts) if sender is not None else "host",
        text=_words(finding, victim),
    )


def _words(finding: Finding, victim: str) -> str:
    sender = finding.sender
    who = "" if sender is None else (address_text(sender[3]) or mac_text(sender[2]))
    count, usual = math.ceil(finding.count), f"at most {finding.usual:,.0f} in training"
    within = f"within {finding.window_s:g} s"
    service = service_text(finding.service) if finding.service >= 0 else ""
    tried = "got no echo reply from" if finding.service == UNANSWERED else _TRIED.get(service)
    texts: dict[Statistic, str] = {
        "contacts": f"{who} failed to reach {_counted(count, 'new hosts or ports', 'new host or port')} {within}; {usual}",
        "ports": f"{who} failed to reach {_counted(count, 'new ports')} of {victim} {within}; {usual}",
        "targets": f"{who} {tried or f'failed to reach {service} at'}"
        f" {_counted(count, 'new hosts')} {within}; {usual}",
        "logins": f"{who} opened {_counted(count, 'short connections')} to {service} of {victim} {within}; {usual}",
        "callbacks": f"{victim} connected back to {who} {finding.window_s:.1f} s after its login to {service};"
        f" {_counted(round(finding.usual), 'hosts')} did so in training",
        "one_way": f"{who} sent {_counted(count, 'packets')} a second to {victim}, which does not answer; {usual}",
        "claims": f"{who} sent {_counted(count, 'ARP replies', 'ARP reply')} that nobody had asked for {within}; {usual}",
        "thefts": f"{who} claims the address of {victim}, which is present",
        "strangers": f"{_counted(count, 'addresses', 'address')} unknown to training failed to reach {service} of {victim} {within}; {usual}",
        "scores": f"the packets of {who} are unlike those of training ({finding.total:.0f} nats {within})",
        "threshold": f"a packet of {who} scored {finding.count:.3g}",
    }
    return texts[finding.statistic]


_TRIED: Final = {"icmp": "pinged", "arp": "got no ARP reply from"}
"""What a sender did to many hosts, by service; of others it is said that they were not reached."""


def _counted(number: int, nouns: str, noun: str = "") -> str:
    return f"{number:,} {(noun or nouns.removesuffix('s')) if number == 1 else nouns}"
