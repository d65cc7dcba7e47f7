"""SYNs, handshakes and reported floods → guards and blocks: examines suspicions when due, resets what is half open.

I/O: writes requests for samples and packet-outs; a timer of its own wakes it, under the lock of the service.
"""

import threading
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, Final

import due
from apps.firewall.arrivals import FloodReported, SwitchReport, evidence_of
from apps.firewall.evidence.history import EarlierBlocks
from apps.firewall.evidence.known_sources import KnownSources
from apps.firewall.evidence.offences import offence_evidence
from apps.firewall.evidence.own_evidence import OwnEvidence
from apps.firewall.evidence.recent_rows import AGED_S
from apps.firewall.policy.block_lifecycle import BlockLifecycle, OperatorNotice
from apps.firewall.policy.rules import AllowList
from apps.firewall.settings import Settings
from apps.firewall.syn.examinations import Examination, Examinations
from apps.firewall.syn.flood_evidence import Suspicion, SynFinding
from apps.firewall.syn.recent_syns import Surges
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.suspect_samples import SuspectSamples
from apps.firewall.syn.syn_ack_buffer import Answers, SynAckBuffer, Wanted, packet_outs
from apps.firewall.syn.syn_defence import SynDefence, Watch
from apps.messages import Confirmation, Decision
from due import Engine, Item, RecordBatch

TELEMETRY: Final = "network.telemetry.firewall"
_BEFORE_NS: Final = 1_000_000_000
"""Connections are reset that were answered so long before the window that reports the flood, too: a backlog is full
within milliseconds, which may be the last ones of the window before."""
ONE_DIRECTION: Final = 1000
"""Warn about one-way traffic after this many SYNs without a SYN-ACK."""


