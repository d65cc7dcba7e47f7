"""What a replay hears over DUE of the loop that it feeds; callbacks run in the engine's thread.

    scores, alerts, evidence, results of queries, decisions, confirmations, switch states, incidents ──► LoopObserver

A replay may be a hundred times as fast as its capture.  What it decides must not depend on that, so the feeder asks
here whether everything that it has sent is judged: Kitsune says with each score how much evidence it has written, the
firewall how much of it has been heard and how many decisions it has written by then, and the switch confirms those.
What may lead to a decision is a *sign*: those of a dry run tell the pass after it where all this matters.  Alerts are
none: under the rule that a replay has, they decide nothing.
"""

import threading
import time
from typing import TYPE_CHECKING, Any, Final

from apps.evidence import EVIDENCE, JUDGED, Judged
from apps.incidents import INCIDENTS, Incident
from apps.messages import Alert, Confirmation, Decision
from apps.sonata_adapter.keys import HANDSHAKE, QUERY_PREFIX
from due import Engine, Item
from sdnator.replay.quiet_stretches import ENDING, STOPPING, QuietStretches, Sign, sign_of

if TYPE_CHECKING:
    from sdnator.replay.loop import PassResult

CONFIRM_SECONDS: Final = 5.0
"""Seconds that an answer of the firewall or the switch is waited for."""
JUDGING: Final = f"{JUDGED}.firewall"
SUSPICIONS: Final = f"{EVIDENCE}.kitsune.*"
REPORTS: Final = f"{QUERY_PREFIX}.*"
"""Results of the queries that others have asked for: after one the firewall has the switch sample SYNs."""
_DECIDED: Final = ("block", "unblock", "protect", "unprotect", "meter", "unmeter")
"""Actions of confirmed decisions; prefixes are blocked by commands that carry the decision's id."""


