"""The firewall as a DUE app: alerts, floods and handshakes in, decisions out.

All callbacks run in DUE's dispatcher thread, ticks in the main thread; one lock keeps them apart.
"""

import logging
import sys
import threading
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import due.service
from apps.firewall.announcer import EVENTS, Announcer
from apps.firewall.archive import Archive
from apps.firewall.bindings import Bindings, Station, Theft
from apps.firewall.eve import alert_line, decision_line
from apps.firewall.half_open import Answers, Resets, Wanted, packet_outs
from apps.firewall.history import (
    ANSWERS,
    DECISIONS,
    INSTRUCTIONS,
    count_offences,
    decisions_in,
    in_force,
    instructions_in,
    newer_than,
    offences_of_many,
    offences_query,
)
from apps.firewall.instructions import Desk
from apps.firewall.known_sources import HANDSHAKES, KnownSources, in_batches, learn_archived
from apps.firewall.ledger import Ledger, Notice
from apps.firewall.neighbours import gather_blocks
from apps.firewall.outlets import outlets_of
from apps.firewall.policy import AllowList, Verdict, judge
from apps.firewall.recent_rows import AGED_S
from apps.firewall.recent_syns import Surges
from apps.firewall.services import Service
from apps.firewall.settings import Settings
from apps.firewall.surroundings import SOURCES, worth_allowing
from apps.firewall.switch_entries import KEPT, AllowEntries, is_prefix, leftovers, prefix_update
from apps.firewall.syn_defence import EVERY_SWITCH, UNKNOWN_HISTORY, Suspicion, SynDefence
from apps.messages import (
    Alert,
    Answer,
    Confirmation,
    Decision,
    Evidence,
    Instruction,
    Sender,
    TableCommand,
    TableUpdate,
    Target,
)
from due import Capability, Engine, Interest, Item, Key

INTERESTS = (
    Interest("network.anomaly.kitsune.alert"),
    Interest("network.confirmation.p4runtime_ctrl.*"),
    Interest("network.switch.p4runtime_ctrl.*"),
    Interest(INSTRUCTIONS),
)
SYN_INTERESTS = (
    Interest(HANDSHAKES),
    Interest("network.traffic_query.sonata.syn_flood"),
    Interest("network.traffic_capture.sonata.tcp"),
    Interest("network.traffic_capture.sonata.arp"),
)
"""Registered by observing, with parameters of the settings, where the settings want them."""
CAPABILITIES = (
    Capability("network.block.firewall.ipv4", delivery="reliable", archive="always"),
    Capability("network.block.firewall.ipv6", delivery="reliable", archive="always"),
    Capability("network.block.firewall.mac", delivery="reliable", archive="always"),
    Capability("network.block_prefix.firewall.ipv4", delivery="reliable", archive="always"),
    Capability("network.block_prefix.firewall.ipv6", delivery="reliable", archive="always"),
    Capability("network.protect.firewall.ipv4", delivery="reliable", archive="always"),
    Capability("network.protect.firewall.ipv6", delivery="reliable", archive="always"),
    Capability(f"{EVENTS}.*", delivery="reliable", archive="always"),
    Capability("network.p4_command.firewall.*", delivery="reliable"),
    Capability(f"{KEPT}.*", delivery="reliable", archive="always"),
    Capability("network.packet_out.firewall.*", delivery="reliable"),
    Capability(f"{ANSWERS}.*", delivery="reliable", archive="always"),
)

COMMAND = "network.p4_command.firewall"
EVIDENCE_KEPT = 10
SENDERS_KEPT = 10_000
HOSTS_WATCHED = 64
START_PATIENCE_S = 30.0
ARCHIVED_WORD_S = 2.0
ONE_DIRECTION = 1000
"""So many SYNs without any SYN-ACK, and people are told."""

log = logging.getLogger(__name__)


