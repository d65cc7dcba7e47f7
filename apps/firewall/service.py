"""The firewall as a DUE app: alerts, floods and handshakes in, decisions out.

All callbacks run in DUE's dispatcher thread, ticks in the main thread; one lock keeps them apart.
"""

import logging
import sys
import threading
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import msgspec

import due.service
from apps.firewall.eve import alert_line, decision_line
from apps.firewall.history import (
    DECISIONS,
    INSTRUCTIONS,
    count_offences,
    decisions_in,
    in_force,
    offences_of_many,
    offences_query,
)
from apps.firewall.instructions import Desk
from apps.firewall.known_sources import HANDSHAKES, KnownSources, in_batches, learn_archived
from apps.firewall.ledger import Ledger
from apps.firewall.policy import AllowList, Rules, judge
from apps.firewall.recent_syns import Surges
from apps.firewall.services import Service
from apps.firewall.surroundings import gateways, name_servers, own_addresses, worth_allowing
from apps.firewall.syn_defence import Suspicion, SynDefence
from apps.firewall.syn_policy import SynRules
from apps.messages import (
    Alert,
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
from due.errors import DueError

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
)
"""Registered by observing, with parameters of the settings, where the settings want them."""
CAPABILITIES = (
    Capability("network.block.firewall.ipv4", delivery="reliable", archive="always"),
    Capability("network.block.firewall.ipv6", delivery="reliable", archive="always"),
    Capability("network.block.firewall.mac", delivery="reliable", archive="always"),
    Capability("network.protect.firewall.ipv4", delivery="reliable", archive="always"),
    Capability("network.protect.firewall.ipv6", delivery="reliable", archive="always"),
    Capability("network.p4_command.firewall.*", delivery="reliable"),
    Capability("network.answer.firewall.*", delivery="reliable"),
)

EVIDENCE_KEPT = 10
SENDERS_KEPT = 10_000
HOSTS_WATCHED = 64
_SURROUNDINGS = {
    "/proc/net/fib_trie": own_addresses,
    "/proc/net/route": gateways,
    "/etc/resolv.conf": name_servers,
}

