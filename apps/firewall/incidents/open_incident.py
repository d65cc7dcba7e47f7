"""One incident while it grows.  Pure.

The book (`incident_book.py`) decides what belongs to it; here is what it holds, bounded in every direction.
"""

import hashlib
from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from msgspec import structs

from apps.evidence import MOST_VICTIMS, Evidence, Kind
from apps.incidents import (
    MOST_ACTIONS,
    MOST_CONTRIBUTIONS,
    Change,
    Contribution,
    Incident,
    IncidentAction,
    IncidentCost,
    Remedy,
)
from apps.messages import Sender, one_line

AttackerKey = tuple[str, ...]

MOST_ATTACKERS: Final = 256
"""Attackers of one incident whose sums are kept apart."""
MOST_VICTIMS_COUNTED: Final = 1_024
MOST_SOURCES: Final = 32
MOST_KEYS: Final = 2_048
ACTIONS_KEPT: Final = 1_024
"""Decisions of one incident that are followed; a report shows the newest `MOST_ACTIONS`."""
NAMED: Final = ("scan", "flood", "guessing", "spoofing")
FORGED: Final = "forged or too many addresses"
NAMED_SHARE: Final = 0.1
"""A kind that says what happens wins over `unlike_training` where it has this share of the weight."""


@dataclass(slots=True)
class SumAgainst:
    """The sum of evidence against one attacker, and which source has which share of it."""

    total: float = 0.0
    bound: float = 0.0
    shares: dict[str, Contribution] = field(default_factory=dict)
    own: dict[str, Contribution] = field(default_factory=dict)
    """By source: evidence of the firewall itself, which counts in full beside `total`."""

    @property
    def sum(self) -> float:
        """What decides: the sum of the sequential test, and what the firewall itself adds."""
        return self.total + sum(share.nats for share in self.own.values())

    def add(self, piece: Contribution, total: float, bound: float) -> None:
        """Take a piece; `total` is the sum with it, so what came before has faded to the rest."""
        before = max(0.0, total - piece.nats)
        kept = min(1.0, before / self.total) if self.total > 0 else 0.0
        self.shares = {
            source: structs.replace(share, nats=share.nats * kept) for source, share in self.shares.items()
        }
        others = sum(share.nats for source, share in self.shares.items() if source != piece.source)
        self.shares[piece.source] = structs.replace(piece, nats=max(0.0, total - others))
        self.total, self.bound = total, bound
        while len(self.shares) > MOST_SOURCES:
            del self.shares[min(self.shares, key=lambda source: self.shares[source].nats)]

    def largest(self) -> tuple[Contribution, ...]:
        """Shares, the largest first."""
        ordered = sorted((*self.shares.values(), *self.own.values()), key=lambda share: -share.nats)
        return tuple(share for share in ordered if share.nats > 0)[:MOST_CONTRIBUTIONS]


