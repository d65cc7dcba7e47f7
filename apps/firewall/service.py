"""The firewall as a DUE app: alerts in, decisions out."""

import logging
import sys
from collections import defaultdict, deque
from collections.abc import Sequence
from typing import Any

import msgspec

import due.service
from apps.firewall.history import count_offences, offences_query
from apps.firewall.ledger import Ledger
from apps.firewall.policy import AllowList, Rules, judge
from apps.messages import Alert, Confirmation, Decision, Evidence, Sender
from due import Capability, Engine, Interest, Item

INTERESTS = (
    Interest("network.anomaly.kitsune.alert"),
    Interest("network.confirmation.p4runtime_ctrl.*"),
    Interest("network.switch.p4runtime_ctrl.*"),
)
CAPABILITIES = (
    Capability("network.block.firewall.ipv4", delivery="reliable", archive="always"),
    Capability("network.block.firewall.ipv6", delivery="reliable", archive="always"),
    Capability("network.block.firewall.mac", delivery="reliable", archive="always"),
)

EVIDENCE_KEPT = 10
SENDERS_KEPT = 10_000

log = logging.getLogger(__name__)


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the firewall."""

    rules: Rules = Rules()


class FirewallService:
    """Turns alerts into decisions; all state but the evidence is in the ledger."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._rules = settings.rules
        self._allow_list = AllowList.parse(settings.rules.allow)
        self._ledger = Ledger(settings.rules)
        self._evidence: defaultdict[Sender, deque[Evidence]] = defaultdict(lambda: deque(maxlen=EVIDENCE_KEPT))
        self._alerts = 0

    def start(self) -> None:
        """Subscribe."""
        self._engine.observe("network.anomaly.kitsune.alert").subscribe(self._on_alert)
        self._engine.observe("network.confirmation.p4runtime_ctrl.*").subscribe(self._on_confirmation)
        self._engine.observe("network.switch.p4runtime_ctrl.*").subscribe(self._on_switch)

    def tick(self) -> None:
        """Nothing runs on wall time here."""

    def stop(self) -> None:
        """Nothing to wind down: blocks stay in force, as the archive says."""

    def health(self) -> dict[str, Any]:
        """Counters for the operator."""
        return {
            "alerts": self._alerts,
            "blocks": len(self._ledger.blocks),
            "refused_by_cap": self._ledger.refused,
        }

    def _on_alert(self, item: Item) -> None:
        alert = Alert.from_value(item.value)
        self._alerts += 1
        self._lapse(alert.event_time)
        evidence = self._remember(item, alert)
        if self._ledger.covering(alert.sender) is not None:
            return
        probation = self._ledger.on_probation(alert.sender, alert.event_time)
        verdict = judge(alert, self._rules, self._allow_list, on_probation=probation)
        if verdict.target is None:
            log.info("no block of %s: %s", alert.sender, verdict.reason)
            return
        cap = self._ledger.cap_reached(alert.event_time)
        if cap is not None:
            self._ledger.refused += 1
            log.error("BLOCKING STOPPED, %s: %s stays unblocked", cap, alert.sender)
            return
        earlier = self._engine.get(offences_query(verdict.target))
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
        self._ledger.confirm(confirmation)
        if confirmation.state == "failed":
            log.error("switch %s refused %s: %s", confirmation.switch, confirmation.id, confirmation.cause)

    def _on_switch(self, item: Item) -> None:
        now = int(item.value.get("event_time", 0))
        for reading in item.value.get("blocks", ()):
            self._ledger.count_drops(str(reading["id"]), int(reading["packets"]), now)
        self._lapse(now)

    def _lapse(self, now: int) -> None:
        for decision in self._ledger.due(now):
            self._publish(decision)

    def _publish(self, decision: Decision) -> None:
        kind = decision.target.kind
        if kind == "ip":
            kind_segment = "ipv6" if ":" in decision.target.address else "ipv4"
        else:
            kind_segment = "mac"
        log.warning("%s %s: %s", decision.action, decision.target.address, decision.reason)
        self._engine.write(
            f"network.block.firewall.{kind_segment}",
            decision.to_value(),
            [due.NO_WAIT],
            event_time=decision.event_time,
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the firewall until it is told to stop."""
    return due.service.run("firewall", FirewallService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
