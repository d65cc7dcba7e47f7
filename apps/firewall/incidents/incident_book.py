"""Which incident evidence, alerts and decisions belong to, and what is to be published of it.  Pure.

    evidence ─┐            ┌─ suspicion: kept quietly, until its sum is half of what a decision takes
    alert ────┼─► the book ┤
    decision ─┘            └─ incident: published when it opens, when something is decided, when it is over, and
                              at most once a second of capture time in between

One attacker is one incident: a MAC with few addresses, otherwise a MAC and an address.  Many attackers of one victim
are one incident too, where the evidence says flood or guessing: other kinds name victims that have nothing else in
common.

All times are capture time in ns, and believed: the caller has refused impossible ones (`SteadyTime`).
"""

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from ipaddress import ip_address, ip_network
from typing import Final

from msgspec import structs

from apps.evidence import ONE_HOST, Evidence, Kind
from apps.firewall.incidents.open_incident import (
    MOST_KEYS,
    AttackerKey,
    OpenIncident,
    incident_id,
    not_past,
    who,
)
from apps.incidents import MOST_PLACES, Change, Contribution, Incident, IncidentAction, Remedy
from apps.messages import Alert, Confirmation, Decision, Sender, one_line

SECOND: Final = 1_000_000_000
IDLE_S: Final = 600
"""What comes later than this after the last sign of an incident is another one."""
MOST_OPEN: Final = 4_096
MOST_QUIET: Final = 4_096
OPENINGS: Final = 50
"""Incidents that may open within a second, decisions not counted: an attacker with many names fills no archive."""
UPDATES: Final = 200
"""Updates of open incidents within a second."""
SUSPECT_SHARE: Final = 0.5
"""Share of its bound at which a sum makes an incident of a suspicion."""
FADED_SHARE: Final = 0.1
"""A suspicion whose older evidence has faded to this share of the sum starts over."""
SHARED_VICTIM: Final = ("flood", "guessing")
_REMEDIES: Final[dict[str, Remedy]] = {"block": "block", "protect": "guard", "meter": "meter"}
_KINDS: Final[tuple[tuple[str, Kind], ...]] = (
    ("sonata.syn_flood", "flood"),
    ("sonata.new_tcp", "flood"),
    ("sonata.tcp", "flood"),
    ("sonata.arp", "spoofing"),
    ("kitsune.", "unlike_training"),
)
"""Keys of exhibits, for decisions that come without evidence."""


