"""The firewall as a DUE app: alerts, floods and handshakes in, decisions out.

All callbacks run in DUE's dispatcher thread, ticks in the main thread; one lock protects the state.
"""

import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar
from uuid import uuid4

from msgspec import structs

import due.service
from apps.enforcement import ALLOWED, CONFIRMED, ENFORCED, SWITCHES, EnforcementReport
from apps.evidence import EVIDENCE, JUDGED, TRAINING, Evidence, Judged, TrainingState
from apps.firewall import arrivals
from apps.firewall.arp.arp_bindings import ArpBindings
from apps.firewall.arp.theft_handler import TheftHandler
from apps.firewall.arrivals import FloodReported, SwitchReport, evidence_of
from apps.firewall.enforcement.announcer import EVENTS, Announcer
from apps.firewall.enforcement.declared_enforcers import DeclaredEnforcers
from apps.firewall.enforcement.event_sink import event_sinks
from apps.firewall.enforcement.mirrors import Mirrors
from apps.firewall.enforcement.switch_entries import KEPT, AllowEntries, is_prefix, prefix_update
from apps.firewall.evidence import history
from apps.firewall.evidence.archive import Archive
from apps.firewall.evidence.archived_state import UNREAD, ArchivedState
from apps.firewall.evidence.history import FAMILIES
from apps.firewall.evidence.known_sources import HANDSHAKES, KnownSources, in_batches
from apps.firewall.evidence.own_evidence import EVIDENCE_CAPABILITY, OWN_APP, OwnEvidence
from apps.firewall.evidence.writing_order import WritingOrder
from apps.firewall.evidence_handler import EvidenceHandler
from apps.firewall.incidents.incident_reports import INCIDENT_CAPABILITY, IncidentReports
from apps.firewall.instruction_handler import InstructionHandler
from apps.firewall.policy.auto_allowlist import surroundings
from apps.firewall.policy.block_lifecycle import BlockLifecycle, OperatorNotice
from apps.firewall.policy.decider import Decider
from apps.firewall.policy.false_alarms import FalseAlarms
from apps.firewall.policy.instructions import Desk, refused_as_late
from apps.firewall.policy.rate_limits import RateLimits
from apps.firewall.settings import Settings
from apps.firewall.syn.flood_handler import TELEMETRY, FloodHandler
from apps.firewall.syn.services import TcpService
from apps.firewall.syn.suspect_samples import SuspectSamples
from apps.firewall.syn.syn_defence import EVERY_SWITCH
from apps.messages import (
    Alert,
    Confirmation,
    Decision,
    Instruction,
    Intake,
    MessageError,
    TableCommand,
    TableUpdate,
    one_line,
)
from apps.packets import SteadyTime
from due import Capability, Engine, Interest, Item, Key, RecordBatch

KITSUNES_EVIDENCE = f"{EVIDENCE}.kitsune.*"
SAMPLES = "network.packets.p4runtime_ctrl.*"

INTERESTS = (
    Interest("network.anomaly.kitsune.alert"),
    Interest(KITSUNES_EVIDENCE),
    Interest(f"{TRAINING}.*"),
    Interest("network.confirmation.p4runtime_ctrl.*"),
    Interest("network.switch.p4runtime_ctrl.*"),
    Interest(history.INSTRUCTIONS),
)
SYN_INTERESTS = (
    Interest(HANDSHAKES),
    Interest("network.traffic_query.sonata.new_tcp"),
    Interest("network.traffic_query.sonata.syn_flood"),
    Interest("network.traffic_capture.sonata.tcp"),
    *(Interest(f"{SAMPLES}.{name}") for name in SuspectSamples.names()),
    Interest("network.traffic_capture.sonata.arp"),
)
"""Interests that are observed only if the settings ask for them, with the settings' parameters."""
ENFORCER_INTERESTS = (Interest(f"{CONFIRMED}.*.*"), Interest(f"{ENFORCED}.*.*"))
"""Of the enforcers that the settings name."""
CAPABILITIES = (
    *(
        Capability(f"network.{family}.firewall.{kind}", delivery="reliable", archive="always")
        for family in ("block", "block_prefix", "protect", "meter")
        for kind in ("ipv4", "ipv6", *(["mac"] if family == "block" else ()))
    ),
    Capability(f"{EVENTS}.*", delivery="reliable", archive="always"),
    EVIDENCE_CAPABILITY,
    INCIDENT_CAPABILITY,
    Capability(ALLOWED, delivery="reliable", archive="always"),
    Capability("network.p4_command.firewall.*", delivery="reliable"),
    Capability(f"{TELEMETRY}.*", delivery="reliable"),
    Capability(f"{KEPT}.*", delivery="reliable", archive="always"),
    Capability("network.packet_out.firewall.*", delivery="reliable"),
    Capability(f"{history.ANSWERS}.*", delivery="reliable", archive="always"),
    Capability(history.LESSONS, delivery="reliable", archive="always"),
    Capability(f"{JUDGED}.firewall", delivery="reliable"),
)

