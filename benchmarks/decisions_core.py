"""Detector and decisions alone, without switch, DUE or archive: what a pipeline would decide about traffic.

    Traffic ─► what blocks leave of it ─► Detector ─► Evidence, Alert ─► Decider ─► blocks, guards, rate limits
                      ▲──────────────────────────────────────────────────────┘

A decision is in force for the next rows; within a batch it comes too late, as in a switch.
"""

import ipaddress
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from apps.evidence import Evidence, TrainingState
from apps.firewall.arp.arp_bindings import ArpBindings
from apps.firewall.policy.block_lifecycle import BlockLifecycle
from apps.firewall.policy.decider import Decider
from apps.firewall.policy.rate_limits import RateLimits
from apps.firewall.policy.rules import AllowList, Rules
from apps.firewall.syn.services import TcpService
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kernel import load_kernel
from apps.messages import Alert, Decision, Target
from benchmarks.decision_limits import ModelledLimits
from benchmarks.decision_traffic.traffic import Traffic
from due import RecordBatch

SWITCH: Final = "s1"
ROWS: Final = 128
"""Packets between two looks at decisions."""
MANY_ROWS: Final = 4_096
"""The same where no decision can stop anything: in training, and where several runs watch one detector."""


@dataclass(frozen=True)
class DecidedAction:
    """One block, guard or rate limit."""

    time_ns: int
    reason: str
    target: Target | None = None
    service: TcpService | None = None
    limited: str = ""
    """Whose packets are limited."""


@dataclass
class DecisionRun:
    """One network under one rule; `feed` it in order of time.

    Args:
        training_packets: packets of training.
        rules: the firewall's options.
        watched: a detector that several runs share; then decisions are made, but nothing is stopped.
    """

    training_packets: int
    rules: Rules
    watched: Detector | None = None
    decided: list[DecidedAction] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    dropped: int = 0
    challenged: int = 0
    challenges: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """Which packets of the last `feed` were challenged; they are among the stopped."""
    limited: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """Which packets of the last `feed` were over a rate limit."""
    scores: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Kitsune's scores of the packets of the last `feed`; 0 for those that were dropped."""

    def __post_init__(self) -> None:
        self.detector = self.watched or detector_for(self.training_packets)
        self.decide_by(self.rules)

    def decide_by(self, rules: Rules) -> None:
        """Go on with other rules, as if they had been there from the start of training."""
        self.rules = rules
        self._ledger = BlockLifecycle(self.rules)
        # capture times of generated traffic: ARP claims are weighed by the detector
        bindings = ArpBindings(training_s=0, settle_s=3_600, contest_s=60)
        self.decider = Decider(self.rules, self._ledger, bindings, (), AllowList)
        self._told = False
        self._guarded: set[TcpService] = set()
        self._limits, self._meters = RateLimits(self.rules), ModelledLimits()

    def feed(self, traffic: Traffic) -> npt.NDArray[np.bool_]:
        """Take traffic; returns which of its packets were stopped (dropped, or SYNs that were challenged)."""
        stopped = np.zeros(len(traffic), bool)
        self.challenges = np.zeros(len(traffic), bool)
        self.limited = np.zeros(len(traffic), bool)
        self.scores = np.zeros(len(traffic))
        start = 0
        while start < len(traffic):
            learning = self.training_packets - self.detector.trained
            part = slice(start, start + (min(MANY_ROWS, learning) if learning > 0 else ROWS))
            start = part.stop
            columns = {name: column[part] for name, column in traffic.columns.items()}
            drops = self._drops(columns)
            over = self._meters.over(columns, drops)
            self.limited[part] = over
            drops |= over
            challenges = self._challenges(columns) & ~drops
            stopped[part] = drops | challenges
            self.challenges[part] = challenges
            self.dropped += int(drops.sum())
            self.challenged += int(challenges.sum())
            left = ~drops
            if left.any():
                rows = columns if left.all() else {name: column[left] for name, column in columns.items()}
                self.scores[part][left] = self._look(rows)
        return stopped

    def _look(self, columns: Mapping[str, Any]) -> npt.NDArray[np.float64]:
        """Take rows; returns their scores."""
        scored, alerts = self.detector.process(RecordBatch(dict(columns)), SWITCH)
        self.judge(alerts, self.detector.take_evidence(), int(columns["time_us"][-1]) * 1_000)
        return scored.scores

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
        for decision in self._ledger.due(now):
            self._tell(decision)
        for name, packets in self._meters.counters().items():
            self._limits.count_drops(name, packets, now)
        self._meters.decide(self._limits.due(now))
        for alert in alerts:
            if self._ledger.covering(alert.sender) is None:
                verdict = self.decider.alert(alert)
                if verdict.target is not None:
                    self._block(alert, verdict.target, verdict.reason)
        for evidence in heard:
            self._hear(evidence)

    def _tell(self, decision: Decision) -> None:
        if self.watched is None:
            self.detector.senders.blocked.decide(decision)

    def _hear(self, evidence: Evidence) -> None:
        proposal = self.decider.evidence(evidence, "kitsune", lambda _: 0)
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
            self.decided += [DecidedAction(evidence.event_time, each.reason, limited=victim) for each in made]
            self.decider.settled(proposal)
        elif proposal.target is not None:
            self._block(evidence, proposal.target, proposal.reason)
            self.decider.settled(proposal)
        else:
            self.refused.append(proposal.reason)

    def _block(self, cause: Alert | Evidence, target: Target, reason: str) -> None:
        host = "" if cause.sender is None else cause.sender.ip
        decision = self._ledger.open(
            SWITCH, target, reason, (), cause.event_time, training_rate=cause.training_rate, host=host
        )
        self._tell(decision)
        self.decided.append(DecidedAction(cause.event_time, reason, target=target))

    def _drops(self, columns: Mapping[str, Any]) -> npt.NDArray[np.bool_]:
        drops = np.zeros(len(columns["port"]), bool)
        for block in self._ledger.blocks.values():
            target = block.decision.target
            if target.kind == "mac":
                mine = columns["eth_src"] == int(target.address.replace(":", ""), 16)
                drops |= mine if target.port is None else mine & (columns["port"] == target.port)
            else:
                address = ipaddress.ip_address(target.address)
                if address.version == 4:
                    drops |= (columns["ip_version"] == 4) & (columns["ip_src_lo"] == int(address))
        return drops

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
            run.judge(alerts, heard, int(columns["time_us"][-1]) * 1_000)