class IncidentBook:
    """All incidents that are open, and suspicions that may become one.

    Args:
        idle_s: seconds without a sign of it after which an incident is over.
        most: incidents open at a time; the one idle for longest is closed first.
    """

    def __init__(self, *, idle_s: float = IDLE_S, most: int = MOST_OPEN) -> None:
        self._idle = round(idle_s * SECOND)
        self._most = most
        self._open: OrderedDict[str, OpenIncident] = OrderedDict()
        self._quiet: OrderedDict[str, OpenIncident] = OrderedDict()
        self._by_key: dict[AttackerKey, OpenIncident] = {}
        self._by_decision: dict[str, OpenIncident] = {}
        self._changed: OrderedDict[str, OpenIncident] = OrderedDict()
        """Open incidents with unpublished changes, the oldest change first."""
        self._closed: list[Incident] = []
        self._now = 0
        self._second = self._looked = 0
        self._openings = self._updates = 0
        self.left_out = 0
        """Openings put off because there were too many within a second."""

    def __len__(self) -> int:
        return len(self._open)

    @property
    def suspicions(self) -> int:
        """How many are kept that may become an incident."""
        return len(self._quiet)

    def has(self, decision: str) -> bool:
        """Whether a decision belongs to an incident that is not over."""
        return decision in self._by_decision

    # -- what happens --------------------------------------------------------------------------------

    def hear_evidence(self, evidence: Evidence, total_nats: float, bound: float) -> list[Incident]:
        """Take a piece of evidence that the sequential test has added up.

        Args:
            evidence: the piece.
            total_nats: sum against its sender (or for its victim, if it names no sender) with this piece.
            bound: what that sum must reach for a decision.

        Returns:
            Incidents to publish.
        """
        self._clock(evidence.event_time)
        suspect = total_nats >= SUSPECT_SHARE * bound
        mine, theirs = _about(evidence, suspect=suspect)
        found = self._same(mine, theirs)
        if found is not None and not found.shown and total_nats - evidence.nats < FADED_SHARE * total_nats:
            self._forget(found)
            found = None
        found = found or self._begin((*mine, *theirs), evidence.since, evidence.event_time)
        found.hear(evidence, mine or theirs, total_nats, bound)
        return self._heard(found, (*mine, *theirs), suspect=suspect)

    def hear_own(self, evidence: Evidence, share: float, bound: float) -> list[Incident]:
        """Take a piece of evidence on which the firewall acts without the sequential test.

        Args:
            evidence: the piece.
            share: what its source makes up of the sum, beside what the test has added up.
            bound: what that sum must reach for a decision.

        Returns:
            Incidents to publish.
        """
        now = self._clock(evidence.event_time)
        suspect = share >= SUSPECT_SHARE * bound
        mine, theirs = _about(evidence, suspect=suspect)
        # what earlier blocks are based on is no part of what happens now
        begun = now if evidence.kind == "offence" else evidence.since
        found = self._same(mine, theirs) or self._begin((*mine, *theirs), begun, evidence.event_time)
        found.hear_own(evidence, mine or theirs, share, bound)
        return self._heard(found, (*mine, *theirs), suspect=suspect)

    def _heard(self, found: OpenIncident, keys: Sequence[AttackerKey], *, suspect: bool) -> list[Incident]:
        self._know(found, keys)
        return self._told(found, "more", self._now, may_open=suspect)

    def hear_alert(self, alert: Alert) -> list[Incident]:
        """Take an alert: it opens an incident, whatever its weight is.

        Returns:
            Incidents to publish.
        """
        now = self._clock(alert.event_time)
        keys = keys_of(alert.sender, alert.mac_addresses, alert.role)
        begun = max(0, alert.event_time - SECOND)
        found = self._same(keys, ()) or self._begin(keys, begun, alert.event_time)
        found.blame(keys, alert.sender)
        found.last = max(found.last, alert.event_time)
        found.weigh("unlike_training", 0.0)
        found.count_packets("alert", alert.packets, alert.first_packet)
        piece = Contribution(
            source="alert",
            kind="unlike_training",
            packets=alert.packets,
            text=one_line(alert.reason),
            event_time=alert.event_time,
        )
        found.note(piece)
        self._know(found, keys)
        return self._told(found, "more", now, may_open=True)

    def decided(self, decision: Decision) -> list[Incident]:
        """Take a decision of the firewall: new, extended, or lifted.

        One that an operator or the settings made belongs to an incident that is there, but opens none.

        Returns:
            Incidents to publish.
        """
        now = self._clock(decision.event_time)
        known = self._by_decision.get(decision.id)
        if decision.action not in _REMEDIES:
            action = known.actions.get(decision.id) if known is not None else None
            if known is None or action is None:
                return self._due(now)
            reason = one_line(f"{action.reason}; {decision.reason}") if action.reason else decision.reason
            self._act(
                known, decision.id, structs.replace(action, state="over", until=now, reason=one_line(reason))
            )
            return self._told(known, "decided", now)
        found = known or self._target_of(decision) or self._of_decision(decision)
        if found is None:
            return self._due(now)
        self._act(found, decision.id, self._action_of(decision, found))
        found.decided = self._sum_of(decision, found)
        found.last = max(found.last, decision.event_time)
        if decision.first_packet:
            found.first_packet = min(found.first_packet or decision.first_packet, decision.first_packet)
        return self._told(found, "decided", now, may_open=True)

    def spared(self, evidence: Evidence, total_nats: float, bound: float, why: str) -> list[Incident]:
        """Take that the sum has reached its bound, and that an alert is all that may be done.

        Args:
            evidence: the piece that tipped the scales, which `hear_evidence` was given before.
            total_nats: the sum with it.
            bound: the bound.
            why: why nothing stronger is done, in words.

        Returns:
            Incidents to publish.
        """
        now = self._clock(evidence.event_time)
        mine = _accused(evidence)
        found = self._same([*mine, *(("victim", each) for each in evidence.victims)], ())
        if found is None:
            return self._due(now)
        sum_against = found.sums.get((mine or [("victim", *evidence.victims[:1])])[0]) or found.strongest()
        before = found.actions.get("alert")
        action = IncidentAction(
            remedy="alert",
            since=before.since if before else now,
            until=0,
            reason=one_line(why),
            target=who(evidence.sender)
            if evidence.sender
            else evidence.address or ", ".join(evidence.victims),
            nats=total_nats,
            bound=bound,
            contributions=sum_against.largest(),
        )
        self._act(found, "alert", action)
        found.decided = total_nats, bound
        news = before is None or before.reason != action.reason
        return self._told(found, "decided" if news else "more", now, may_open=True)

    def confirmed(self, confirmation: Confirmation, places: Sequence[str] = ()) -> list[Incident]:
        """Take what an enforcer says about a decision.

        Args:
            confirmation: the answer.
            places: where the decision is in force now.

        Returns:
            Incidents to publish.
        """
        found = self._by_decision.get(confirmation.id)
        if found is None:
            return []
        now, said = self._now, confirmation.event_time
        action = found.actions.get(confirmation.id)
        if action is None:
            return self._due(now)
        if confirmation.state in ("installed", "exists"):
            # a switch's wrong clock must not move everybody's
            effective = action.effective or (said if abs(said - now) < self._idle else now)
            after = structs.replace(action, state="in_force", effective=effective)
        elif confirmation.state == "failed":
            # one switch of several may refuse what others carry out
            after = action if action.state == "in_force" else structs.replace(action, state="failed")
        elif confirmation.state == "pending":
            after = action
        else:
            after = action if places else structs.replace(action, state="over")
        after = structs.replace(after, places=tuple(places[:MOST_PLACES]))
        if after == action:
            return self._due(now)
        self._act(found, confirmation.id, after)
        return self._told(found, "confirmed", now)

    def count(self, decision: str, packets: int, now: int) -> list[Incident]:
        """Take the counter of a decision at a switch: packets that it dropped, challenged or metered so far.

        Returns:
            Incidents to publish.
        """
        now = self._clock(now)
        found = self._by_decision.get(decision)
        action = found.actions.get(decision) if found is not None else None
        if found is None or action is None or packets <= action.packets:
            return self._due(now)
        self._act(found, decision, structs.replace(action, packets=packets))
        found.last = max(found.last, now)
        return self._told(found, "more", now)

    def lapse(self, now: int) -> list[Incident]:
        """Let time pass.

        Args:
            now: capture time.

        Returns:
            Incidents to publish: those that are over, and news that had to wait.
        """
        now = self._clock(now)
        if now < self._looked + SECOND:
            return self._due(now)
        self._looked = now
        for one in [each for each in self._open.values() if each.last <= now - self._idle]:
            if not one.remedied(now):
                self._close(one, now)
        for one in [each for each in self._quiet.values() if each.last <= now - self._idle]:
            self._forget(one)
        return self._due(now)

    def flush(self) -> list[Incident]:
        """Tell news that would have had to wait, because nothing more will come.

        Returns:
            Incidents to publish.
        """
        waiting, self._changed = list(self._changed.values()), OrderedDict()
        closed, self._closed = self._closed, []
        return [*closed, *(one.report("more", self._now) for one in waiting)]

    def restore(self, incidents: Iterable[Incident]) -> None:
        """Take up what was open before a restart.

        Args:
            incidents: as archived, in the order of writing.
        """
        last = {each.id: each for each in incidents}
        for one in [each for each in last.values() if each.state == "open"][-self._most :]:
            found = OpenIncident(one.id, one.begun, one.last, one.attacker, one.attacker_text, shown=True)
            found.attackers_before, found.published_at = one.attacker_count, one.event_time
            found.weigh(one.kind, 1.0)
            found.name_victims(one.victims, one.victim_count)
            found.services = {one.service} if one.service else set()
            found.count_packets("before the restart", one.packets, one.first_packet)
            found.peak, found.decided = one.peak_nats, (one.nats, one.bound)
            found.note(*one.evidence)
            for action in one.actions:
                self._act(found, action.decision or "alert", action)
            self._open[one.id] = found
            keys: list[AttackerKey] = keys_of(one.attacker, 1, "host") if one.attacker else []
            if one.attacker is None or one.kind in SHARED_VICTIM:
                keys += [("victim", victim) for victim in one.victims]
            self._know(found, keys)

    # -- which incident --------------------------------------------------------------------------------

    def _same(self, mine: Iterable[AttackerKey], theirs: Iterable[AttackerKey]) -> OpenIncident | None:
        """The incident of this attacker or of this victim; where they were two, they are one from now on."""
        mine = tuple(mine)
        # a decision that came without evidence is all that goes by the address alone
        alone: list[AttackerKey] = [("ip", key[2]) for key in mine if key[0] == "host" and key[2]]
        by_attacker = self._lookup((*mine, *alone))
        by_victim = self._lookup(theirs)
        if by_attacker is None or by_victim is None or by_attacker is by_victim:
            return by_attacker or by_victim
        older, younger = sorted((by_attacker, by_victim), key=lambda one: (not one.shown, one.begun, one.id))
        older.absorb(younger)
        keys = tuple(younger.keys)
        for decision in younger.actions:
            if decision in self._by_decision:
                self._by_decision[decision] = older
        if younger.shown:
            self._close(younger, self._now)
        else:
            self._forget(younger)
        self._know(older, keys)
        return older

    def _lookup(self, keys: Iterable[AttackerKey]) -> OpenIncident | None:
        """The incident of the first key that has one which is not long past."""
        for key in keys:
            found = self._by_key.get(key)
            if found is not None and (found.last > self._now - self._idle or found.remedied(self._now)):
                return found
        return None

    def _begin(self, keys: Iterable[AttackerKey], begun: int, last: int) -> OpenIncident:
        about = " ".join(next(iter(keys), ()))
        found = OpenIncident(incident_id(about, begun), begun, last)
        while len(self._quiet) >= MOST_QUIET:
            self._forget(next(iter(self._quiet.values())))
        for same in (self._quiet.get(found.id), self._open.get(found.id)):
            if same is not None:
                return same
        self._quiet[found.id] = found
        return found

    def _know(self, one: OpenIncident, keys: Iterable[AttackerKey]) -> None:
        for key in keys:
            if len(one.keys) >= MOST_KEYS:
                return
            owner = self._by_key.get(key)
            if owner is not None and owner is not one:
                if self._lookup((key,)) is owner:
                    continue
                owner.keys.discard(key)
            self._by_key[key] = one
            one.keys.add(key)

    def _target_of(self, decision: Decision) -> OpenIncident | None:
        """The incident that a decision without one yet is about, the one heard of last."""
        target = decision.target
        if decision.action == "block":
            fits = (
                one
                for one in self._newest()
                if any(_names(key, target.kind, target.address) for key in one.keys)
            )
        else:
            fits = (one for one in self._newest() if target.address in one.victims)
        return next(fits, None)

    def _newest(self) -> Iterator[OpenIncident]:
        yield from reversed(self._open.values())
        yield from reversed(self._quiet.values())

    def _of_decision(self, decision: Decision) -> OpenIncident | None:
        """A new incident for a decision that no evidence announced; None if people or the settings made it."""
        exhibits = [each for each in decision.evidence if not each.key.startswith("network.instruction.")]
        if not exhibits:
            return None
        address = decision.target.address
        against = decision.action == "block"
        key: AttackerKey = (decision.target.kind, address) if against else ("victim", address)
        found = self._begin((key,), decision.event_time, decision.event_time)
        if against:
            found.attacker_text = address
        else:
            found.name_victims((address,), 1)
        for exhibit in exhibits:
            kind = _kind_of(exhibit.key)
            found.weigh(kind, 1.0)
            source = exhibit.key.rpartition(".")[2]
            text = one_line(exhibit.summary)
            found.note(
                Contribution(source=source[:256], kind=kind, text=text, event_time=decision.event_time)
            )
        self._know(found, (key,))
        return found

    def _sum_of(self, decision: Decision, found: OpenIncident) -> tuple[float, float]:
        sums = found.sums
        target = decision.target
        for key in reversed(sums):
            if _names(key, target.kind, target.address) or key == ("victim", target.address):
                return sums[key].sum, sums[key].bound
        strongest = found.strongest()
        return strongest.sum, strongest.bound

    def _action_of(self, decision: Decision, found: OpenIncident) -> IncidentAction:
        before = found.actions.get(decision.id)
        if before is not None:
            return structs.replace(before, until=decision.expires, state=before.state)
        nats, bound = self._sum_of(decision, found)
        sums = [one for one in found.sums.values() if (one.sum, one.bound) == (nats, bound)]
        return IncidentAction(
            decision=decision.id,
            remedy=_REMEDIES[decision.action],
            dry_run=decision.dry_run,
            target=decision.what,
            switch=decision.switch,
            since=decision.event_time,
            until=decision.expires,
            reason=one_line(decision.reason),
            nats=nats,
            bound=bound,
            contributions=sums[0].largest() if sums else (),
        )

    def _act(self, one: OpenIncident, name: str, action: IncidentAction) -> None:
        for dropped in one.act(name, action):
            self._by_decision.pop(dropped, None)
        if action.decision:
            self._by_decision[name] = one

    # -- what is told ----------------------------------------------------------------------------------

    def _clock(self, at: int) -> int:
        self._now = max(self._now, at)
        if self._now // SECOND != self._second:
            self._second = self._now // SECOND
            self._openings = self._updates = 0
        return self._now

    def _told(self, one: OpenIncident, change: Change, now: int, *, may_open: bool = False) -> list[Incident]:
        """Publish at once what must not wait; anything else with the next update of the incident."""
        if not one.shown:
            return self._opened(one, change, now) if may_open else self._due(now)
        self._open.move_to_end(one.id)
        if change == "more":
            self._changed.setdefault(one.id, one)
            return self._due(now)
        self._changed.pop(one.id, None)
        one.published_at = now
        return [one.report(change, now), *self._due(now)]

    def _opened(self, one: OpenIncident, change: Change, now: int) -> list[Incident]:
        decided = change == "decided"
        if self._openings >= OPENINGS and not decided:
            self.left_out += 1
            return self._due(now)
        self._openings += 1
        while len(self._open) >= self._most:
            self._close(next(iter(self._open.values())), now)
        self._quiet.pop(one.id, None)
        self._open[one.id] = one
        one.shown, one.published_at = True, now
        return [*self._due(now), one.report("decided" if decided else "opened", now)]

    def _due(self, now: int) -> list[Incident]:
        """Incidents that closed, and news that has waited for long enough."""
        due, self._closed = self._closed, []
        while self._changed and self._updates < UPDATES:
            one = next(iter(self._changed.values()))
            if now < one.published_at + SECOND:
                break
            del self._changed[one.id]
            self._updates += 1
            one.published_at = now
            due.append(one.report("more", now))
        return due

    def _close(self, one: OpenIncident, now: int) -> None:
        for name, action in one.actions.items():
            if action.state in ("decided", "in_force") and not not_past(action, now):
                self._act(one, name, structs.replace(action, state="over"))
        self._closed.append(one.report("over", now))
        self._forget(one)

    def _forget(self, one: OpenIncident) -> None:
        for place in (self._open, self._quiet, self._changed):
            place.pop(one.id, None)
        for key in one.keys:
            if self._by_key.get(key) is one:
                del self._by_key[key]
        for decision in one.actions:
            if self._by_decision.get(decision) is one:
                del self._by_decision[decision]


