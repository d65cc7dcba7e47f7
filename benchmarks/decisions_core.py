"""Detector and decisions alone, without switch, DUE or archive: what a pipeline would decide about traffic.

    Traffic ─► what blocks leave of it ─► Detector ─► Evidence, Alert ─► Decider ─► blocks, guards, rate limits
                      ▲──────────────────────────────────────────────────────┘

A decision is in force for the next rows; within a batch it comes too late, as in a switch.
"""

import ipaddress
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from apps.evidence import Evidence, TrainingState
from apps.firewall.arp.arp_bindings import ArpBindings
from apps.firewall.evidence.history import EarlierBlocks
from apps.firewall.policy.block_lifecycle import BlockLifecycle
from apps.firewall.policy.decider import Decider
from apps.firewall.policy.rate_limits import RateLimits
from apps.firewall.policy.rules import AllowList, Rules
from apps.firewall.syn.services import TcpService
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import load_kernel
from apps.messages import Alert, Decision, Sender, Target
from benchmarks.decision_blocks import ModelledBlocks
from benchmarks.decision_jobs import Jobs
from benchmarks.decision_limits import ModelledLimits
from benchmarks.decision_services import Services
from benchmarks.decision_traffic.traffic import Traffic
from due import RecordBatch

SWITCH: Final = "s1"
ROWS: Final = 128
"""Packets between two looks at decisions."""
MANY_ROWS: Final = 4_096
"""The same where no decision can stop anything: in training, and where several runs watch one detector."""

Then = Callable[[Sequence["DecisionRun"]], dict[str, Any]]
"""What follows when runs were fed: figures by rule."""


@dataclass(frozen=True)
class DecidedAction:
    """One block, guard or rate limit."""

    time_ns: int
    reason: str
    target: Target | None = None
    service: TcpService | None = None
    limited: str = ""
    """Whose packets are limited."""


class EvidenceHeard(NamedTuple):
    """Whom a piece of evidence was about, and the sum that it made."""

    time_ns: int
    sender: Sender | None
    victims: tuple[str, ...]
    nats: float


@dataclass(eq=False)
class DecisionRun:
    """One network under one rule; `feed` it in order of time.

    Args:
        training_packets: packets of training.
        rules: the firewall's options.
        shared: a detector that several runs listen to (`watch`, `feed_apart`).
        services: TCP ports by address, as known from handshakes.
    """

    training_packets: int
    rules: Rules
    shared: Detector | None = None
    services: Services = field(default_factory=dict)
    decided: list[DecidedAction] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    heard: list[EvidenceHeard] = field(default_factory=list)
    """Of the last `feed`."""
    stopped: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """Which packets of the last `feed` were dropped, or are SYNs that were challenged."""
    challenges: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """Which packets of the last `feed` were challenged; they are among the stopped."""
    limited: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """Which packets of the last `feed` were over a rate limit."""
    scores: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Kitsune's scores of the packets of the last `feed`; 0 for those that were dropped."""

    def __post_init__(self) -> None:
        self.detector = self.shared or detector_for(self.training_packets)
        self._lifecycle = BlockLifecycle(self.rules)
        # capture times of generated traffic: ARP claims are weighed by the detector
        bindings = ArpBindings(training_s=0, settle_s=3_600, contest_s=60)
        self.decider = Decider(self.rules, self._lifecycle, bindings, (), AllowList, self._ports_of)
        self._told = False
        self._untold: list[Decision] = []
        """Decisions that the detector does not know of."""
        self._blocks = ModelledBlocks()
        self._guarded: set[TcpService] = set()
        self._limits, self._meters = RateLimits(self.rules), ModelledLimits()

    def feed(self, traffic: Traffic) -> npt.NDArray[np.bool_]:
        """Take traffic; returns which of its packets were stopped (dropped, or SYNs that were challenged)."""
        self.begin(len(traffic))
        start = 0
        while start < len(traffic):
            start = _step([self], traffic, start)
        return self.stopped

    @property
    def drops(self) -> bool:
        """Whether packets are dropped now, so that the detector sees what other runs do not have it see."""
        return bool(self._lifecycle.blocks or self._limits.standing)

    def begin(self, packets: int) -> None:
        """So many packets are going to come."""
        self.stopped, self.challenges, self.limited = (np.zeros(packets, bool) for _ in range(3))
        self.scores = np.zeros(packets)
        self.heard = []

    def pass_on(self, columns: Mapping[str, Any], part: slice) -> npt.NDArray[np.bool_]:
        """Which of the next packets come through; `part` is their place in the traffic."""
        drops = self._blocks.drops(columns)
        over = self._meters.over(columns, drops)
        drops |= over
        challenges = self._challenges(columns) & ~drops
        self.limited[part], self.challenges[part], self.stopped[part] = over, challenges, drops | challenges
        return ~drops

    def enforce(self) -> None:
        """Tell the detector, which is this run's alone, what was decided."""
        for decision in self._untold:
            self.detector.senders.blocked.decide(decision)
        self._untold.clear()

    def judge(self, alerts: Sequence[Alert], heard: Sequence[Evidence], now: int) -> None:
        """Decide about what the detector has said until a capture time, ns."""
        if not self._told and self.detector.model.is_trained:
            self._told = True
            behaviour = self.detector.behaviour
            self.decider.trained(
                TrainingState(
                    packets=self.training_packets,
                    wanted=self.training_packets,
                    done=True,
                    seconds=behaviour.seconds,
                    senders=len(behaviour.senders),
                    event_time=0,
                )
            )
        for decision in self._lifecycle.due(now):
            self._carry_out(decision)
        for name, packets in self._meters.counters().items():
            self._limits.count_drops(name, packets, now)
        self._meters.decide(self._limits.due(now))
        for alert in alerts:
            if self._lifecycle.covering(alert.sender) is None:
                verdict = self.decider.alert(alert)
                if verdict.target is not None:
                    self._block(alert, verdict.target, verdict.reason)
        for evidence in heard:
            self._hear(evidence)

    def _carry_out(self, decision: Decision) -> None:
        self._blocks.decide(decision)
        self._untold.append(decision)

    def _hear(self, evidence: Evidence) -> None:
        proposal = self.decider.evidence(evidence, "kitsune", lambda _: EarlierBlocks())
        nats, _ = self.decider.sum_of(evidence)
        self.heard.append(EvidenceHeard(evidence.event_time, evidence.sender, evidence.victims, nats))
        if proposal is None:
            return
        if proposal.service is not None:
            if proposal.service not in self._guarded:
                self._guarded.add(proposal.service)
                self.decided.append(
                    DecidedAction(evidence.event_time, proposal.reason, service=proposal.service)
                )
            self.decider.settled(proposal)
        elif proposal.limit is not None:
            victim = proposal.evidence.victims[0]
            made = self._limits.open(victim, proposal.limit, proposal.reason, (), evidence)
            self._meters.decide(made)
            self.decided += [
                DecidedAction(evidence.event_time, each.reason, limited=victim)
                for each in made
                if each.action == "meter"
            ]
            self.decider.settled(proposal)
        elif proposal.target is not None:
            self._block(evidence, proposal.target, proposal.reason)
            self.decider.settled(proposal)
        else:
            self.refused.append(proposal.reason)

    def _ports_of(self, address: str) -> tuple[int, ...] | None:
        return tuple(self.services.get(address, ())) if self.services else None

    def _block(self, cause: Alert | Evidence, target: Target, reason: str) -> None:
        host = "" if cause.sender is None else cause.sender.ip
        decision = self._lifecycle.open(
            SWITCH, target, reason, (), cause.event_time, training_rate=cause.training_rate, host=host
        )
        self._carry_out(decision)
        self.decided.append(DecidedAction(cause.event_time, reason, target=target))

    def _challenges(self, columns: Mapping[str, Any]) -> npt.NDArray[np.bool_]:
        challenges = np.zeros(len(columns["port"]), bool)
        for service in self._guarded:
            address = ipaddress.ip_address(service.address)
            if address.version == 4:
                challenges |= (
                    (columns["ip_dst_lo"] == int(address))
                    & (columns["tcp_dport"] == service.port)
                    & (columns["tcp_flags"] & 0x12 == 0x02)
                )
        return challenges