class FloodHandler:
    """What the service does about SYN floods; it holds the lock when it calls.

    Args:
        engine: writes requests for samples and packet-outs.
        settings: of the firewall.
        lifecycle: blocks in force.
        allowed: the allow-list of the settings.
        known: addresses known from handshakes.
        switches: names of connected switches.
        own: writes what decides as evidence.
        publish: writes a decision; with `False` no connections are reset for it.
        offences: earlier blocks of addresses by a capture time, ns; None if the archive does not answer.
        lock: of the service, for the timer's thread.
        clock: monotonic time, seconds.
    """

    def __init__(
        self,
        engine: Engine,
        settings: Settings,
        lifecycle: BlockLifecycle,
        allowed: tuple[str, ...],
        known: KnownSources,
        switches: Collection[str],
        own: OwnEvidence,
        publish: Callable[[Decision, bool], Decision],
        offences: Callable[[Sequence[str], int], dict[str, EarlierBlocks] | None],
        lock: "threading.RLock",
        clock: Callable[[], float],
    ) -> None:
        rules = settings.syn
        self._engine = engine
        self._rules = rules
        self._switches = switches
        self._own = own
        self._publish = publish
        self._offences = offences
        self._lock = lock
        self._clock = clock
        after_s = rules.reset_after_ms / 1000
        self._answers = Answers(rules.sample, AGED_S + after_s)
        services = tuple(TcpService.parse(text) for text in settings.guard)
        allow_list = AllowList.parse(allowed)
        self.defence = SynDefence(rules, services, lifecycle, allow_list, known, self._is_silent)
        self._surges = Surges(rules.threshold, rules.window_ms)
        self._examinations = Examinations(rules.grace_ms, rules.patience_ms)
        self._samples = SuspectSamples(rules.sample_most, rules.sample_ms / 1000)
        resets = rules.resets if rules.challenge else 0
        self._resets = SynAckBuffer(self._answers, after_s=after_s, limit=resets)
        self._counts = dict.fromkeys(("handshakes", "syns", "syn_acks"), 0)
        self._stopped = False

    def handshake(self, source: str, service: TcpService, at: int) -> None:
        """A handshake was completed at a capture time, ns."""
        self._counts["handshakes"] += 1
        self.defence.handshake(source, service, at)

    def report(self, item: Item, flood: FloodReported, now: int) -> None:
        """A query has found a flood."""
        summary = f"{flood.count} new half-open connections to {flood.dst} within a window"
        self._suspect(Suspicion(flood.dst, evidence_of(item, summary), now, flood.window_start, flood.count))

    def surge(self, item: Item, flood: FloodReported, now: int) -> None:
        """The switch has counted the SYNs itself; from now on some of them are copied."""
        summary = f"{flood.count} SYNs went to {flood.dst} within {self._rules.window_ms} ms"
        self._request(self._samples.begin(flood.dst, self._clock()))
        self._suspect(Suspicion(flood.dst, evidence_of(item, summary), now, flood.window_start, flood.count))

    def syns(self, item: Item, batch: RecordBatch) -> None:
        """SYNs of a plausible time, at least one."""
        rules = self._rules
        self._counts["syns"] += len(batch)
        self.defence.recent.add(batch)
        self._examinations.hear(int(batch["time_us"].max()) * 1000, self._clock())
        if rules.copies == "suspects":
            self._samples.taken(item.key.rpartition(".")[2], len(batch), self._clock())
            self._request(self._samples.ended(self._clock()))
        for surge in self._surges.add(batch) if rules.copies == "all" else ():
            summary = f"{rules.threshold} SYNs went to {surge.host} within {rules.window_ms} ms"
            exhibit = evidence_of(item, summary)
            self._suspect(Suspicion(surge.host, exhibit, surge.at, surge.window, rules.threshold))
        if self._examinations.live:
            self.look_at_what_is_due()

    def syn_acks(self, batch: RecordBatch, seen: int) -> None:
        """SYN-ACKs of a plausible time, of so many that were seen."""
        self._counts["syn_acks"] += seen
        self._answers.add(batch, self._clock())

    def look_at_what_is_due(self) -> None:
        """Examine the suspicions whose time has come."""
        for examination in self._examinations.due(self._clock()):
            self._look(examination)

    def tick(self) -> None:
        """Examine, end samples, reset."""
        self.look_at_what_is_due()
        self._request(self._samples.ended(self._clock()))
        halves = self._resets.due(self._clock(), sorted(self._switches), self.defence.spared)
        for switch in self._switches if halves else ():
            for value in packet_outs(halves):
                self._engine.write(f"network.packet_out.firewall.{switch}", value, [due.NO_WAIT])

    def hear_switch(self, state: SwitchReport, *, believed: bool) -> None:
        """A switch has reported its clock; returns whether its time is plausible."""
        self._examinations.live = state.clock != "packets"
        if believed:
            self._examinations.tick(state.event_time)

    def blocked(self, decision: Decision) -> None:
        """Reset the connections of a blocked source once the switch has confirmed the block."""
        self._resets.plan(decision.id, Wanted(source=decision.target.address), self._clock())

    def confirmed(self, confirmation: Confirmation) -> None:
        """A switch has answered to a decision."""
        self._resets.confirm(confirmation.id, confirmation.state, self._clock())

    def stop(self) -> None:
        """Timers that are still running do nothing."""
        self._stopped = True

    def notices(self, now: int) -> Iterable[OperatorNotice]:
        """What resets have come to, and, once, that only one direction is seen."""
        while self._resets.notes:
            note = self._resets.notes.popleft()
            yield OperatorNotice("resets", f"{note.decision}: {note.text}", now)

    def one_direction(self, now: int) -> OperatorNotice | None:
        """That SYN-ACKs are missing; once."""
        counts = self._counts
        if counts["syns"] <= ONE_DIRECTION or counts["syn_acks"] + counts["handshakes"]:
            return None
        counts["syn_acks_missing"] = counts.get("syn_acks_missing", 0) + 1
        if counts["syn_acks_missing"] > 1:
            return None
        text = (
            f"{counts['syns']:,} SYNs and no SYN-ACK: nobody answers, or only one direction passes the switch;"
            " then no source becomes known, and half-open connections end by the server's own time-out"
        )
        return OperatorNotice("one_direction", text, now)

    def sample_names(self) -> list[str]:
        """Names of the samples that may be asked for."""
        return self._samples.names()

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return {
            **self._counts,
            "guarded": [str(service) for service in self.defence.guarded],
            "guards": len(self.defence.guarded),
            "syns_kept": len(self.defence.recent),
            "syn_samples": len(self._samples),
            "resets": self._resets.sent,
            "resets_spared": self._resets.spared,
            "resets_left_out": self._resets.left_out,
            "resets_waited_out": self._resets.waited_out,
        }

    def _is_silent(self, service: TcpService) -> bool:
        """Without resets SYN-ACKs are not requested, and answers are unknown."""
        return self._rules.resets > 0 and self._answers.lacks(service)

    def _request(self, requests: Iterable[dict[str, Any]]) -> None:
        for request in requests:
            self._engine.write(f"{TELEMETRY}.{request['name']}", request, [due.NO_WAIT])

    def _look_later(self, seconds: float) -> None:
        """Use a timer: the next tick may come 50 ms later, and the next SYN never."""
        timer = threading.Timer(seconds, self._wake)
        timer.daemon = True
        timer.start()

    def _wake(self) -> None:
        with self._lock:
            if not self._stopped:
                self.look_at_what_is_due()

    def _suspect(self, suspicion: Suspicion) -> None:
        if self._rules.copies == "all" and not len(self.defence.recent):
            # SYNs do not come: there is nothing to wait for
            self._look(Examination(suspicion, suspicion.now, sure=False))
        elif (wait := self._examinations.suspect(suspicion, self._clock())) is not None:
            self._look_later(wait)

    def _look(self, due: Examination) -> None:
        """Examine the SYNs of a suspected flood, and decide."""
        watch = self.defence.suspect(due.suspicion, due.at)
        if self._is_too_early(watch, due):
            soon = self._samples.runs(due.suspicion.host)
            wait = self._examinations.again(due, self._clock(), soon=soon)
            if wait is not None:
                self._look_later(wait)
            return
        often = watch.often(self._rules) if due.sure else ()
        offences = self._offences(often, watch.now)
        for finding in self.defence.findings(watch, self._own.bound, sure=due.sure):
            for decision in self._decide(finding, offences, sure=due.sure):
                self._plan_resets(decision, due.suspicion.since - _BEFORE_NS)
        if watch.unsure:
            self._examinations.doubt(due, self._clock())

    def _decide(
        self, finding: SynFinding, offences: dict[str, EarlierBlocks] | None, *, sure: bool
    ) -> list[Decision]:
        """Decide by what was found, and write it where it is news or decides; returns what was published."""
        news = False
        if not finding.source:
            evidence, news = self._own.found(finding.evidence, again=sure)
            finding = finding._replace(evidence=evidence)
        decisions = self.defence.decide(finding, offences)
        if news or decisions:
            self._own.tell(finding.evidence)
        earlier = (offences or {}).get(finding.source)
        if decisions and earlier is not None and earlier.times:
            self._own.tell(offence_evidence(finding.evidence, finding.target, earlier))
        # the guard before the block has had the source's connections reset
        return [self._publish(each, False) for each in decisions]

    def _plan_resets(self, decision: Decision, since: int) -> None:
        if decision.action == "protect" and not decision.dry_run:
            service = TcpService(decision.target.address, decision.target.port or 0)
            self._resets.plan(decision.id, Wanted(service, since=since), self._clock())

    def _is_too_early(self, watch: Watch, due: Examination) -> bool:
        """Whether the sample, which began with the report, is still too small to tell."""
        rules = self._rules
        patience = rules.patience_ms * 1_000_000
        waited = due.at - due.suspicion.since
        return rules.copies == "suspects" and not due.sure and watch.total < rules.least and waited < patience