def _about(evidence: Evidence, *, suspect: bool) -> tuple[list[AttackerKey], list[AttackerKey]]:
    """Keys of whom a piece of evidence accuses, and of the victims that its incident has in common with others."""
    mine = _accused(evidence)
    shared = not mine or (suspect and evidence.kind in SHARED_VICTIM)
    return mine, [("victim", victim) for victim in evidence.victims] if shared else []


def _accused(evidence: Evidence) -> list[AttackerKey]:
    """Keys of whom a piece of evidence accuses; none where it is about a victim."""
    if evidence.sender is not None:
        return keys_of(evidence.sender, evidence.mac_addresses, evidence.role)
    return [("ip", evidence.address)] if evidence.address else []


def keys_of(sender: Sender, mac_addresses: int, role: str) -> list[AttackerKey]:
    """The names under which an attacker is found again, the narrowest first.

    An address alone is none: somebody else may have forged it.
    """
    keys: list[AttackerKey] = [("host", sender.mac, sender.ip)]
    if not sender.ip or (mac_addresses <= ONE_HOST and role != "gateway"):
        keys.append(("mac", sender.mac))
    return keys


def _names(key: AttackerKey, kind: str, address: str) -> bool:
    """Whether a key of an attacker is what a decision's target matches."""
    if kind == "mac":
        return key[0] in ("host", "mac") and key[1] == address
    if key[0] not in ("host", "ip") or not key[-1]:
        return False
    return ip_address(key[-1]) in ip_network(address) if "/" in address else key[-1] == address


def _kind_of(key: str) -> Kind:
    """The kind of incident that an item under this key is a sign of."""
    for part, kind in _KINDS:
        if part in key:
            return kind
    return "other"