def detector_for(training_packets: int) -> Detector:
    """Kitsune with a training of so many packets."""
    map_packets = max(training_packets // 11, 1)
    settings = DetectorSettings(fm_grace=map_packets, ad_grace=training_packets - map_packets - 1)
    return Detector(settings, kernel=load_kernel())


def watch(runs: Sequence[DecisionRun], traffic: Traffic) -> None:
    """Feed the detector that runs share, and ask each; as with blocking, as long as nobody is blocked."""
    detector = runs[0].detector
    for start in range(0, len(traffic), MANY_ROWS):
        columns = {name: column[start : start + MANY_ROWS] for name, column in traffic.columns.items()}
        _, alerts = detector.process(RecordBatch(columns), SWITCH)
        heard = detector.take_evidence()
        for run in runs:
            run.begin(0)
            run.judge(alerts, heard, int(columns["time_us"][-1]) * 1_000)


def feed_apart(
    runs: Sequence[DecisionRun], traffic: Traffic, jobs: Jobs, then: Then, start: int = 0
) -> dict[str, Any]:
    """Feed runs that share a detector, each as if it were alone: who drops packets goes on in a copy of this process.

    Args:
        runs: one for each rule.
        traffic: what they are fed.
        jobs: for copies.
        then: called at the end, in this process or a copy, for the runs that still share a detector there.
        start: packets of the traffic that they have had.

    Returns:
        What `then` returned, of all.
    """
    together, apart = list(runs), []
    if not start:
        for run in together:
            run.begin(len(traffic))
    while start < len(traffic):
        for run in [each for each in together if each.drops]:
            if len(together) > 1:
                together.remove(run)
                apart.append(jobs.start(partial(feed_apart, [run], traffic, jobs, then, start)))
        start = _step(together, traffic, start)
    found = then(together)
    for more in jobs.collect(apart):
        found |= more
    return found


def _step(runs: Sequence[DecisionRun], traffic: Traffic, start: int) -> int:
    """Feed the next packets; returns how many have been fed then."""
    first = runs[0]
    detector = first.detector
    learning = first.training_packets - detector.trained
    part = slice(start, min(len(traffic), start + (min(MANY_ROWS, learning) if learning > 0 else ROWS)))
    columns = {name: column[part] for name, column in traffic.columns.items()}
    if len(runs) == 1:
        first.enforce()
    left = np.logical_and.reduce([run.pass_on(columns, part) for run in runs])
    if not left.any():
        return part.stop
    rows = columns if left.all() else {name: column[left] for name, column in columns.items()}
    scored, alerts = detector.process(RecordBatch(rows), SWITCH)
    heard = detector.take_evidence()
    for run in runs:
        run.scores[part][left] = scored.scores
        run.judge(alerts, heard, int(rows["time_us"][-1]) * 1_000)
    return part.stop