log = logging.getLogger(__name__)


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the firewall."""

    rules: Rules = Rules()
    syn: SynRules = SynRules()
    guard: tuple[str, ...] = ()
    """Services guarded from the start: ADDRESS:PORT, IPv6 addresses in brackets."""
    detect: bool = True
    """Ask the switch for SYN floods (needs the Sonata adapter)."""
    learn: bool = True
    """Learn known sources from completed handshakes (needs the Sonata adapter, and both directions)."""
    known_limit: int = 4000
    """Known sources in the switch, the most recent ones."""
    known_days: int = 30
    """A handshake counts for so long."""
    allow_surroundings: bool = False
    """Never block this machine's own addresses, gateways and DNS servers; off in replays, whose captures
    come from elsewhere."""
    eve_file: str = ""
    """Alerts and decisions are appended here as EVE JSON, a line each; empty: nowhere."""


class FirewallService:
    """Turns alerts into decisions; all state but the evidence is in the ledger."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._rules = settings.rules
        self._ledger = Ledger(settings.rules)
        self._evidence: defaultdict[Sender, deque[Evidence]] = defaultdict(
            lambda: deque(maxlen=EVIDENCE_KEPT)
        )
        self._alerts = 0
        self._settings = settings
        services = tuple(Service.parse(text) for text in settings.guard)
        self._known = KnownSources(settings.known_limit)
        allowed = (*settings.rules.allow, *(_surroundings() if settings.allow_surroundings else ()))
        self._syn = SynDefence(settings.syn, services, self._ledger, AllowList.parse(allowed), self._known)
        self._desk = Desk(self._ledger, self._syn, allowed)
        self._switches: dict[str, bool] = {}
        self._surges = Surges(settings.syn.threshold, settings.syn.window_ms)
        self._suspected: dict[str, tuple[float, Suspicion]] = {}
        """By host: when to look, wall clock, and at what."""
        self._lock = threading.RLock()
        self._archive_away = 0
        self._eve_failed = 0
        self._now = 0
        """Capture time, as the switches last said."""

    def start(self) -> None:
        """Take up history, then subscribe."""
        observe = self._engine.observe
        self._take_up_history()
        if self._settings.learn:
            learn_archived(self._known, self._archived(HANDSHAKES), self._settings.known_days)
            self._known.changes()
            log.info("%d known sources in the archive", len(self._known))
            observe(HANDSHAKES).subscribe(self._on_handshake)
        observe("network.anomaly.kitsune.alert").subscribe(self._on_alert)
        observe("network.confirmation.p4runtime_ctrl.*").subscribe(self._on_confirmation)
        observe("network.switch.p4runtime_ctrl.*").subscribe(self._on_switch)
        observe(INSTRUCTIONS).subscribe(self._on_instruction)
        if self._settings.detect:
            rules = self._settings.syn
            specs = {"window": f"{rules.window_ms}ms", "threshold": str(rules.threshold)}
            key = Key("network.traffic_query.sonata.syn_flood").with_specs(**specs).text
            observe(key).subscribe(self._on_flood)
            observe(Key("network.traffic_capture.sonata.tcp").with_specs(flag="syn").text).subscribe(
                self._on_syns
            )

    def _take_up_history(self) -> None:
        """What was in force before a restart is in force again, in our books as it is in the switch."""
        instructions = [Instruction.from_value(item.value) for item in self._archived(INSTRUCTIONS)]
        self._desk.take_up(instructions)
        standing = in_force(decisions_in(item for key in DECISIONS for item in self._archived(key)))
        self._ledger.restore(standing)
        self._syn.restore(standing)
        if standing:
            log.info("%d decisions of the archive are in force", len(standing))

    def tick(self) -> None:
        """Surges of SYNs are judged when their handshakes had time; known sources go out in batches."""
        with self._lock:
            now = time.monotonic()
            for host in [host for host, (due_at, _) in self._suspected.items() if due_at <= now]:
                self._look(self._suspected.pop(host)[1])
            updates = self._known.changes()
            for switch in self._switches if updates else ():
                self._command(switch, updates)

    def stop(self) -> None:
        """Nothing to wind down: blocks stay in force, as the archive says."""

    def health(self) -> dict[str, Any]:
        """Counters for the operator."""
        return {
            "alerts": self._alerts,
            "blocks": len(self._ledger.blocks),
            "guarded": [str(service) for service in self._syn.guarded],
            "known_sources": len(self._known),
            "refused_by_cap": self._ledger.refused + self._syn.refused,
            "archive_away": self._archive_away,
            "events_lost": self._eve_failed,
        }

    def _archived(self, query: Any) -> list[Item]:
        """What the archive has; nothing, and a note, while it is away."""
        try:
            return self._engine.get(query)
        except DueError as error:
            self._archive_away += 1
            log.warning("Data Archives do not answer, deciding without history: %s", error)
            return []

    def _on_instruction(self, item: Item) -> None:
        instruction = Instruction.from_value(item.value)
        summary = f"{instruction.verb} {instruction.subject}: {instruction.reason}"
        evidence = Evidence(key=item.key, timestamp=item.timestamp, summary=summary)
        with self._lock:
            decisions, answer = self._desk.carry_out(instruction, evidence, self._now or item.event_time)
            for decision in decisions:
                self._publish(decision)
        asked_by = item.key.split(".")[2]
        self._engine.write(f"network.answer.firewall.{asked_by}", answer.to_value(), [due.NO_WAIT])

    def _on_handshake(self, item: Item) -> None:
        value = item.value
        with self._lock:
            service = Service(str(value["service"]), int(value["port"]))
            self._syn.handshake(str(value["source"]), service, int(value["at"]))

    def _on_flood(self, item: Item) -> None:
        host = str(item.value["dst"])
        summary = f"{item.value['count']} half-open connections came up towards {host} within a window"
        evidence = Evidence(key=item.key, timestamp=item.timestamp, summary=summary)
        with self._lock:
            self._look(Suspicion(host, evidence, item.event_time, int(item.value["window_start"])))

    def _on_syns(self, item: Item) -> None:
        with self._lock:
            self._syn.recent.add(item.value)
            for host, since in self._surges.add(item.value):
                rules = self._settings.syn
                summary = f"{rules.threshold} SYNs went to {host} within {rules.window_ms} ms"
                evidence = Evidence(key=item.key, timestamp=item.timestamp, summary=summary)
                due_at = time.monotonic() + rules.grace_ms / 1000
                if len(self._suspected) < HOSTS_WATCHED:
                    suspicion = Suspicion(host, evidence, item.event_time, since)
                    self._suspected.setdefault(host, (due_at, suspicion))

    def _look(self, suspicion: Suspicion) -> None:
        """Look at the SYNs of a suspected flood, and decide."""
        watch = self._syn.suspect(suspicion)
        often = watch.repeating(self._settings.syn.repeats)[: self._settings.syn.sources]
        earlier = self._archived(offences_of_many(often)) if often else []
        targets = {source: Target(kind="ip", address=source) for source in often}
        offences = {source: count_offences(earlier, target, watch.now) for source, target in targets.items()}
        for decision in self._syn.conclude(watch, offences):
            self._publish(decision)

    def _command(self, switch: str, updates: Iterable[TableUpdate]) -> None:
        for batch in in_batches(updates):
            command = TableCommand(id=f"firewall-{uuid4().hex[:12]}", updates=batch)
            self._engine.write(f"network.p4_command.firewall.{switch}", command.to_value(), [due.NO_WAIT])

    def _arm(self, item: Item) -> None:
        """A switch has come under control, for the first time or again: its guards and known sources."""
        switch, ready = str(item.value["switch"]), bool(item.value.get("primary"))
        before, self._switches[switch] = self._switches.get(switch, False), ready
        if not ready or before:
            return
        for decision in self._syn.arm(switch, int(item.value.get("event_time", 0)) or item.event_time):
            self._publish(decision)
        self._command(switch, self._known.everything())

    def _on_alert(self, item: Item) -> None:
        with self._lock:
            self._judge(item, Alert.from_value(item.value))

    def _judge(self, item: Item, alert: Alert) -> None:
        self._alerts += 1
        self._log_event(alert_line(alert))
        self._lapse(alert.event_time)
        evidence = self._remember(item, alert)
        if self._ledger.covering(alert.sender) is not None:
            return
        probation = self._ledger.on_probation(alert.sender, alert.event_time)
        verdict = judge(alert, self._rules, self._desk.allow, on_probation=probation)
        if verdict.target is None:
            log.info("no block of %s: %s", alert.sender, verdict.reason)
            return
        cap = self._ledger.cap_reached(alert.event_time)
        if cap is not None:
            self._ledger.refused += 1
            log.error("BLOCKING STOPPED, %s: %s stays unblocked", cap, alert.sender)
            return
        earlier = self._archived(offences_query(verdict.target))
        offences = count_offences(earlier, verdict.target, alert.event_time)
        self._publish(self._ledger.block(alert, verdict.target, verdict.reason, evidence, offences))

    def _remember(self, item: Item, alert: Alert) -> deque[Evidence]:
        if len(self._evidence) >= SENDERS_KEPT and alert.sender not in self._evidence:
            self._evidence.pop(next(iter(self._evidence)))
        evidence = self._evidence[alert.sender]
        evidence.append(Evidence(key=item.key, timestamp=item.timestamp, summary=alert.reason))
        return evidence

    def _on_confirmation(self, item: Item) -> None:
        confirmation = Confirmation.from_value(item.value)
        with self._lock:
            self._ledger.confirm(confirmation)
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

    def _log_event(self, line: str) -> None:
        if not self._settings.eve_file:
            return
        try:
            with Path(self._settings.eve_file).open("a", encoding="utf-8") as events:
                events.write(line + "\n")
        except OSError as error:
            self._eve_failed += 1
            log.error("%s: %s; the event is lost to it", self._settings.eve_file, error.strerror)  # noqa: TRY400

    def _publish(self, decision: Decision) -> None:
        kind = decision.target.kind
        kind_segment = ("ipv6" if ":" in decision.target.address else "ipv4") if kind == "ip" else "mac"
        log.warning("%s %s: %s", decision.action, decision.target.address, decision.reason)
        self._log_event(decision_line(decision))
        family = "protect" if decision.action in ("protect", "unprotect") else "block"
        self._engine.write(
            f"network.{family}.firewall.{kind_segment}",
            decision.to_value(),
            [due.NO_WAIT],
            event_time=decision.event_time,
        )


def _surroundings() -> tuple[str, ...]:
    found: list[str] = []
    for path, addresses_in in _SURROUNDINGS.items():
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