class LoopObserver:
    """Keeps what comes in a `PassResult`, and knows what is still to come.

    Args:
        result: of the pass; `moved` guards it.
        quiet: what a dry run has told about it; None if there was none.
    """

    def __init__(self, result: "PassResult", quiet: QuietStretches | None = None) -> None:
        self._result = result
        self._quiet = quiet
        self.moved = threading.Condition()
        self.switch: dict[str, Any] = {}
        self.blocks = 0
        self.last = time.monotonic()
        """When the last alert, decision or confirmation came."""
        self._decided: set[str] = set()
        self._unanswered: dict[str, float] = {}
        """Decisions on their way to the switch, and until when an answer is waited for."""
        self._early: dict[str, float] = {}
        """Answers that came before their decisions, and when: they come under keys of their own."""
        self._ends: dict[str, int] = {}
        """When the blocks and limits in force end, by id."""
        self.is_free = False
        """Whether what was sent last was sent without regard to what may be decided."""
        self._found = 0
        """Pieces of evidence that Kitsune has written ..."""
        self._found_at = 0.0
        """... since when, by the wall's clock, ..."""
        self._judged = 0
        """... and that the firewall has judged."""
        self._taken = 0
        """Decisions of the firewall when it had done so ..."""
        self._heard = 0
        """... and that came here."""

    def is_judging(self) -> bool:
        """Whether evidence of what was sent is still to be judged, or what was decided about it to come."""
        if self._judged >= self._found and self._heard >= self._taken:
            return False
        if time.monotonic() - self._found_at < CONFIRM_SECONDS:
            return True
        self._judged, self._heard = self._found, self._taken  # lost: go on without it
        return False

    def is_deciding(self) -> bool:
        """Whether a decision that changes what the switch drops is on its way there."""
        now = time.monotonic()
        return any(now < until for until in self._unanswered.values())

    def next_end(self) -> int | None:
        """Capture time at which the first of the blocks and limits in force ends, ns; None if none does."""
        return min(self._ends.values(), default=None)

    def give_up_end(self, time_ns: int) -> None:
        """Nobody has lifted or extended what ends at this time: do not wait for it any more."""
        self._ends = {name: at for name, at in self._ends.items() if at > time_ns}

    def subscribe(self, engine: Engine) -> None:
        """Hear scores, alerts, decisions, confirmations, states of the switch and incidents."""
        engine.observe(JUDGING).subscribe(self._on_judged)
        engine.observe("network.anomaly.kitsune.score").subscribe(self._on_score)
        engine.observe("network.anomaly.kitsune.alert").subscribe(self._on_alert)
        engine.observe(SUSPICIONS).subscribe(self._on_evidence)
        for kind in ("block", "block_prefix", "protect", "meter"):
            engine.observe(f"network.{kind}.firewall.*").subscribe(self._on_decision)
        engine.observe("network.confirmation.p4runtime_ctrl.*").subscribe(self._on_confirmation)
        engine.observe("network.switch.p4runtime_ctrl.*").subscribe(self._on_switch)
        engine.observe(INCIDENTS).subscribe(self._on_incident)

    def subscribe_queries(self, engine: Engine) -> None:
        """Hear completed handshakes, and what queries report."""
        engine.observe(HANDSHAKE).subscribe(self._on_handshake)
        engine.observe(REPORTS).subscribe(self._on_report)

    def _on_score(self, item: Item) -> None:
        value = item.value
        with self.moved:
            self._result.flight.scored(value["arrival"], value["score"], value["state"] == 0)
            if value["evidence"] > self._found:
                self._found, self._found_at = int(value["evidence"]), time.monotonic()
            self.moved.notify_all()

    def _on_alert(self, item: Item) -> None:
        alert = Alert.from_value(item.value)
        with self.moved:
            self._result.alerts.append(alert)
            self.last = time.monotonic()

    def _on_evidence(self, item: Item) -> None:
        with self.moved:
            self._note_sign(sign_of(item.value, item.event_time, judged=True))

    def _on_report(self, item: Item) -> None:
        with self.moved:
            self._note_sign(sign_of(item.value, item.event_time, judged=False))

    def _note_sign(self, sign: Sign) -> None:
        self._result.signs.append(sign)
        if self._quiet is not None:
            self._quiet.hear(sign)

    def _on_judged(self, item: Item) -> None:
        judged = Judged.from_value(item.value)
        with self.moved:
            if judged.app == "kitsune":
                self._judged, self._taken = judged.evidence, judged.decisions
            self.moved.notify_all()

    def _on_decision(self, item: Item) -> None:
        with self.moved:
            self._heard += 1
            decision = Decision.from_value(item.value)
            self._result.decisions.append(decision)
            self._decided.add(decision.id)
            if not decision.dry_run and decision.action in (*STOPPING, *ENDING):
                self._note_change(decision)
            else:
                self._note_sign(Sign(decision.event_time, (decision.target.address,)))
            self.last = time.monotonic()
            self.moved.notify_all()

    def _note_change(self, decision: Decision) -> None:
        """What the switch drops is to change."""
        self._result.signs.append(Sign(decision.event_time, (decision.target.address,)))
        if self._quiet is not None:
            self._quiet.decide(decision)
        self._result.overtaken += self.is_free
        now = time.monotonic()
        if now - self._early.pop(decision.id, 0.0) > CONFIRM_SECONDS:
            self._unanswered[decision.id] = now + CONFIRM_SECONDS
        if decision.action in STOPPING and decision.expires:
            self._ends[decision.id] = decision.expires
        else:
            self._ends.pop(decision.id, None)

    def _on_handshake(self, item: Item) -> None:
        with self.moved:
            self._result.handshakes.append((int(item.value["at"]), str(item.value["source"])))

    def _on_incident(self, item: Item) -> None:
        with self.moved:
            self._result.incidents.append(Incident.from_value(item.value))

    def _on_confirmation(self, item: Item) -> None:
        confirmation = Confirmation.from_value(item.value)
        with self.moved:
            if self._unanswered.pop(confirmation.id, None) is None:
                self._early[confirmation.id] = time.monotonic()
            if confirmation.action not in _DECIDED and confirmation.id not in self._decided:
                return  # of a command: an entry of a query, or a known source
            self.last = time.monotonic()
            self._result.confirmations.append(confirmation)
            self._result.confirmed_at.append(time.monotonic())
            self._result.confirmed_sent.append(self._result.flight.sent)
            self.moved.notify_all()
            if confirmation.state == "installed":
                self.blocks += 1

    def _on_switch(self, item: Item) -> None:
        with self.moved:
            self.switch = item.value
            self._result.lost_on_the_way = int(item.value["lost"])
            for block in item.value["blocks"]:
                self._result.drops_counted[str(block["id"])] = int(block["packets"])
            self.moved.notify_all()
