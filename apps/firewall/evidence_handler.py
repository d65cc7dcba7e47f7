"""Alerts and evidence → decisions: asks the decider, looks up history, carries out what is due, reports the rest."""

from collections.abc import Callable, Sequence
from typing import Final

from msgspec import structs

from apps.evidence import Evidence, TrainingState
from apps.firewall.arrivals import evidence_of
from apps.firewall.enforcement.announcer import Announcer
from apps.firewall.evidence import history
from apps.firewall.evidence.archive import OFFENCES_READ, Archive
from apps.firewall.evidence.exhibits import Exhibits
from apps.firewall.evidence.history import EarlierBlocks
from apps.firewall.evidence.offences import offence_evidence
from apps.firewall.evidence.own_evidence import OwnEvidence
from apps.firewall.evidence.shared import shared_sender
from apps.firewall.incidents.incident_reports import IncidentReports
from apps.firewall.policy.block_lifecycle import BlockLifecycle, OperatorNotice
from apps.firewall.policy.decider import Decider, Proposal
from apps.firewall.policy.false_alarms import FalseAlarms
from apps.firewall.policy.prefix_aggregation import gather_blocks
from apps.firewall.policy.rate_limits import RateLimits
from apps.firewall.syn.syn_defence import UNKNOWN_HISTORY, SynDefence
from apps.messages import Alert, Decision, FalseAlarm, Ground, Target
from due import Item

TARGETS_KEPT: Final = 1_000
OFFENCES_HOLD_S: Final = 10.0
"""Seconds for which the archived blocks of a target are not asked for again."""