@dataclass(slots=True, eq=False)
class OpenIncident:
    """Everything known of one incident; times are capture time in ns."""

    id: str
    begun: int
    last: int
    attacker: Sender | None = None
    attacker_text: str = ""
    shown: bool = False
    """Whether it was published: before that it is only a suspicion."""
    published_at: int = 0
    keys: set[AttackerKey] = field(default_factory=set)
    sums: OrderedDict[AttackerKey, SumAgainst] = field(default_factory=OrderedDict)
    """By attacker; the one heard of last is the last."""
    names: set[AttackerKey] = field(default_factory=set)
    """Attackers, counted once each: a MAC has several keys where it speaks ARP and IP."""
    attackers_before: int = 0
    """Number of attackers from before a restart, whose names are lost."""
    nameless: bool = False
    """Whether evidence came that accuses nobody: forged addresses, or too many."""
    kinds: dict[Kind, float] = field(default_factory=dict)
    """Weight by kind."""
    victims: dict[str, None] = field(default_factory=dict)
    victim_count: int = 0
    services: set[str] = field(default_factory=set)
    packets: Counter[str] = field(default_factory=Counter)
    """By source, because two sources may speak of the same packets."""
    first_packet: int = 0
    peak: float = 0.0
    decided: tuple[float, float] | None = None
    """Sum and bound at the last decision."""
    evidence: tuple[Contribution, ...] = ()
    """The newest pieces, the newest last."""
    actions: OrderedDict[str, IncidentAction] = field(default_factory=OrderedDict)
    """By the decision's id."""
    past: Counter[Remedy] = field(default_factory=Counter)
    """Packets of decisions that are not followed any more."""
    joined: str = ""

    # -- what comes in ---------------------------------------------------------------------------------

    @property
    def attackers(self) -> int:
        """How many attackers are known."""
        return max(self.attackers_before, len(self.names))

    def blame(self, keys: Sequence[AttackerKey], sender: Sender | None) -> SumAgainst:
        """The sum of an attacker, who is counted if he is new; `keys` with the narrowest first."""
        key, name = keys[0], keys[-1]
        if sender is not None and len(self.names) < MOST_KEYS:
            self.names.add(name)
        found = self.sums.get(key)
        if found is None:
            found = self.sums[key] = SumAgainst()
            while len(self.sums) > MOST_ATTACKERS:
                self.sums.popitem(last=False)
        self.sums.move_to_end(key)
        self.attacker = self.attacker or sender
        return found

    def hear(self, evidence: Evidence, keys: Sequence[AttackerKey], total: float, bound: float) -> None:
        """Take a piece of evidence; `total` is the sum against its sender with it."""
        piece = piece_of(evidence)
        against = self.blame(keys, evidence.sender)
        against.add(piece, total, bound)
        self._take(evidence, piece, against)

    def hear_own(self, evidence: Evidence, keys: Sequence[AttackerKey], share: float, bound: float) -> None:
        """Take a piece of evidence of the firewall itself; `share` is what its source makes up of the sum."""
        piece = piece_of(evidence)
        against = self.blame(keys, evidence.sender)
        against.own[piece.source] = structs.replace(piece, nats=share)
        against.bound = bound
        if evidence.kind == "offence":  # about the past: it says nothing of what happens now
            self.peak = max(self.peak, against.sum)
            self.note(piece)
        else:
            self._take(evidence, piece, against)

    def _take(self, evidence: Evidence, piece: Contribution, against: SumAgainst) -> None:
        self.nameless = self.nameless or not (evidence.sender or evidence.address)
        self.attacker_text = self.attacker_text or evidence.address
        self.peak = max(self.peak, against.sum)
        self.weigh(evidence.kind, evidence.nats)
        self.begun, self.last = min(self.begun, evidence.since), max(self.last, evidence.event_time)
        self.name_victims(evidence.victims, evidence.victim_count)
        if evidence.service and len(self.services) < MOST_SOURCES:
            self.services.add(evidence.service)
        self.count_packets(evidence.source, evidence.packets, evidence.first_packet)
        self.note(piece)

    def note(self, *pieces: Contribution) -> None:
        """Keep pieces among the newest."""
        self.evidence = (*self.evidence, *pieces)[-MOST_CONTRIBUTIONS:]

    def weigh(self, kind: Kind, nats: float) -> None:
        """Add to the weight of a kind."""
        self.kinds[kind] = self.kinds.get(kind, 0.0) + nats

    def name_victims(self, victims: tuple[str, ...], count: int) -> None:
        """Take victims; `count` may be more than are named."""
        for victim in victims:
            if len(self.victims) < MOST_VICTIMS_COUNTED:
                self.victims.setdefault(victim)
        self.victim_count = max(self.victim_count, count, len(self.victims))

    def count_packets(self, source: str, packets: int, first: int) -> None:
        """Count packets of a source, and remember the earliest that is named."""
        if source in self.packets or len(self.packets) < MOST_SOURCES:
            self.packets[source] += packets
        if first:
            self.first_packet = min(self.first_packet or first, first)

    def act(self, name: str, action: IncidentAction) -> list[str]:
        """Take a decision, or the new state of one; returns decisions that are not followed any more."""
        self.actions[name] = action
        dropped = []
        while len(self.actions) > ACTIONS_KEPT:
            over = (each for each, one in self.actions.items() if one.state in ("over", "failed"))
            dropped.append(next(over, next(iter(self.actions))))
            self.past[self.actions[dropped[-1]].remedy] += self.actions[dropped[-1]].packets
            del self.actions[dropped[-1]]
        return dropped

    def absorb(self, other: "OpenIncident") -> None:
        """Take over all that another incident has, which turned out to be a part of this one."""
        for key, one in other.sums.items():
            if key not in self.sums:
                self.sums[key] = one
                self.sums.move_to_end(key, last=False)
        while len(self.sums) > MOST_ATTACKERS:
            self.sums.popitem(last=False)
        self.names |= other.names
        self.attackers_before = max(self.attackers_before, other.attackers_before)
        self.attacker = self.attacker or other.attacker
        self.attacker_text = self.attacker_text or other.attacker_text
        self.begun, self.last = min(self.begun, other.begun), max(self.last, other.last)
        self.nameless = self.nameless or other.nameless
        self.past.update(other.past)
        for kind, nats in other.kinds.items():
            self.weigh(kind, nats)
        self.name_victims(tuple(other.victims), other.victim_count)
        self.services |= other.services
        for source, packets in other.packets.items():
            self.count_packets(source, packets, other.first_packet)
        self.peak = max(self.peak, other.peak)
        self.decided = self.decided or other.decided
        newest = sorted((*other.evidence, *self.evidence), key=lambda piece: piece.event_time)
        self.note(*newest)
        for name, action in other.actions.items():
            self.act(name, action)
        other.joined = self.id

    # -- what it is ------------------------------------------------------------------------------------

    @property
    def kind(self) -> Kind:
        """What the operator calls it: of the kinds that say what happens the heaviest, if it has any weight."""
        named = [kind for kind in self.kinds if kind in NAMED]
        best = max(named, key=lambda kind: self.kinds[kind], default=None)
        if best is not None and self.kinds[best] >= NAMED_SHARE * sum(self.kinds.values()):
            return best
        return max(self.kinds, key=lambda kind: self.kinds[kind], default="other")

    def remedied(self, now: int) -> bool:
        """Whether a decision about it is in force, or is on its way to the switch."""
        return any(
            action.state in ("decided", "in_force") and action.remedy != "alert" and not_past(action, now)
            for action in self.actions.values()
        )

    def strongest(self) -> SumAgainst:
        """The sum against the attacker who has come closest to his bound."""
        return max(self.sums.values(), key=lambda one: one.sum / (one.bound or 1.0), default=SumAgainst())

    def report(self, change: Change, now: int) -> Incident:
        """The incident as a message."""
        strongest = self.strongest()
        nats, bound = self.decided or (strongest.sum, strongest.bound)
        return Incident(
            id=self.id,
            kind=self.kind,
            state="over" if change == "over" else "open",
            change=change,
            attacker=None if self.nameless else self.attacker,
            attacker_text=self.who(),
            attacker_count=self.attackers,
            victims=tuple(self.victims)[:MOST_VICTIMS],
            victim_count=self.victim_count,
            service=next(iter(self.services)) if len(self.services) == 1 else "",
            begun=self.begun,
            last=self.last,
            event_time=max(now, self.last, *(action.effective for action in self.actions.values())),
            packets=max(self.packets.values(), default=0),
            first_packet=self.first_packet,
            nats=nats,
            bound=bound,
            peak_nats=self.peak,
            contributions=strongest.largest(),
            evidence=self.evidence,
            actions=tuple(self.actions.values())[-MOST_ACTIONS:],
            action_count=len(self.actions),
            cost=self.cost(),
            joined=self.joined,
        )

    def who(self) -> str:
        """The attackers in words."""
        if self.attacker is None:
            named = self.attacker_text
            if named and self.nameless and not named.startswith(FORGED):
                return f"{FORGED}, and {named}"
            return named or FORGED
        first = who(self.attacker)
        if self.nameless:
            return f"{FORGED}, and {first}"
        return f"{self.attackers:,} senders, the first {first}" if self.attackers > 1 else first

    def cost(self) -> IncidentCost:
        """Packets by what was done with them."""
        sums = Counter(self.past)
        for action in self.actions.values():
            sums[action.remedy] += action.packets
        return IncidentCost(dropped=sums["block"], challenged=sums["guard"], metered=sums["meter"])


def not_past(action: IncidentAction, now: int) -> bool:
    """Whether the end of an action has not come yet."""
    return action.until == 0 or action.until > now


def piece_of(evidence: Evidence) -> Contribution:
    """A piece of evidence as an incident keeps it."""
    return Contribution(
        source=evidence.source,
        kind=evidence.kind,
        nats=evidence.nats,
        packets=evidence.packets,
        text=one_line(evidence.text),
        event_time=evidence.event_time,
    )


def who(sender: Sender) -> str:
    """A sender in words."""
    where = f"port {sender.port} of {sender.switch}"
    return f"{sender.ip} ({sender.mac}, {where})" if sender.ip else f"{sender.mac} ({where})"


def incident_id(about: str, begun: int) -> str:
    """A short id, the same for the same incident in every replay."""
    return hashlib.sha256(f"incident {about} {begun}".encode()).hexdigest()[:12]
