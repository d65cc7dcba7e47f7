"""From evidence or alerts to what should be done: pure, no I/O, capture time only.

sequential   evidence of every source adds up until it crosses the bound of the budget (the default)
seconds      five anomalous seconds of ten (`rules.judge`)
paper        the first packet at or above Kitsune's threshold
"""

from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

from msgspec import structs

from apps.evidence import ONE_HOST, Evidence, TrainingState
from apps.firewall.arp.arp_bindings import ArpBindings, BoundHost
from apps.firewall.evidence.history import EarlierBlocks
from apps.firewall.evidence.offences import offence_evidence
from apps.firewall.policy.block_lifecycle import SECOND, BlockLifecycle
from apps.firewall.policy.rate_limits import limit_of, limit_words, scan_limit_of, usual_rate_of
from apps.firewall.policy.rules import AllowList, PolicyVerdict, Rules, judge, narrowest_target
from apps.firewall.policy.sequential_test import LEAST_BOUND, EvidenceSum, SequentialTest
from apps.firewall.syn.services import TcpService
from apps.messages import Alert, RateLimit, Sender, Target

OFFENCE_NATS: Final = 2.0
"""So much each earlier block adds to the sum ..."""
MOST_OFFENCES: Final = 3
"""... up to this many."""
PROBATION_SHARE: Final = 0.5
"""Share of the bound that is enough on probation."""
TELL_AGAIN_S: Final = 600
MOST_TOLD: Final = 16_384
_PARTS_SHOWN: Final = 3

Offences = Callable[[Target], EarlierBlocks | None]
"""Earlier blocks of a target; None if the archive does not answer."""
Services = Callable[[str], Collection[int] | None]
"""TCP ports of an address with a service; None if nobody can know them."""


@dataclass(frozen=True)
class Proposal:
    """What evidence calls for; one of `target`, `service`, `limit` and `refusal` is set."""

    evidence: Evidence
    reason: str
    target: Target | None = None
    """To be blocked."""
    service: TcpService | None = None
    """To be guarded."""
    limit: RateLimit | None = None
    """To be set towards the first victim of the evidence."""
    refusal: str = ""
    """Why nothing is done although the bound is crossed."""
    nats: float = 0.0
    bound: float = 0.0
    """What the sum had to reach: less than the bound of the test on probation."""
    offences: int | None = 0
    offence: Evidence | None = None
    """The earlier blocks that are a part of the sum; to be written."""
    tally: EvidenceSum | None = None