class FirewallService:
    """Turns alerts into decisions; all state but the evidence is in the ledger."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._settings = settings
        self._rules = settings.rules
        self._known = KnownSources(settings.known_limit)
        self._ledger = Ledger(settings.rules, known=self._known)
        self._evidence: defaultdict[Sender, deque[Evidence]] = defaultdict(
            lambda: deque(maxlen=EVIDENCE_KEPT)
        )
        self._counts = dict.fromkeys(("alerts", "handshakes", "syns", "syn_acks", "arp_thefts"), 0)
        services = tuple(Service.parse(text) for text in settings.guard)
        allowed = (*settings.rules.allow, *(_surroundings() if settings.allow_surroundings else ()))
        after_s = settings.syn.reset_after_ms / 1000
        self._answers = Answers(settings.syn.sample, AGED_S + after_s)
        allow_list = AllowList.parse(allowed)
        self._syn = SynDefence(settings.syn, services, self._ledger, allow_list, self._known, self._is_silent)
        self._desk = Desk(self._ledger, self._syn, allowed)
        self._allow_entries = AllowEntries()
        self._leftovers: dict[str, list[TableUpdate]] = {}
        self._switches: dict[str, str] = {}
        """Switches under control, and the controller's instance that says so."""
        self._surges = Surges(settings.syn.threshold, settings.syn.window_ms)
        self._suspected: dict[str, tuple[float, Suspicion]] = {}
        """By host: when to look, wall clock, and at what."""
        self._undecided: dict[str, tuple[float, Suspicion]] = {}
        """The same for the second look, after which sources are blocked."""
        self._resets = Resets(self._answers, after_s=after_s, limit=settings.syn.resets)
        self._bindings = _bindings(settings)
        self._archive = Archive(engine, settings.archive_patience_s)
        self._announcer = Announcer(engine, *outlets_of(settings))
        self._lock = threading.RLock()
        self._stopped = False
        self._carried_out: deque[str] = deque(maxlen=1000)
        self._words_since = time.time_ns()
        self._syns_until = 0
        """Capture time of the newest SYN, ns."""
        self._now = 0
        """Capture time, as the switches last said."""

    # -- life ---------------------------------------------------------------------------------

    def start(self) -> None:
        """Take up history, then subscribe."""
        observe = self._engine.observe
        self._take_up_history()
        self._take_up_entries()
        if self._settings.learn:
            past = self._archive.find(HANDSHAKES, START_PATIENCE_S) or []
            learn_archived(self._known, past, self._settings.known_days)
            self._known.changes()
            log.info("%d known sources in the archive", len(self._known))
            observe(HANDSHAKES).subscribe(self._on_handshake)
        observe("network.anomaly.kitsune.alert").subscribe(self._on_alert)
        observe("network.confirmation.p4runtime_ctrl.*").subscribe(self._on_confirmation)
        observe("network.switch.p4runtime_ctrl.*").subscribe(self._on_switch)
        observe(INSTRUCTIONS).subscribe(self._on_instruction)
        if self._settings.detect:
            self._observe_tcp()
        if self._settings.detect and self._settings.arp != "off":
            observe("network.traffic_capture.sonata.arp").subscribe(self._on_arp)

    def _observe_tcp(self) -> None:
        rules = self._settings.syn
        specs = {"window": f"{rules.window_ms}ms", "threshold": str(rules.threshold)}
        query = Key("network.traffic_query.sonata.syn_flood").with_specs(**specs).text
        stream = Key("network.traffic_capture.sonata.tcp")
        self._engine.observe(query).subscribe(self._on_flood)
        self._engine.observe(stream.with_specs(flag="syn").text).subscribe(self._on_syns)
        if rules.resets:
            self._engine.observe(stream.with_specs(flag="syn+ack").text).subscribe(self._on_syn_acks)

    def _is_silent(self, service: Service) -> bool:
        """Without resets nobody asks for SYN-ACKs, and nothing is known of answers."""
        return self._settings.syn.resets > 0 and self._answers.lacks(service)

    def _take_up_history(self) -> None:
        """What was in force before a restart is in force again, in our books as it is in the switch."""
        self._desk.take_up(instructions_in(self._archive.find(INSTRUCTIONS, START_PATIENCE_S) or ()))
        answered = self._archive.find(f"{ANSWERS}.*", START_PATIENCE_S) or ()
        self._carried_out.extend(str(item.value["id"]) for item in answered)
        found = [item for key in DECISIONS for item in self._archive.find(key, START_PATIENCE_S) or ()]
        standing = in_force(decisions_in(found))
        self._ledger.restore(standing)
        self._syn.restore(standing)
        if standing:
            log.info("%d decisions of the archive are in force", len(standing))

    def _take_up_entries(self) -> None:
        """Allowed entries; those of an earlier run that are wanted no more go when their switch comes."""
        self._allow_entries.change(self._desk.entries)
        targets = [block.decision.target for block in self._ledger.blocks.values()]
        wanted = self._allow_entries.everything()
        wanted += [prefix_update("insert", target.address) for target in targets if is_prefix(target)]
        past: defaultdict[str, list[Item]] = defaultdict(list)
        for item in self._archive.find(f"{KEPT}.*", START_PATIENCE_S) or ():
            past[item.key.rpartition(".")[2]].append(item)
        self._leftovers = {switch: leftovers(items, wanted) for switch, items in past.items()}

    def tick(self) -> None:
        """Floods are judged when their handshakes had time; known sources go out in batches."""
        with self._lock:
            self._look_at_what_is_due()
            self._reset()
            updates = self._known.changes()
            for switch in self._switches if updates else ():
                self._command(switch, updates)
            self._say_notices()
        self._read_archived_words()

    def stop(self) -> None:
        """Events are delivered; blocks stay in force, as the archive says."""
        with self._lock:
            self._stopped = True
        self._announcer.close()

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return {
            **self._counts,
            "blocks": len(self._ledger.blocks),
            "guarded": [str(service) for service in self._syn.guarded],
            "guards": len(self._syn.guarded),
            "known_sources": len(self._known),
            "allowed": len(self._desk.entries),
            "allowed_left_out": self._allow_entries.left_out,
            "refused_by_cap": self._ledger.refused,
            "blocking_stopped": int(bool(self._ledger.stopped)),
            "stopped_by": self._ledger.stopped,
            "syns_kept": len(self._syn.recent),
            "resets": self._resets.sent,
            "resets_spared": self._resets.spared,
            "resets_left_out": self._resets.left_out,
            "resets_waited_out": self._resets.waited_out,
            "bindings": len(self._bindings),
            "archive_away": self._archive.unanswered,
            **self._announcer.health(),
        }

    # -- people -------------------------------------------------------------------------------

    def _on_instruction(self, item: Item) -> None:
        instruction = Instruction.from_value(item.value)
        with self._lock:
            if instruction.id in self._carried_out:
                return  # sent again after a restart, of us or of Data Updates
            answer = self._carry_out(instruction, item)
        self._engine.write(f"{ANSWERS}.{item.key.split('.')[2]}", answer.to_value(), [due.NO_WAIT])

    def _carry_out(self, instruction: Instruction, item: Item) -> Answer:
        summary = f"{instruction.verb} {instruction.subject}: {instruction.reason}"
        evidence = Evidence(key=item.key, timestamp=item.timestamp, summary=summary)
        self._carried_out.append(instruction.id)
        decisions, answer = self._desk.carry_out(instruction, evidence, self._now or item.event_time)
        for decision in decisions:
            self._publish(decision)
        updates = self._allow_entries.change(self._desk.entries)
        for switch in self._switches if updates else ():
            self._keep(switch, updates)
        return answer

    def _read_archived_words(self) -> None:
        """`blocks panic` while Data Updates were away is in the archive only."""
        items = self._archive.look(newer_than(INSTRUCTIONS, self._words_since), ARCHIVED_WORD_S)
        with self._lock:
            for item in items:
                self._words_since = max(self._words_since, item.timestamp)
                for instruction in instructions_in([item]):
                    if instruction.verb == "panic" and instruction.id not in self._carried_out:
                        self._carry_out(instruction, item)

    # -- SYN floods ---------------------------------------------------------------------------

    def _on_handshake(self, item: Item) -> None:
        value = item.value
        with self._lock:
            self._counts["handshakes"] += 1
            service = Service(str(value["service"]), int(value["port"]))
            self._syn.handshake(str(value["source"]), service, int(value["at"]))

    def _on_flood(self, item: Item) -> None:
        host = str(item.value["dst"])
        summary = f"{item.value['count']} half-open connections came up towards {host} within a window"
        evidence = Evidence(key=item.key, timestamp=item.timestamp, summary=summary)
        with self._lock:
            self._look(Suspicion(host, evidence, item.event_time, int(item.value["window_start"])))

    def _on_syns(self, item: Item) -> None:
        rules = self._settings.syn
        with self._lock:
            self._counts["syns"] += len(item.value)
            self._syns_until = max(self._syns_until, item.event_time)
            self._now = max(self._now, item.event_time)
            self._syn.recent.add(item.value)
            for host, since in self._surges.add(item.value):
                summary = f"{rules.threshold} SYNs went to {host} within {rules.window_ms} ms"
                evidence = Evidence(key=item.key, timestamp=item.timestamp, summary=summary)
                due_at = time.monotonic() + rules.grace_ms / 1000
                if len(self._suspected) < HOSTS_WATCHED and host not in self._suspected:
                    self._suspected[host] = due_at, Suspicion(host, evidence, item.event_time, since)
                    self._look_later(rules.grace_ms / 1000)
            self._look_at_what_is_due()

    def _on_syn_acks(self, item: Item) -> None:
        with self._lock:
            self._counts["syn_acks"] += len(item.value)
            self._answers.add(item.value, time.monotonic())

    def _look_later(self, seconds: float) -> None:
        """The next tick may come 50 ms after that, and the next SYN never."""
        timer = threading.Timer(seconds, self._wake)
        timer.daemon = True
        timer.start()

    def _wake(self) -> None:
        with self._lock:
            if not self._stopped:
                self._look_at_what_is_due()

    def _look_at_what_is_due(self) -> None:
        now = time.monotonic()
        # where packets come late they come in heaps: then capture time has the patience behind it
        seen = self._syns_until - self._settings.syn.grace_ms * 1_000_000
        for host, (due_at, suspicion) in list(self._suspected.items()):
            if due_at <= now or suspicion.now < seen:
                self._look(self._suspected.pop(host)[1])
        for host in [host for host, (due_at, _) in self._undecided.items() if due_at <= now]:
            suspicion = self._undecided.pop(host)[1]
            self._look(replace(suspicion, now=max(self._now, suspicion.now)), sure=True)

    def _look(self, suspicion: Suspicion, *, sure: bool = False) -> None:
        """Look at the SYNs of a suspected flood, and decide."""
        watch = self._syn.suspect(suspicion)
        decisions = self._syn.conclude(
            watch, self._offences(watch.often(self._settings.syn), watch.now) if sure else {}, sure=sure
        )
        for decision in decisions:
            # the guard that came before a block has had the source's connections reset
            self._publish(decision, resets=False)
            if decision.action == "protect" and not decision.dry_run:
                target = decision.target
                wanted = Wanted(Service(target.address, target.port or 0), since=suspicion.since)
                self._resets.plan(decision.id, wanted, time.monotonic())
        if watch.unsure and len(self._undecided) < HOSTS_WATCHED:
            due_at = time.monotonic() + self._settings.syn.patience_ms / 1000
            self._undecided.setdefault(suspicion.host, (due_at, suspicion))

    def _offences(self, addresses: Sequence[str], now: int) -> dict[str, int] | None:
        """Earlier blocks by address; None where the archive does not answer."""
        if not addresses:
            return {}
        items = self._archive.find(offences_of_many(addresses))
        if items is None:
            return None
        return {
            address: count_offences(items, Target(kind="ip", address=address), now) for address in addresses
        }

    def _reset(self) -> None:
        halves = self._resets.due(time.monotonic(), sorted(self._switches), self._syn.spared)
        for switch in self._switches if halves else ():
            for value in packet_outs(halves):
                self._engine.write(f"network.packet_out.firewall.{switch}", value, [due.NO_WAIT])
        while self._resets.notes:
            note = self._resets.notes.popleft()
            self._announcer.say(Notice("resets", f"{note.decision}: {note.text}", self._now), logging.INFO)

    # -- ARP ----------------------------------------------------------------------------------

    def _on_arp(self, item: Item) -> None:
        with self._lock:
            for theft in self._bindings.add(item.value):
                self._counts["arp_thefts"] += 1
                self._on_theft(theft, item)

    def _on_theft(self, theft: Theft, item: Item) -> None:
        thief, owner = theft.thief, theft.owner
        summary = f"{thief.text} on port {thief.port} claims {theft.address}, which is {owner.text} on port {owner.port}"
        target = Target(kind="mac", address=thief.text, port=thief.port)
        spared = self._why_spared(theft, target)
        if spared:
            self._announcer.say(Notice("arp", f"{summary}; not blocked: {spared}", theft.at))
        elif not any(block.decision.target == target for block in self._ledger.blocks.values()):
            switch = next(iter(self._switches))
            evidence = (Evidence(key=item.key, timestamp=item.timestamp, summary=summary),)
            self._publish(self._ledger.open(switch, target, f"{summary}, and is there", evidence, theft.at))

    def _why_spared(self, theft: Theft, target: Target) -> str:
        """Why the thief of an address is not blocked; empty where it is."""
        if self._settings.arp == "tell":
            return "the settings want it told only"
        if not theft.certain:
            return "the owner was not there in training, or others share the port and it may be one of them"
        if len(self._switches) != 1:
            return f"{len(self._switches)} switches are there, and records do not say which"
        allow = self._desk.allow
        mine = self._bindings.addresses_of(theft.thief)
        if allow.covers_target(target) or any(allow.covers_address(each) for each in mine):
            return "it is on the allow-list"
        cap = self._ledger.cap_reached(theft.at)
        if cap:
            self._ledger.refuse(cap, target.address, theft.at)
        return cap or ""

    # -- anomalies ----------------------------------------------------------------------------

    def _on_alert(self, item: Item) -> None:
        with self._lock:
            self._judge(item, Alert.from_value(item.value))

    def _judge(self, item: Item, alert: Alert) -> None:
        self._counts["alerts"] += 1
        self._announcer.event(alert_line(alert))
        self._lapse(alert.event_time)
        evidence = self._remember(item, alert)
        if self._ledger.covering(alert.sender) is not None:
            return
        probation = self._ledger.on_probation(alert.sender, alert.event_time)
        verdict = judge(alert, self._rules, self._desk.allow, on_probation=probation)
        verdict = self._unforged(alert, verdict)
        if verdict.target is None:
            log.info("no block of %s: %s", alert.sender, verdict.reason)
            return
        cap = self._ledger.cap_reached(alert.event_time, alert.sender.ip)
        if cap is not None:
            self._ledger.refuse(cap, alert.sender.ip or alert.sender.mac, alert.event_time)
            self._say_notices()
            return
        earlier = self._archive.find(offences_query(verdict.target))
        reason = verdict.reason if earlier is not None else f"{verdict.reason} ({UNKNOWN_HISTORY})"
        offences = count_offences(earlier or (), verdict.target, alert.event_time)
        self._publish(self._ledger.block(alert, verdict.target, reason, evidence, offences))
        for decision in gather_blocks(self._ledger, self._syn.gather, alert.event_time):
            self._publish(decision)

    def _unforged(self, alert: Alert, verdict: Verdict) -> Verdict:
        """An address that others can forge is not blocked; its forger is, where that is clear."""
        target, sender = verdict.target, alert.sender
        if target is None or target.kind != "ip":
            return verdict
        station = Station.of(sender.port, sender.mac)
        if self._bindings.forged(target.address, station):
            if self._bindings.is_alone(station):
                forger = Target(kind="mac", address=sender.mac, port=sender.port)
                return Verdict(
                    forger, f"{verdict.reason}; {target.address} belongs to another, so its forger is"
                )
            return Verdict(None, f"{target.address} belongs to another, and its forger shares a port")
        if target.address in self._known and not self._rules.block_known_addresses:
            return Verdict(None, f"{target.address} is known from handshakes and may be forged")
        return verdict

    def _remember(self, item: Item, alert: Alert) -> deque[Evidence]:
        if len(self._evidence) >= SENDERS_KEPT and alert.sender not in self._evidence:
            self._evidence.pop(next(iter(self._evidence)))
        evidence = self._evidence[alert.sender]
        evidence.append(Evidence(key=item.key, timestamp=item.timestamp, summary=alert.reason))
        return evidence

    # -- switches -----------------------------------------------------------------------------

    def _keep(self, switch: str, updates: Iterable[TableUpdate], name: str = "") -> None:
        """Entries that outlive the controller."""
        self._command(switch, updates, name, KEPT)

    def _command(
        self, switch: str, updates: Iterable[TableUpdate], name: str = "", key: str = COMMAND
    ) -> None:
        for batch in in_batches(updates):
            command = TableCommand(id=name or f"firewall-{uuid4().hex[:12]}", updates=batch)
            self._engine.write(f"{key}.{switch}", command.to_value(), [due.NO_WAIT])

    def _arm(self, item: Item) -> None:
        """A switch has come under control, or its controller began anew: what the switch has to have of us."""
        switch = str(item.value["switch"])
        if not item.value.get("primary"):
            self._switches.pop(switch, None)
            return
        if self._switches.get(switch) == item.instance_id:
            return
        self._switches[switch] = item.instance_id
        self._keep(switch, self._leftovers.pop(switch, []))
        self._keep(switch, self._allow_entries.everything())
        for decision in self._syn.arm(switch, int(item.value.get("event_time", 0)) or item.event_time):
            self._publish(decision)
        for block in self._ledger.blocks.values():
            if is_prefix(block.decision.target):
                self._carry_out_prefix(block.decision, [switch])
        self._command(switch, self._known.everything())

    def _on_confirmation(self, item: Item) -> None:
        confirmation = Confirmation.from_value(item.value)
        with self._lock:
            self._ledger.confirm(confirmation)
            self._resets.confirm(confirmation.id, confirmation.state, time.monotonic())
        if confirmation.state == "failed":
            log.error("switch %s refused %s: %s", confirmation.switch, confirmation.id, confirmation.cause)

    def _on_switch(self, item: Item) -> None:
        now = int(item.value.get("event_time", 0))
        with self._lock:
            self._now = max(self._now, now)
            for reading in item.value.get("blocks", ()):
                self._ledger.count_drops(str(reading["id"]), int(reading["packets"]), now)
            self._arm(item)
            self._lapse(now)

    def _lapse(self, now: int) -> None:
        for decision in [*self._ledger.due(now), *self._syn.due(now)]:
            self._publish(decision)

    # -- what goes out ------------------------------------------------------------------------

    def _publish(self, decision: Decision, *, resets: bool = True) -> None:
        target = decision.target
        kind = ("ipv6" if ":" in target.address else "ipv4") if target.kind == "ip" else "mac"
        log.warning("%s %s: %s", decision.action, target.address, decision.reason)
        self._announcer.event(decision_line(decision), important=True)
        family = "protect" if decision.action in ("protect", "unprotect") else "block"
        if is_prefix(target):
            family = "block_prefix"
            self._carry_out_prefix(decision, self._switches)
        elif resets and decision.action == "block" and target.kind == "ip" and not decision.dry_run:
            self._resets.plan(decision.id, Wanted(source=target.address), time.monotonic())
        self._engine.write(
            f"network.{family}.firewall.{kind}",
            decision.to_value(),
            [due.NO_WAIT],
            event_time=decision.event_time,
        )

    def _carry_out_prefix(self, decision: Decision, switches: Iterable[str]) -> None:
        if decision.dry_run:
            return
        kind = "insert" if decision.action == "block" else "delete"
        for switch in switches:
            if decision.switch in (EVERY_SWITCH, switch):
                self._keep(switch, [prefix_update(kind, decision.target.address)], decision.id)

    def _say_notices(self) -> None:
        counts = self._counts
        if counts["syns"] > ONE_DIRECTION and not counts["syn_acks"] + counts["handshakes"]:
            counts["syn_acks_missing"] = counts.get("syn_acks_missing", 0) + 1
            if counts["syn_acks_missing"] == 1:
                text = (
                    f"{counts['syns']:,} SYNs and no SYN-ACK: nobody answers, or only one direction passes the switch;"
                    " then nobody becomes known, and half-open connections wait for the server's own time-out"
                )
                self._announcer.say(Notice("one_direction", text, self._now))
        while self._ledger.notices:
            self._announcer.say(self._ledger.notices.popleft(), logging.ERROR)


def _bindings(settings: Settings) -> Bindings:
    return Bindings(
        training_s=settings.arp_training_s,
        settle_s=settings.arp_settle_s,
        contest_s=settings.arp_contest_s,
    )


def _surroundings() -> tuple[str, ...]:
    found: list[str] = []
    for path, addresses_in in SOURCES:
        try:
            found += addresses_in(Path(path).read_text(encoding="ascii", errors="replace"))
        except OSError as error:
            log.warning("%s: %s; its addresses are not on the allow-list", path, error.strerror)
    log.info("allowed from the start: %s", ", ".join(worth_allowing(found)) or "nothing")
    return worth_allowing(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the firewall until it is told to stop."""
    return due.service.run("firewall", FirewallService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
