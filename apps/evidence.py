"""Evidence against a sender, or for protecting a victim: one message for every source of evidence.

    kitsune, sonata_adapter, any app ──Evidence──► firewall   network.evidence.<app>.<kind>
    firewall ──Evidence──► any app                            network.evidence.firewall.<kind>
    kitsune ──TrainingState──► firewall, page                 network.training.<app>
    kitsune ──DriftState──► people                            network.drift.<app>
    firewall ──Judged──► replay                               network.judged.firewall

The weight of evidence is a number of nats, so that evidence of different sources adds up: how much more likely
an attack makes what was seen than the benign traffic of training does.  The firewall's own rules, which decide by
themselves, weigh what a decision takes at that time.
"""

from typing import Annotated, Final, Literal

from msgspec import Meta

from apps.messages import (
    MOST_SPARED,
    Message,
    MessageError,
    Name,
    Number,
    Port,
    Rate,
    Role,
    Sender,
    Time,
    Words,
    address_in,
)

EVIDENCE: Final = "network.evidence"
"""`<EVIDENCE>.<app>.<kind>`"""
TRAINING: Final = "network.training"
"""`<TRAINING>.<app>`"""
DRIFT: Final = "network.drift"
"""`<DRIFT>.<app>`"""
JUDGED: Final = "network.judged"
"""`<JUDGED>.<app>`"""
MOST_VICTIMS: Final = 16
MOST_NATS: Final = 1_000.0
ONE_HOST: Final = 4
"""Addresses of a MAC up to which they are one host: IPv4, link-local and two global ones of IPv6."""
MOST_USUAL: Final = MOST_SPARED

Kind = Literal["scan", "flood", "guessing", "spoofing", "unlike_training", "offence", "other"]
"""What the operator calls it."""


class Evidence(Message, frozen=True, kw_only=True):
    """An observation that benign traffic does not explain."""

    id: Name
    kind: Kind
    source: Name
    """What found it, the last segment of its key: a statistic, a query; `spoofing`, `flood` or `offence` of the firewall."""
    sender: Sender | None = None
    """Who did it; None if the senders' addresses are forged or too many to name."""
    address: Name = ""
    """IP address of the sender where its switch, port and MAC are not known; empty if `sender` says who it is."""
    forgeable: bool = True
    """Whether a third party could have sent this under the sender's address; False after a handshake."""
    routed: bool = False
    """The sender is behind a router, so that all who are there can send under its address."""
    forged: bool = False
    """The sender's address is another's, by what training saw: only the MAC and port are the sender's own."""
    supporting: bool = False
    """It supports other evidence and is never enough by itself: what is merely unlike training may be benign."""
    victims: Annotated[tuple[Name, ...], Meta(max_length=MOST_VICTIMS)] = ()
    """Addresses of the first victims; `victim_count` says how many there are."""
    victim_count: Number = 0
    service: Annotated[str, Meta(max_length=32)] = ""
    """`tcp/22`, `udp/53`, `icmp`, `arp`, `udp` for datagrams to many ports; of floods also `from-udp/53` for datagrams
    from a port and `tcp-ack/80` for segments of no connection; empty if there is no single one."""
    nats: Annotated[float, Meta(ge=0, le=MOST_NATS)]
    """Log-likelihood ratio of what is new since the source's last evidence about the same sender."""
    since: Time
    """Capture time of the first packet that it is based on, ns."""
    event_time: Time
    """Capture time of the last one, ns."""
    packets: Number
    """Number of packets that it is based on; 0 for earlier blocks."""
    first_packet: Number = 0
    """Arrival number at the switch of the packet that triggered it."""
    number: Number = 0
    """Position, from 1 on, among the evidence and states of training that this instance writes; 0: no order."""
    rate: Rate = 0.0
    """Packets a second of the sender at that time; without a sender, of the `service` towards the victim."""
    training_rate: Rate = 0.0
    """The highest rate of any second of training; 0 if training saw none."""
    usual_sources: Annotated[tuple[Name, ...], Meta(max_length=MOST_USUAL)] = ()
    """Of floods: who sent the victim such packets in training, the busiest first."""
    usual_rate: Rate = 0.0
    """With a sender of a flood: the highest rate of the `service` towards the victim in training."""
    usual_share: Annotated[float, Meta(ge=0, le=1)] = 0.0
    """Part of training's packets of that kind that these sources sent."""
    mac_addresses: Number = 0
    """How many IP addresses were seen behind the sender's MAC."""
    role: Role = "host"
    text: Words
    """In words, compared with the figures of training."""

    def check(self) -> None:
        """Check sender, victims and times.

        Raises:
            MessageError: an address is invalid, two senders are accused, or nobody is and nobody is a victim.
        """
        if self.sender is not None:
            self.sender.check()
        if self.address:
            address_in(self.address, "evidence")
        if self.sender is not None and self.address:
            raise MessageError("fields", "evidence: it names both a sender and a plain address")
        for address in (*self.victims, *self.usual_sources):
            address_in(address, "evidence")
        if self.sender is None and not self.address and not self.victims:
            raise MessageError("fields", "evidence: it names neither a sender nor a victim")
        if self.since > self.event_time:
            raise MessageError("time", "evidence: it ends before it begins")


class Judged(Message, frozen=True, kw_only=True):
    """How far an app is with evidence: made only where somebody wants to wait for it, such as a replay."""

    app: Name
    """Who wrote the evidence."""
    evidence: Number
    """Pieces of it that were judged so far."""
    decisions: Number
    """Decisions written until then, whatever led to them."""


class PortTraining(Message, frozen=True, kw_only=True):
    """Number of training packets that came in through a port."""

    switch: Name
    port: Port
    packets: Number


class TrainingState(Message, frozen=True, kw_only=True):
    """Progress of training, and what evidence can be based on when it is done."""

    packets: Number
    """Packets learnt so far."""
    wanted: Number
    """Packets of a whole training."""
    done: bool
    seconds: Rate
    """Capture time of training."""
    senders: Number
    """Senders that training has seen."""
    hosts: Number = 0
    """MAC addresses among them: those behind a router have its own.  0 until training is done."""
    event_time: Time
    """Of the last packet, ns."""
    seconds_left: Rate | None = None
    """Seconds until training is done, at the rate of the last two minutes; None if unknown."""
    ports: Annotated[tuple[PortTraining, ...], Meta(max_length=64)] = ()
    """Where the packets came from; empty for a model that was loaded."""
    number: Number = 0
    """As that of evidence."""


class DriftState(Message, frozen=True, kw_only=True):
    """Benign scores of the last day have left the distribution of training, or have returned to it."""

    drifted: bool
    share: Rate
    """Share of packets above the score that one training packet in a hundred exceeds; mean over half hours."""
    limit: Rate
    """The largest share that does not count as drift."""
    blocks: Number
    """Half hours of the last day that count."""
    event_time: Time
    text: Words