class Decider:
    """Applies one of the three rules.

    Args:
        rules: options.
        lifecycle: blocks in force and senders on probation.
        bindings: whose an address is.
        known: addresses known from handshakes.
        allow: the allow-list of now.
        services: of hosts, as far as they are known from handshakes.
    """

    def __init__(
        self,
        rules: Rules,
        lifecycle: BlockLifecycle,
        bindings: ArpBindings,
        known: Collection[str],
        allow: Callable[[], AllowList],
        services: Services = lambda _: None,
    ) -> None:
        self._rules = rules
        self._lifecycle = lifecycle
        self._bindings = bindings
        self._known = known
        self._allow = allow
        self._services = services
        self._told: OrderedDict[object, int] = OrderedDict()
        """When a refusal about a subject was last reported; the newest is the last."""
        self.test = SequentialTest(rules.false_blocks_per_day)

    def trained(self, state: TrainingState | None) -> None:
        """The state of training, in progress or done; None: there was no training."""
        self.test.training = state

    def alert(self, alert: Alert) -> PolicyVerdict:
        """The rule of seconds."""
        if self._rules.rule != "seconds":
            return PolicyVerdict(None, "alerts alone decide nothing under this rule")
        probation = self._lifecycle.on_probation(alert.sender, alert.event_time)
        verdict = judge(alert, self._rules, self._allow(), on_probation=probation)
        if verdict.target is None:
            return verdict
        target, refusal = self._unforged(verdict.target, alert.sender, forgeable=True)
        if target == verdict.target:
            return verdict
        return PolicyVerdict(target, f"{verdict.reason}; {refusal}" if target else refusal)

    def evidence(self, evidence: Evidence, app: str, offences: Offences) -> Proposal | None:
        """Add evidence; returns a proposal if a decision is due, or would be.

        Args:
            evidence: decoded, its time checked.
            app: who wrote it.
            offences: looks up earlier blocks; asked only when it can matter.
        """
        if self._rules.rule == "paper":
            return self._paper(evidence)
        tally = self.test.hear(evidence, app)
        now, bound = evidence.event_time, self.test.bound
        total = tally.total(now, bound)
        if self._rules.rule != "sequential" or total < min(LEAST_BOUND, PROBATION_SHARE * bound):
            return None
        if isinstance(tally.subject, Sender):
            return self._against(_latest(tally, evidence), tally.subject, tally, bound, offences)
        return self._towards(evidence, tally, total, bound) if total >= bound else None

    def sum_of(self, evidence: Evidence) -> tuple[float, float]:
        """The sum in nats for the subject of evidence that was heard, and the bound."""
        return self.test.sum_of(evidence), self.test.bound

    def settled(self, proposal: Proposal) -> None:
        """A decision was made: its evidence is spent."""
        if proposal.tally is not None:
            self.test.forget(proposal.tally.subject)

    def _paper(self, evidence: Evidence) -> Proposal | None:
        sender = evidence.sender
        if evidence.source != "threshold" or sender is None or self._lifecycle.covering(sender) is not None:
            return None
        target = narrowest_target(sender, evidence.mac_addresses)
        if target is None or self._allow().covers(sender) or evidence.role in self._rules.protected_roles:
            return None
        return Proposal(evidence, f"first packet at or above the threshold: {evidence.text}", target)

    def _against(
        self, evidence: Evidence, sender: Sender, tally: EvidenceSum, bound: float, offences: Offences
    ) -> Proposal | None:
        now = evidence.event_time
        if self._lifecycle.covering(sender) is not None:
            return None
        total = tally.total(now, bound)
        target = _target_of(evidence, sender)
        needed = bound
        earlier: EarlierBlocks | None = EarlierBlocks()
        if self._lifecycle.on_probation(sender, now):
            needed = max(LEAST_BOUND, PROBATION_SHARE * bound)
        if target is not None and needed - MOST_OFFENCES * OFFENCE_NATS <= total:
            earlier = offences(target)
        offence = _offence_of(evidence, target, earlier, needed)
        total += offence.nats if offence is not None else 0.0
        if total < needed:
            return None
        reason = _reason(tally, now, bound, total, needed, offence)
        target, refusal = self._chosen(evidence, sender, target)
        spared = self._allow().covers(sender)
        if target is None and not spared and self._may_be_planted(evidence, sender):
            remedy = self._for_the_victim(tally, f"{reason}; {refusal}", total, needed)
            if remedy is not None:
                return replace(remedy, offence=offence)
        if refusal and not self._news(sender, now):
            return None
        return Proposal(
            evidence,
            f"{reason}; {refusal}" if refusal else reason,
            target=target,
            refusal="" if target is not None else refusal,
            nats=total,
            bound=needed,
            offences=None if earlier is None else earlier.times,
            offence=offence,
            tally=tally,
        )

    def _chosen(self, evidence: Evidence, sender: Sender, target: Target | None) -> tuple[Target | None, str]:
        """The target to block, and what is to be said about the choice."""
        if self._allow().covers(sender):
            return None, "the sender is on the allow-list"
        if evidence.role in self._rules.protected_roles and not _is_anothers(evidence):
            return None, f"the sender is a {evidence.role}: it is reported but not blocked"
        if self.test.too_short:
            return None, "training is too short for the budget of false blocks: nobody is blocked"
        if evidence.forged and evidence.routed:
            return (
                None,
                f"{sender.ip} belongs to another host, and anybody behind {sender.mac} could have forged it",
            )
        if target is None:
            behind = f"{evidence.mac_addresses} addresses are behind {sender.mac}"
            return None, f"{behind}, and the frames carry no address"
        if target.kind == "ip" and evidence.training_rate > 0 and evidence.forgeable:
            return None, f"{target.address} is known from training, and anybody could have forged it"
        if self._may_be_planted(evidence, sender) and not self._rules.block_unproven_addresses:
            why = f"{target.address} is behind a router and has completed no handshake"
            return None, f"{why}, so anybody could have forged it"
        return self._unforged(target, sender, forgeable=evidence.forgeable, routed=evidence.routed)

    def _unforged(
        self, target: Target, sender: Sender, *, forgeable: bool, routed: bool = False
    ) -> tuple[Target | None, str]:
        """An address that others can forge is not blocked; the forger is, if it is known for certain."""
        if target.kind != "ip":
            return target, ""
        host = BoundHost.of(sender.port, sender.mac)
        if self._bindings.forged(target.address, host):
            if self._bindings.is_alone(host) and not routed:
                forger = Target(kind="mac", address=sender.mac, port=sender.port)
                return forger, f"{target.address} belongs to another host, so its forger is blocked"
            where = f"is behind {sender.mac}" if routed else "shares a port"
            return None, f"{target.address} belongs to another host, and its forger {where}"
        if forgeable and target.address in self._known and not self._rules.block_known_addresses:
            return None, f"{target.address} is known from handshakes and may be forged"
        return target, ""

    @staticmethod
    def _may_be_planted(evidence: Evidence, sender: Sender) -> bool:
        """Whether a third party could have sent all this under the address of a sender behind a router."""
        if not sender.ip or not evidence.forgeable or evidence.kind == "spoofing":
            return False
        return evidence.routed or (evidence.mac_addresses > ONE_HOST and not evidence.forged)

    def _for_the_victim(
        self, tally: EvidenceSum, reason: str, total: float, needed: float
    ) -> Proposal | None:
        """A guard or rate limit against what a sender that cannot be blocked floods its victim with, or scans it by."""
        strongest = max(tally.contributions.values(), key=lambda each: each.nats).latest
        if not strongest.victims:
            return None
        if strongest.kind == "scan":
            return self._against_scan(strongest, tally, reason, total, needed)
        if strongest.kind != "flood" or not strongest.service:
            return None
        return self._remedy(strongest, [strongest], reason, tally, total, needed)

    def _against_scan(
        self, scan: Evidence, tally: EvidenceSum, reason: str, total: float, needed: float
    ) -> Proposal | None:
        """A rate limit of SYNs to the ports where the victim has no service: it harms nobody, whoever scans."""
        victim = scan.victims[0]
        sent = [each.latest for each in tally.contributions.values() if victim in each.latest.victims]
        if not any(each.service.startswith("tcp/") for each in sent):
            return None
        ports = self._services(victim)
        limit = None if ports is None else scan_limit_of(tuple(ports))
        if limit is None:
            return None
        reason = f"{reason}; limited: {limit.words} to {limit.rate:,} packets/s"
        return Proposal(scan, reason, limit=limit, nats=total, bound=needed, tally=tally)

    def _towards(self, evidence: Evidence, tally: EvidenceSum, total: float, bound: float) -> Proposal | None:
        """A victim of senders that cannot be told apart, or whose addresses are forged."""
        now = evidence.event_time
        reason = _reason(tally, now, bound, total, bound)
        if evidence.address:
            refusal = (
                f"it is not known on which port {evidence.address} is, nor whether the address is its own"
            )
            return self._refused(evidence, reason, refusal, tally, total, bound)
        pieces = [each.latest for each in tally.contributions.values()]
        remedy = self._remedy(evidence, pieces, reason, tally, total, bound)
        if remedy is not None:
            return remedy
        refusal = f"there is no remedy for floods of {evidence.service or 'this kind'} from forged addresses"
        return self._refused(evidence, reason, refusal, tally, total, bound)

    @staticmethod
    def _remedy(
        evidence: Evidence,
        pieces: Sequence[Evidence],
        reason: str,
        tally: EvidenceSum,
        total: float,
        bound: float,
    ) -> Proposal | None:
        """A guard of the service that evidence names, or a rate limit of its packets; None if neither fits."""
        protocol, _, port = evidence.service.partition("/")
        if protocol == "tcp" and port.isdecimal():
            service = TcpService(evidence.victims[0], int(port))
            return Proposal(evidence, reason, service=service, nats=total, bound=bound, tally=tally)
        limit = limit_of(pieces)
        if limit is None:
            return None
        reason = f"{reason}; {limit_words(limit, max(map(usual_rate_of, pieces)))}"
        return Proposal(evidence, reason, limit=limit, nats=total, bound=bound, tally=tally)

    def _refused(
        self, evidence: Evidence, reason: str, refusal: str, tally: EvidenceSum, total: float, bound: float
    ) -> Proposal | None:
        """A proposal to do nothing; None if the same was reported recently."""
        if not self._news(tally.subject, evidence.event_time):
            return None
        text = f"{reason}; {refusal}"
        return Proposal(evidence, text, refusal=refusal, nats=total, bound=bound, tally=tally)

    def _news(self, subject: object, now: int) -> bool:
        """Whether no refusal about this subject was reported recently."""
        last = self._told.get(subject)
        # a clock that was ahead may have been set back since
        if last is not None and abs(now - last) < TELL_AGAIN_S * SECOND:
            return False
        self._told[subject] = now
        self._told.move_to_end(subject)
        while (
            len(self._told) > MOST_TOLD or abs(now - next(iter(self._told.values()))) > TELL_AGAIN_S * SECOND
        ):
            self._told.popitem(last=False)
        return True