COMMAND = "network.p4_command.firewall"
MOST_SWITCHES = 256
STEP_S = 3600
"""Seconds; a larger jump of capture time is not accepted at once."""

T = TypeVar("T")

log = logging.getLogger(__name__)


class FirewallService:
    """Turns alerts into decisions; blocks are kept by `BlockLifecycle`."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._intake = Intake(log)
        self._settings = settings
        rules = settings.rules
        self._known = KnownSources(settings.known_limit, settings.known_days)
        self._lifecycle = BlockLifecycle(settings.rules, known=self._known)
        self._counts = dict.fromkeys(("alerts", "evidence"), 0)
        self._order: WritingOrder[Callable[[], None]] = WritingOrder()
        self._judged: Counter[str] = Counter()
        """Pieces of evidence by the app that wrote them."""
        self._decisions = 0
        allowed = (*settings.rules.allow, *(surroundings() if settings.allow_surroundings else ()))
        self._limits = RateLimits(settings.rules)
        self._allow_entries = AllowEntries()
        self._leftovers: dict[str, list[TableUpdate]] = {}
        self._switches: dict[str, str] = {}
        """Connected switches, and the controller instance that reported each."""
        self._lock = threading.RLock()
        self._announcer = Announcer(engine, *event_sinks(settings), settings.eve_format)
        self._incidents = IncidentReports(engine, self._announcer, settings.eve_format)
        self._own = OwnEvidence(engine, self._incidents, lambda: self._handler.decider.test.bound)
        self._floods = FloodHandler(
            engine,
            settings,
            self._lifecycle,
            allowed,
            self._known,
            self._switches,
            self._own,
            lambda decision, resets: self._publish(decision, resets=resets),
            lambda addresses, now: self._handler.offences_of_many(addresses, now),  # noqa: PLW0108 - it comes later
            self._lock,
            lambda: time.monotonic(),  # noqa: PLW0108 - tests set the clock of this module
        )
        self._syn = syn = self._floods.defence
        self._bindings = ArpBindings(
            training_s=settings.arp_training_s,
            settle_s=settings.arp_settle_s,
            contest_s=settings.arp_contest_s,
        )
        self._archive = Archive(engine, settings.archive_patience_s)
        # with questions of its own: neither they nor those about earlier offences wait for the others
        self._past = ArchivedState(Archive(engine, settings.archive_patience_s), self._intake, settings)
        self._panicked = False
        """An operator has lifted everything before the archive said what that is."""
        self._enforcers = DeclaredEnforcers(engine, settings.enforcers)
        self._mirrors = Mirrors(elsewhere=self._enforcers.elsewhere)
        self._lessons = FalseAlarms(settings.rules.false_alarm_days)
        self._desk = Desk(
            self._lifecycle, self._syn, self._limits, allowed, self._lessons, self._past.decision
        )
        self._handler = EvidenceHandler(
            Decider(
                rules, self._lifecycle, self._bindings, self._known, lambda: self._desk.allow, syn.ports_of
            ),
            self._lifecycle,
            self._syn,
            self._limits,
            self._archive,
            self._announcer,
            self._incidents,
            self._own,
            self._lessons,
            self._publish,
            lambda: time.monotonic(),  # noqa: PLW0108 - tests set the clock of this module
        )
        self._thefts = TheftHandler(
            settings.arp,
            self._bindings,
            self._lifecycle,
            self._announcer,
            self._own,
            lambda: self._desk.allow,
            self._switches,
            self._publish,
        )
        self._instructions = InstructionHandler(
            engine,
            self._desk,
            self._past,
            self._archive,
            self._lessons,
            self._handler,
            self._intake,
            self._lock,
            self._publish,
            self._tell_allowed,
            lambda: self._now,
        )
        self._time = SteadyTime(STEP_S * 1_000_000_000)
        """Capture time last reported by the switches, ns."""
        self._row_time = SteadyTime(STEP_S * 1_000_000)
        """Capture time of packets, us."""

    # -- start, stop ---------------------------------------------------------------------------------

    @property
    def _now(self) -> int:
        return self._time.now or 0

    def start(self) -> None:
        """Restore history, or wait for it, then subscribe."""
        if self._past.read():
            self._take_up_history()
            self._known.changes()
        else:
            self._lifecycle.waits_for = self._lifecycle.stopped = UNREAD
            log.error("nobody is blocked unless operators ask for it: %s", UNREAD)
        if self._settings.learn:
            self._hear(HANDSHAKES, arrivals.handshake_in, self._on_handshake)
        self._hear("network.anomaly.kitsune.alert", Alert.from_item, self._on_alert)
        self._hear(f"{TRAINING}.*", arrivals.training_in, self._on_training)
        queries = (f"sonata_adapter.{query}" for query in self._settings.evidence_queries)
        # it acts on its own evidence when it finds it
        apps = (f"{app}.*" for app in self._settings.evidence_apps if app != OWN_APP)
        for key in (KITSUNES_EVIDENCE, *(f"{EVIDENCE}.{each}" for each in (*queries, *apps))):
            self._hear(key, Evidence.from_item, self._on_evidence)
        for enforcer in dict.fromkeys((SWITCHES, *self._settings.enforcers)):
            self._hear(f"{CONFIRMED}.{enforcer}.*", Confirmation.from_item, self._on_confirmation)
            if enforcer != SWITCHES:
                self._hear(f"{ENFORCED}.{enforcer}.*", arrivals.report_in, self._on_enforced)
        self._hear("network.switch.p4runtime_ctrl.*", arrivals.state_in, self._on_switch)
        self._instructions.answer_earlier()
        self._hear(history.INSTRUCTIONS, Instruction.from_item, self._on_instruction)
        if self._settings.detect:
            self._hear_tcp()
        if self._settings.detect and self._settings.arp != "off":
            self._hear("network.traffic_capture.sonata.arp", arrivals.arps_in, self._on_arp)

    def _hear(self, key: str, decode: Callable[[Item], T], act: Callable[[Item, T], None]) -> None:
        self._engine.observe(key).subscribe(self._intake.reading(key.partition(":")[0], decode, act))

    def _hear_tcp(self) -> None:
        rules = self._settings.syn
        specs = {"window": f"{rules.window_ms}ms", "threshold": str(rules.threshold)}
        stream = Key("network.traffic_capture.sonata.tcp")
        if rules.copies == "all":
            query = Key("network.traffic_query.sonata.syn_flood").with_specs(**specs).text
            self._hear(query, arrivals.flood_in, self._on_flood)
            self._hear(stream.with_specs(flag="syn").text, arrivals.syns_in, self._on_syns)
        else:
            query = Key("network.traffic_query.sonata.new_tcp").with_specs(**specs).text
            self._hear(query, arrivals.flood_in, self._on_surge)
            for name in self._floods.sample_names():
                self._hear(f"{SAMPLES}.{name}", arrivals.syns_in, self._on_syns)
        if rules.resets:
            self._hear(stream.with_specs(flag="syn+ack").text, arrivals.syn_acks_in, self._on_syn_acks)

    def _take_up_history(self) -> None:
        """Restore what was in force before a restart, as it still is in the switch."""
        past = self._past.past
        if past is None:
            return
        self._instructions.restore()
        standing = self._past.standing()
        self._lifecycle.restore(standing)
        self._syn.restore(standing)
        self._limits.restore(standing)
        self._incidents.restore(past.incidents)
        self._lessons.restore(past.false_alarms)
        if self._handler.decider.test.training is None:
            self._handler.trained(past.training)
        self._take_up_entries()
        if self._settings.learn:
            self._past.teach(self._known)
        self._past.taken_up()
        if standing:
            log.info("decisions in force from the archive: %d", len(standing))

    def _take_up_entries(self) -> None:
        """Restore allowed entries; stale ones of an earlier run are deleted when their switch connects."""
        updates = self._allow_entries.change(self._desk.entries)
        targets = [block.decision.target for block in self._lifecycle.blocks.values()]
        wanted = self._allow_entries.everything()
        wanted += [prefix_update("insert", target.address) for target in targets if is_prefix(target)]
        self._leftovers = self._past.leftovers(wanted)
        for switch in self._switches:
            self._keep(switch, self._leftovers.pop(switch, []))
            self._keep(switch, updates)

    def _take_up_later(self) -> None:
        """The archive did not answer at the start.  What operators have done meanwhile holds."""
        if self._past.is_taken_up or not self._past.read_later():
            return
        with self._lock:
            earlier = {*self._lifecycle.blocks}
            self._take_up_history()
            self._lifecycle.waits_for = self._lifecycle.stopped = ""
            log.warning("Data Archives have answered: history is known from now on")
            blocks = [each.decision for each in self._lifecycle.blocks.values()]
            restored = [each for each in blocks if each.id not in earlier]
            for decision in restored:
                if is_prefix(decision.target):
                    self._carry_out_prefix(decision, self._switches)
            over = {each.id for each in restored if self._panicked}
            over |= {each.id for each in blocks if self._desk.spares(each)}
            self._lift(over, "lifted by an operator, or allowed, while history was not known")

    def _lift(self, blocks: Iterable[str], reason: str) -> None:
        now = self._now or time.time_ns()
        over = [self._lifecycle.lift(each, now, reason) for each in sorted(blocks)]
        if self._panicked:
            over += [*self._syn.release_all(now, reason), *self._limits.release_all(now, reason)]
        for decision in over:
            if decision is not None:
                self._publish(decision)

    def tick(self) -> None:
        """Examine suspected floods that are due, and write known sources in batches."""
        with self._lock:
            for act in self._order.overdue(time.monotonic()):
                act()
            self._floods.tick()
            for notice in self._floods.notices(self._now):
                self._announcer.say(notice, logging.INFO)
            updates = self._known.changes()
            for switch in self._switches if updates else ():
                self._command(switch, updates)
            self._say_notices()
        self._take_up_later()
        self._instructions.answer_earlier()
        if self._past.is_taken_up:  # before, it is not known which were carried out, nor what they lift
            self._instructions.read_archived_words()
        self._announcer.check()

    def stop(self) -> None:
        """Deliver queued events; blocks stay in force, and in the archive."""
        with self._lock:
            self._floods.stop()
            self._incidents.flush()
        self._announcer.close()

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return {
            **self._counts,
            **self._floods.health(),
            **self._thefts.health(),
            **self._own.health(),
            "blocks": sum(not each.decision.dry_run for each in self._lifecycle.blocks.values()),
            "would_block": sum(each.decision.dry_run for each in self._lifecycle.blocks.values()),
            "rate_limits": len(self._limits.standing),
            "rate_limits_refused": self._limits.refused,
            "known_sources": len(self._known),
            **self._instructions.health(),
            "false_alarms": len(self._lessons),
            "allowed_left_out": self._allow_entries.left_out,
            "refused_by_cap": self._lifecycle.refused,
            "blocking_stopped": int(bool(self._lifecycle.stopped)),
            "stopped_by": self._lifecycle.stopped,
            "evidence_missed": self._order.missed,
            "evidence_sums": len(self._handler.decider.test),
            **{name: n + self._past.archive.health()[name] for name, n in self._archive.health().items()},
            "times_doubted": self._time.doubted + self._row_time.doubted,
            **self._incidents.health(),
            **self._intake.health(),
            **self._enforcers.health(),
            **self._announcer.health(),
        }

    # -- SYN floods ---------------------------------------------------------------------------

    def _on_handshake(self, _: Item, shake: tuple[str, TcpService, int]) -> None:
        source, service, at = shake
        with self._lock:
            self._floods.handshake(source, service, self._time.fit(at))

    def _on_flood(self, item: Item, flood: FloodReported) -> None:
        with self._lock:
            self._floods.report(item, flood, self._time.fit(item.event_time))

    def _on_surge(self, item: Item, flood: FloodReported) -> None:
        with self._lock:
            self._floods.surge(item, flood, self._time.fit(item.event_time))

    def _on_syns(self, item: Item, batch: RecordBatch) -> None:
        with self._lock:
            # by what came before: handshakes and SYNs come under keys of their own, in no order between the two
            self._floods.look_at_what_is_due()
            batch = self._believed(batch)
            if len(batch):
                self._floods.syns(item, batch)

    def _on_syn_acks(self, _: Item, batch: RecordBatch) -> None:
        with self._lock:
            self._floods.syn_acks(self._believed(batch), len(batch))

    def _believed(self, batch: RecordBatch) -> RecordBatch:
        """The packets with a plausible time."""
        rows = self._row_time.believed(batch["time_us"])
        return batch if rows is None else batch.take(rows)

    # -- ARP ----------------------------------------------------------------------------------

    def _on_arp(self, item: Item, batch: RecordBatch) -> None:
        with self._lock:
            self._thefts.arps(item, self._believed(batch))

    # -- anomalies and evidence ---------------------------------------------------------------

    def _on_alert(self, item: Item, alert: Alert) -> None:
        with self._lock:
            self._counts["alerts"] += 1
            alert = structs.replace(alert, event_time=self._time.fit(alert.event_time))
            self._lapse(alert.event_time)
            self._handler.alert(item, alert)
            self._say_notices()

    def _on_training(self, item: Item, state: TrainingState) -> None:
        self._in_order(item, state.number, lambda: self._handler.trained(state))

    def _on_evidence(self, item: Item, evidence: Evidence) -> None:
        self._in_order(item, evidence.number, lambda: self._judge(item, evidence))

    def _in_order(self, item: Item, number: int, act: Callable[[], None]) -> None:
        with self._lock:
            writer = f"{item.app_id}.{item.instance_id}"
            for each in self._order.take(writer, number, act, time.monotonic()):
                each()

    def _judge(self, item: Item, evidence: Evidence) -> None:
        self._counts["evidence"] += 1
        at = self._time.fit(evidence.event_time)
        self._lapse(at)
        evidence = structs.replace(evidence, event_time=at, since=min(evidence.since, at))
        self._handler.evidence(item, evidence)
        self._say_notices()
        self._judged[item.app_id] += 1
        judged = Judged(app=item.app_id, evidence=self._judged[item.app_id], decisions=self._decisions)
        self._engine.write(f"{JUDGED}.firewall", judged.to_value(), [due.NO_WAIT], event_time=at)

    # -- switches -----------------------------------------------------------------------------

    def _tell_allowed(self) -> None:
        updates = self._allow_entries.change(self._desk.entries)
        for switch in self._switches if updates else ():
            self._keep(switch, updates)
        if self._past.is_taken_up:  # what they have is what an earlier run has told them, and complete
            self._enforcers.tell_allowed(self._desk.entries)

    def _on_instruction(self, item: Item, instruction: Instruction) -> None:
        if instruction.verb == "panic" and refused_as_late(instruction, time.time_ns()) is None:
            with self._lock:  # first: carrying it out may wait, and history come meanwhile
                self._panicked = self._panicked or not self._past.is_taken_up
        self._instructions.instruct(item, instruction)

    def _keep(self, switch: str, updates: Iterable[TableUpdate], name: str = "") -> None:
        """Write entries that outlive the controller."""
        self._command(switch, updates, name, KEPT)

    def _command(
        self, switch: str, updates: Iterable[TableUpdate], name: str = "", key: str = COMMAND
    ) -> None:
        for batch in in_batches(updates):
            command = TableCommand(id=name or f"firewall-{uuid4().hex[:12]}", updates=batch)
            self._engine.write(f"{key}.{switch}", command.to_value(), [due.NO_WAIT])

    def _arm(self, item: Item, state: SwitchReport) -> None:
        """A switch has connected, or its controller has restarted: write all entries of the firewall."""
        switch = state.switch
        if not state.primary:
            self._switches.pop(switch, None)
            return
        if self._switches.get(switch) == item.instance_id:
            return
        if len(self._switches) >= MOST_SWITCHES and switch not in self._switches:
            text = f"switch {switch}: {MOST_SWITCHES} are connected already"
            self._intake.refuse("switch", MessageError("size", text), item.key)
            return
        self._switches[switch] = item.instance_id
        self._keep(switch, self._leftovers.pop(switch, []))
        self._keep(switch, self._allow_entries.everything())
        for decision in self._syn.arm(switch, self._now or evidence_of(item, "").timestamp):
            self._publish(decision)
        for block in self._lifecycle.blocks.values():
            if is_prefix(block.decision.target):
                self._carry_out_prefix(block.decision, [switch])
        self._command(switch, self._known.everything())

    def _on_confirmation(self, item: Item, confirmation: Confirmation) -> None:
        with self._lock:
            followed = self._enforcers.follows(confirmation, self._lifecycle.blocks)
            if followed and self._enforcers.confirmed(item.app_id, confirmation):
                self._lifecycle.confirm(confirmation)
                self._limits.confirm(confirmation)
            places = self._enforcers.in_force(confirmation.id)
            self._syn.confirm(confirmation, self._now, stands=bool(places))
            self._incidents.confirmed(confirmation, places)
            self._floods.confirmed(confirmation)
        where = f"{item.app_id} {confirmation.switch}"
        if confirmation.state == "failed":
            log.error("%s", one_line(f"{where} refused {confirmation.id}: {confirmation.cause}"))
        elif confirmation.state == "pending":
            log.warning("%s", one_line(f"{where} has {confirmation.id} pending: {confirmation.cause}"))

    def _on_enforced(self, _: Item, report: EnforcementReport) -> None:
        with self._lock:
            for held in report.blocks:
                self._count(report.enforcer, report.place, held.id, held.packets, self._now)
            if news := self._enforcers.news_of(report):
                self._announcer.say(OperatorNotice("enforcer", news, self._now))

    def _count(self, enforcer: str, place: str, decision: str, packets: int, now: int) -> None:
        total = self._enforcers.count(decision, enforcer, place, packets)
        self._lifecycle.count_drops(decision, total, now)
        self._limits.count_drops(decision, total, now)
        self._incidents.count(decision, total, now)

    def _on_switch(self, item: Item, state: SwitchReport) -> None:
        with self._lock:
            believed = state.event_time > 0 and self._time.hear(state.event_time)
            for reading in state.blocks if believed else ():
                self._count(SWITCHES, state.switch, reading.id, reading.packets, state.event_time)
            self._mirrors.note(state.switch, mirror=state.mirror)
            self._arm(item, state)
            self._floods.hear_switch(state, believed=believed)
            if believed:
                self._lapse(state.event_time)

    def _lapse(self, now: int) -> None:
        for decision in [*self._lifecycle.due(now), *self._syn.due(now), *self._limits.due(now)]:
            self._publish(decision)
        self._own.lapse(now)
        self._incidents.lapse(now)

    # -- output ------------------------------------------------------------------------

    def _publish(self, decision: Decision, *, resets: bool = True) -> Decision:
        """Returns the decision as it was published: where only copies are seen, as a dry run."""
        decision = self._mirrors.marked(decision, self._switches)
        if decision.id in self._lifecycle.blocks:
            self._lifecycle.blocks[decision.id].decision = decision
        if decision.id in self._limits.standing:
            self._limits.standing[decision.id].decision = decision
        target = decision.target
        kind = ("ipv6" if ":" in target.address else "ipv4") if target.kind == "ip" else "mac"
        log.warning("%s %s: %s", decision.action, decision.what, one_line(decision.reason))
        self._incidents.decided(decision)
        self._handler.decided()
        self._lessons.decided(decision)
        family = FAMILIES[decision.action]
        if is_prefix(target) and family == "block":
            family = "block_prefix"
            self._carry_out_prefix(decision, self._switches)
        elif resets and decision.action == "block" and target.kind == "ip" and not decision.dry_run:
            self._floods.blocked(decision)
        self._engine.write(
            f"network.{family}.firewall.{kind}",
            decision.to_value(),
            [due.NO_WAIT],
            event_time=decision.event_time,
        )
        self._decisions += 1
        self._past.decided(decision)
        return decision

    def _carry_out_prefix(self, decision: Decision, switches: Iterable[str]) -> None:
        if decision.dry_run:
            return
        kind = "insert" if decision.action == "block" else "delete"
        for switch in switches:
            if decision.switch in (EVERY_SWITCH, switch) and switch not in self._mirrors:
                self._keep(switch, [prefix_update(kind, decision.target.address)], decision.id)

    def _say_notices(self) -> None:
        if (notice := self._floods.one_direction(self._now)) is not None:
            self._announcer.say(notice)
        for notices in (self._lifecycle.notices, self._limits.notices):
            while notices:
                self._announcer.say(notices.popleft(), logging.ERROR)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the firewall until it is stopped."""
    return due.service.run("firewall", FirewallService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
