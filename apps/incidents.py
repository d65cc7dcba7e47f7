"""What happened, in one message: all evidence, alerts and decisions about one attacker or one victim.

    firewall ──Incident──► page, report, `sdnator incidents`, SIEM   network.incident.firewall.<kind>

An incident is written again whenever it changes, under the same id: the last item holds.
"""

from typing import Annotated, Final, Literal

from msgspec import Meta

from apps.evidence import MOST_VICTIMS, Kind
from apps.messages import Message, MessageError, Name, Number, Sender, Time, Words, address_in

INCIDENT: Final = "network.incident"
"""`<INCIDENT>.<app>.<kind>`"""
INCIDENTS: Final = f"{INCIDENT}.firewall.*"
MOST_CONTRIBUTIONS: Final = 8
MOST_ACTIONS: Final = 32
MOST_PLACES: Final = 64
EFFECTIVE_S: Final = 5.0
"""An incident counts as mitigated if a remedy was in force within this time of its first packet."""
_SECOND: Final = 1_000_000_000

Nats = Annotated[float, Meta(ge=0, le=1e12)]
REMEDY_WORDS: Final = {"meter": "rate limit"}
"""Remedies that people call by another name than messages do."""
Change = Literal["opened", "more", "decided", "confirmed", "over"]
Remedy = Literal["block", "guard", "meter", "alert"]
ActionState = Literal["decided", "in_force", "over", "failed"]


class Contribution(Message, frozen=True, kw_only=True):
    """What one source of evidence contributes."""

    source: Name
    """A statistic, a query, or `alert`: the last segment of the evidence's key."""
    kind: Kind = "other"
    nats: Nats = 0.0
    """Its share of a sum; 0 for an alert, which has no weight."""
    packets: Number = 0
    text: Words = ""
    event_time: Time = 0
    """Capture time of the last packet that it rests on, ns."""


class IncidentAction(Message, frozen=True, kw_only=True):
    """A decision in an incident, and its outcome."""

    decision: Name = ""
    """Id of the decision; empty for `alert`, where nothing was sent to a switch."""
    remedy: Remedy
    dry_run: bool = False
    """It was decided, but nothing is enforced: dry run, or copies of packets are all that the switch sees."""
    target: Words = ""
    """The address, prefix or MAC (with its port) that the decision names."""
    switch: Name = ""
    since: Time
    """Capture time of the decision, ns."""
    effective: Time = 0
    """Capture time at which a switch confirmed it, ns; 0 = not yet."""
    until: Time = 0
    """Its end, ns; 0 = none."""
    state: ActionState = "decided"
    places: Annotated[tuple[Words, ...], Meta(max_length=MOST_PLACES)] = ()
    """Enforcers with the places where it is in force, such as `p4runtime_ctrl s1`."""
    reason: Words = ""
    """Why; for `alert` why nothing stronger was done."""
    nats: Nats = 0.0
    """Sum of the evidence against the target when it was decided."""
    bound: Nats = 0.0
    """The sum that was needed; 0 = another rule decided."""
    contributions: Annotated[tuple[Contribution, ...], Meta(max_length=MOST_CONTRIBUTIONS)] = ()
    """Shares of that sum, the largest first."""
    packets: Number = 0
    """Packets dropped, challenged or metered by it, as far as the switches have counted."""

    @property
    def enforced(self) -> bool:
        """Whether a switch has confirmed it and carries, or carried, it out."""
        return self.effective > 0 and not self.dry_run


class IncidentCost(Message, frozen=True, kw_only=True):
    """What the remedies of an incident did to packets."""

    dropped: Number = 0
    challenged: Number = 0
    metered: Number = 0

    @property
    def stopped(self) -> int:
        """Packets that a remedy acted upon."""
        return self.dropped + self.challenged + self.metered


class Incident(Message, frozen=True, kw_only=True):
    """`network.incident.<app>.<kind>`."""

    id: Name
    kind: Kind
    state: Literal["open", "over"] = "open"
    change: Change
    """Why it is written now."""
    attacker: Sender | None = None
    """The first one known; None if addresses are forged or nobody can be named."""
    attacker_text: Words
    attacker_count: Number = 1
    victims: Annotated[tuple[Name, ...], Meta(max_length=MOST_VICTIMS)] = ()
    """The first ones; `victim_count` says how many there are."""
    victim_count: Number = 0
    service: Annotated[str, Meta(max_length=32)] = ""
    """`tcp/22`, `udp/53`, `arp`; empty if there is no single one."""
    begun: Time
    """Capture time of the first packet that its evidence is based on, ns."""
    last: Time
    """Capture time of the last sign of it, ns: evidence, an alert, or a growing drop counter."""
    event_time: Time
    """Capture time of this report, ns."""
    packets: Number = 0
    """Packets of the source that saw most of it."""
    first_packet: Number = 0
    """Arrival number of the earliest packet that a piece of evidence names; 0 = unknown."""
    nats: Nats = 0.0
    """Sum of the evidence against its strongest attacker at the last decision; before one, now."""
    bound: Nats = 0.0
    """The bound of that sum; 0 = another rule decides."""
    peak_nats: Nats = 0.0
    """The highest that the sum has been."""
    contributions: Annotated[tuple[Contribution, ...], Meta(max_length=MOST_CONTRIBUTIONS)] = ()
    """Shares of the sum by source, the largest first."""
    evidence: Annotated[tuple[Contribution, ...], Meta(max_length=MOST_CONTRIBUTIONS)] = ()
    """The newest pieces, the newest last."""
    actions: Annotated[tuple[IncidentAction, ...], Meta(max_length=MOST_ACTIONS)] = ()
    """In order of time, the newest ones; `action_count` says how many there are."""
    action_count: Number = 0
    cost: IncidentCost = IncidentCost()
    joined: Name = ""
    """The id of the incident that this one turned out to be a part of; it is then over."""

    def check(self) -> None:
        """Check addresses and times.

        Raises:
            MessageError: an address is invalid, or it ends before it begins.
        """
        if self.attacker is not None:
            self.attacker.check()
        for victim in self.victims:
            address_in(victim, "incident")
        if self.begun > self.last:
            raise MessageError("time", "incident: it ends before it begins")

    @property
    def mitigated_after_s(self) -> float | None:
        """Seconds of capture time from its first packet to the first remedy in force; None if there is none."""
        begun = [each.effective for each in self.actions if each.enforced and each.remedy != "alert"]
        return max(0.0, (min(begun) - self.begun) / _SECOND) if begun else None

    @property
    def mitigated(self) -> bool:
        """Whether a block, guard or meter was in force within `EFFECTIVE_S` of its first packet."""
        after = self.mitigated_after_s
        return after is not None and after <= EFFECTIVE_S