def _latest(tally: EvidenceSum, evidence: Evidence) -> Evidence:
    """The evidence itself, or, if it names an address only, with what others know of the sender."""
    if evidence.sender is not None:
        return evidence
    known = [each.latest for each in tally.contributions.values() if each.latest.sender is not None]
    if not known:
        return structs.replace(evidence, sender=tally.subject, address="")
    newest = max(known, key=lambda each: each.event_time)
    return structs.replace(newest, event_time=evidence.event_time, text=evidence.text)


def _is_anothers(evidence: Evidence) -> bool:
    """Whether the role is that of the address's owner, whom the sender imitates.

    Who takes over the address of a gateway or server may be its standby.
    """
    return evidence.role == "multicast" and evidence.forged and not evidence.routed


def _target_of(evidence: Evidence, sender: Sender) -> Target | None:
    """What a block would match."""
    if evidence.forged or evidence.kind == "spoofing":  # the address is not the sender's own
        return Target(kind="mac", address=sender.mac, port=sender.port)
    return narrowest_target(sender, evidence.mac_addresses)


def _offence_of(
    evidence: Evidence, target: Target | None, earlier: EarlierBlocks | None, needed: float
) -> Evidence | None:
    """Earlier blocks as evidence: `LEAST_BOUND` of what is needed must come from what was seen now."""
    if target is None or earlier is None or not earlier.times:
        return None
    nats = min(OFFENCE_NATS * min(earlier.times, MOST_OFFENCES), needed - LEAST_BOUND)
    return offence_evidence(evidence, target, earlier, nats)


def _reason(
    tally: EvidenceSum,
    now: int,
    bound: float,
    total: float,
    needed: float,
    offence: Evidence | None = None,
) -> str:
    shares = [(nats, each) for nats, each in tally.shares(now, bound) if nats > 0]
    parts = [f"{each.latest.text} ({nats:.1f})" for nats, each in shares[:_PARTS_SHOWN]]
    before = ""
    if offence is not None:
        # on probation so little is needed that the past has nothing left to add
        before = (
            f", {offence.nats:.1f} of it because {offence.text}"
            if offence.nats >= 0.05
            else f", and {offence.text}"
        )
    return f"evidence of {total:.1f} nats, {needed:.1f} needed{before}: " + "; ".join(parts)