class EvidenceHandler:
    """What the service does with alerts and evidence; it holds the lock meanwhile.

    Args:
        decider: the rule.
        lifecycle: blocks in force.
        syn: guards.
        limits: rate limits in force.
        archive: earlier offences.
        announcer: notices.
        incidents: what belongs together.
        own: writes earlier offences.
        lessons: what was called a false alarm.
        publish: writes a decision.
        clock: monotonic time, seconds.
    """

    def __init__(
        self,
        decider: Decider,
        lifecycle: BlockLifecycle,
        syn: SynDefence,
        limits: RateLimits,
        archive: Archive,
        announcer: Announcer,
        incidents: IncidentReports,
        own: OwnEvidence,
        lessons: FalseAlarms,
        publish: Callable[[Decision], Decision],
        clock: Callable[[], float],
    ) -> None:
        self.decider = decider
        self._lifecycle = lifecycle
        self._syn = syn
        self._limits = limits
        self._archive = archive
        self._announcer = announcer
        self._incidents = incidents
        self._own = own
        self._lessons = lessons
        self._publish = publish
        self._clock = clock
        self._earlier: dict[Target, tuple[float, list[Item]]] = {}
        """Archived blocks by target, and when they were read."""
        self._exhibits = Exhibits()

    def trained(self, state: TrainingState | None) -> None:
        """The state of training, in progress or done; None: there was none."""
        self.decider.trained(state)
        self._lifecycle.trained_hosts = 0 if state is None else state.hosts

    def alert(self, item: Item, alert: Alert) -> None:
        """A sender had an anomalous second."""
        alert = structs.replace(alert, sender=shared_sender(alert.sender))
        self._incidents.alert(alert)
        self._exhibits.add(alert.sender, evidence_of(item, alert.reason), alert.event_time)
        if self._lifecycle.covering(alert.sender) is not None:
            return
        verdict = self.decider.alert(alert)
        if verdict.target is None:
            return
        earlier = self._offences_of(verdict.target, alert.event_time)
        reason = verdict.reason if earlier is not None else f"{verdict.reason} ({UNKNOWN_HISTORY})"
        earlier = earlier or EarlierBlocks()
        offence = offence_evidence(alert, verdict.target, earlier) if earlier.times else None
        self._block(alert, verdict.target, reason, earlier.times, offence)

    def evidence(self, item: Item, evidence: Evidence) -> None:
        """There is evidence against a sender, or for protecting a victim."""
        if evidence.sender is not None:
            sender = shared_sender(evidence.sender)
            evidence = structs.replace(evidence, sender=sender)
            self._exhibits.add(sender, evidence_of(item, evidence.text), evidence.event_time)
        at = evidence.event_time
        placed = self._lessons.weighed(self.decider.test.placed(evidence), item.app_id)
        self._lessons.note(placed, item.app_id)
        changes = {name: getattr(placed, name) for name in ("nats", "supporting", "source", "text")}
        evidence = structs.replace(evidence, **changes)
        proposal = self.decider.evidence(evidence, item.app_id, lambda target: self._offences_of(target, at))
        if evidence.nats > 0:
            nats, bound = self.decider.sum_of(evidence)
            bound = (proposal.bound if proposal is not None else 0.0) or bound
            self._incidents.evidence(self.decider.test.placed(evidence), nats, bound)
        if proposal is not None:
            self._follow(proposal, item)

    def learnt(self, lesson: FalseAlarm) -> None:
        """Forget what was added up meanwhile against those whom a lesson is about: it had its full weight."""
        for ground in lesson.grounds if not lesson.revoked else ():
            subject = ground.sender or (ground.victim, ground.service)
            self.decider.test.forget(subject)
            self._lessons.book.take(subject, lesson.event_time)

    def _follow(self, proposal: Proposal, item: Item) -> None:
        """Carry a proposal out, or report why it is not."""
        evidence = proposal.evidence
        if proposal.offence is not None and proposal.target is None:
            self._own.tell(proposal.offence, proposal.bound)
        if proposal.service is not None:
            exhibits = (evidence_of(item, evidence.text),)
            for decision in self._syn.guard(proposal.service, proposal.reason, exhibits, evidence.event_time):
                self._publish(structs.replace(decision, grounds=self._grounds_of(proposal)))
            self.decider.settled(proposal)
        elif proposal.limit is not None:
            exhibits, victim = (evidence_of(item, evidence.text),), evidence.victims[0]
            grounds = self._grounds_of(proposal)
            for decision in self._limits.open(victim, proposal.limit, proposal.reason, exhibits, evidence):
                self._publish(structs.replace(decision, grounds=grounds))
            self.decider.settled(proposal)
        elif proposal.target is None or evidence.sender is None:
            self._announcer.say(OperatorNotice("refused", proposal.reason, evidence.event_time))
            self._incidents.spared(evidence, proposal.nats, proposal.bound, proposal.refusal)
        else:
            unknown = "" if proposal.offences is not None else f" ({UNKNOWN_HISTORY})"
            reason, offences = proposal.reason + unknown, proposal.offences or 0
            self._block(evidence, proposal.target, reason, offences, proposal.offence, proposal.bound)
            self.decider.settled(proposal)

    def _grounds_of(self, proposal: Proposal) -> tuple[Ground, ...]:
        if proposal.tally is None:
            return ()
        return self._lessons.book.take(proposal.tally.subject, proposal.evidence.event_time)

    def _block(
        self,
        cause: Alert | Evidence,
        target: Target,
        reason: str,
        offences: int,
        offence: Evidence | None,
        bound: float = 0.0,
    ) -> None:
        """Block a sender, unless a cap forbids it."""
        sender = cause.sender
        assert sender is not None  # noqa: S101 - callers have a sender
        cap = self._lifecycle.cap_reached(cause.event_time, sender.ip)
        if cap is not None:
            self._lifecycle.refuse(cap, sender.ip or sender.mac, cause.event_time)
            return
        if offence is not None:
            self._own.tell(offence, bound)
        decision = self._lifecycle.open(
            sender.switch,
            target,
            reason,
            self._exhibits.of(sender),
            cause.event_time,
            offences=offences,
            first_packet=cause.first_packet,
            training_rate=cause.training_rate,
            host=sender.ip,
        )
        grounds = self._lessons.book.take(sender, cause.event_time) if isinstance(cause, Evidence) else ()
        self._publish(structs.replace(decision, grounds=grounds))
        for each in gather_blocks(self._lifecycle, self._syn.gather, cause.event_time):
            self._publish(each)

    def _offences_of(self, target: Target, now: int) -> EarlierBlocks | None:
        """Earlier blocks of a target; None if the archive does not answer."""
        earlier = self._earlier_blocks(target)
        return None if earlier is None else history.earlier_blocks(earlier, target, now, self._lessons)

    def decided(self) -> None:
        """A decision was published: the archive knows more than was read."""
        self._earlier.clear()

    def _earlier_blocks(self, target: Target) -> list[Item] | None:
        """Evidence about one sender comes many times a second, and a query would hold each piece up."""
        now = self._clock()
        read_at, found = self._earlier.get(target, (float("-inf"), []))
        if now - read_at < OFFENCES_HOLD_S:
            return found
        asked = self._archive.find(history.offences_query(target), most=OFFENCES_READ)
        if asked is not None:
            if len(self._earlier) >= TARGETS_KEPT:
                self._earlier.clear()
            self._earlier[target] = now, asked
        return asked

    def offences_of_many(self, addresses: Sequence[str], now: int) -> dict[str, EarlierBlocks] | None:
        """Earlier blocks by address; None if the archive does not answer."""
        if not addresses:
            return {}
        query = history.offences_of_many(addresses)
        items = self._archive.find(query, most=OFFENCES_READ * len(addresses))
        if items is None:
            return None
        targets = {address: Target(kind="ip", address=address) for address in addresses}
        return {
            address: history.earlier_blocks(items, target, now, self._lessons)
            for address, target in targets.items()
        }
