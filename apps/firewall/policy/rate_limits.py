"""Rate limits towards victims: which, how tight, and how long they last.  Pure; times are capture time in ns.

    flood of packets whose sources are forged, countless or innocent ─► rate limit of just these packets
    scan of a victim's ports in a name that anybody can forge ─► rate limit of SYNs to ports without a service
    it drops as much as half of what it lets pass ─► it goes on; else it is lifted when its time is over

The rate is what training saw of such packets from sources that cannot be named, with a margin; the busiest sources of
training are named, and each has a rate of its own beyond the limit.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from msgspec import structs

from apps.evidence import Evidence
from apps.firewall.policy.block_lifecycle import (
    MINUTE,
    NOTICES,
    SECOND,
    SET_BACK,
    OperatorNotice,
    decision_id,
    drops_per_second,
)
from apps.firewall.policy.rules import Rules
from apps.messages import MOST_OPEN_PORTS, Confirmation, Decision, Exhibit, FloodKind, RateLimit, Target

EVERY_SWITCH: Final = "*"
MARGIN: Final = 2.0
"""A limit is this many times what training saw ..."""
LEAST_RATE: Final = 20
"""... and never below this many packets a second: a page asks for tens of names."""
SCAN_RATE: Final = 5
"""SYNs a second to ports without a service: who has just started one gets through, and makes it known."""
MOST_LIMITS: Final = 256
"""Rate limits in force at a time: the switch program has room for as many."""
GOING_ON_SHARE: Final = 0.5
"""A flood goes on while the limit drops at least this share of its rate."""
_HIGHEST: Final = 1 << 31
_KINDS: Final[dict[str, FloodKind]] = {"from-udp": "udp_from", "udp": "udp_to", "tcp-ack": "tcp"}


def limit_of(pieces: Sequence[Evidence]) -> RateLimit | None:
    """The rate limit that fits a flood; None if the evidence does not say which packets it consists of.

    Args:
        pieces: the newest evidence of each source about one victim and service, at least one.
    """
    flood = _flood_of(pieces[0].service)
    if flood is None:
        return None
    # of several sources the one that knows most about training
    best = max(pieces, key=lambda each: (bool(each.usual_sources), usual_rate_of(each)))
    version = ":" in best.victims[0] if best.victims else False
    spared = tuple(each for each in best.usual_sources if (":" in each) == version)
    kind, port = flood
    return RateLimit(
        kind=kind,
        port=port,
        rate=_rate(usual_rate_of(best) * (1.0 - best.usual_share)),
        spared=spared,
        spared_rate=_rate(usual_rate_of(best)),
    )


def scan_limit_of(open_ports: Sequence[int]) -> RateLimit | None:
    """The rate limit that slows down a scan of a victim's TCP ports and none of its clients.

    Args:
        open_ports: ports of its services.

    Returns:
        None if there are too many for the switch program.
    """
    if len(open_ports) > MOST_OPEN_PORTS:
        return None
    return RateLimit(kind="syn", rate=SCAN_RATE, open_ports=tuple(sorted(open_ports)))


def usual_rate_of(evidence: Evidence) -> float:
    """The highest rate of such packets towards the victim in training."""
    return evidence.training_rate if evidence.sender is None else evidence.usual_rate


def _rate(packets: float) -> int:
    return min(max(LEAST_RATE, math.ceil(MARGIN * packets)), _HIGHEST)


def _flood_of(service: str) -> tuple[FloodKind, int | None] | None:
    if service in ("icmp", "udp"):
        return ("icmp" if service == "icmp" else "udp"), None
    name, _, port = service.partition("/")
    if name not in _KINDS or not port.isdecimal() or int(port) > 65_535:
        return None
    return _KINDS[name], int(port)


def limit_words(limit: RateLimit, training_rate: float) -> str:
    """What is limited to which rate, and why so much."""
    text = f"limited: {limit.words} to {limit.rate:,} packets/s (training saw {training_rate:,.0f} at most)"
    if not limit.spared:
        return text
    count = len(limit.spared)
    named = limit.spared[0] if count == 1 else f"{count} sources"
    each = "" if count == 1 else " each"
    return f"{text}; beyond it {named} of training {'has' if count == 1 else 'have'} {limit.spared_rate:,}/s{each}"


@dataclass
class StandingLimit:
    """One rate limit in force."""

    decision: Decision
    readings: deque[tuple[int, int]] = field(default_factory=deque)
    """Capture time and drop counter since the limit was set or extended: the first and the last."""
    heard: int = 0
    """Capture time of the newest evidence that asked for it again."""

    def drop_rate(self) -> float:
        """Dropped packets a second since it was set or extended."""
        return drops_per_second(self.readings)


@dataclass
class RateLimits:
    """All rate limits in force."""

    rules: Rules
    standing: dict[str, StandingLimit] = field(default_factory=dict)
    """By the decision's id."""
    notices: deque[OperatorNotice] = field(default_factory=lambda: deque(maxlen=NOTICES))
    """Notices that are not yet published."""
    refused: int = 0
    """Rate limits for which there was no room."""
    _said: int | None = None

    def open(
        self, victim: str, limit: RateLimit, reason: str, exhibits: Iterable[Exhibit], cause: Evidence
    ) -> list[Decision]:
        """Limit what comes to a victim; nothing if that is limited already, which then lasts longer.

        A limit that would hit a service which was not known yet is lifted, and the new one comes after it.
        """
        now, lifted = cause.event_time, list[Decision]()
        former = self._held(victim, limit)
        if former is not None:
            held = former.decision.limit
            if held is None or set(limit.open_ports) <= set(held.open_ports):
                former.heard = now
                return []
            lifted = [self._lifted(former, now, f"{victim} has another service")]
        if len(self.standing) >= MOST_LIMITS:
            self._refuse(victim, now)
            return lifted
        target = Target(kind="ip", address=victim)
        decision = Decision(
            id=decision_id(f"{EVERY_SWITCH} {limit.words}", target, now),
            action="meter",
            switch=EVERY_SWITCH,
            target=target,
            reason=reason,
            evidence=tuple(exhibits),
            event_time=now,
            expires=now + self.rules.limit_s * SECOND,
            dry_run=self.rules.dry_run,
            first_packet=cause.first_packet,
            limit=limit,
        )
        self.standing[decision.id] = StandingLimit(decision, deque([(now, 0)]))
        return [*lifted, decision]

    def _held(self, victim: str, limit: RateLimit) -> StandingLimit | None:
        """The limit in force for packets of this kind towards a victim."""
        for each in self.standing.values():
            held = each.decision.limit
            same = held is not None and (held.kind, held.port) == (limit.kind, limit.port)
            if same and each.decision.target.address == victim:
                return each
        return None

    def _refuse(self, victim: str, now: int) -> None:
        self.refused += 1
        if self._said is None or not -SET_BACK < now - self._said < MINUTE:
            self._said = now
            text = f"{MOST_LIMITS} rate limits are in force: none is set towards {victim} or any later victim"
            self.notices.append(OperatorNotice("cap", text, now))

    def count_drops(self, decision: str, packets: int, now: int) -> None:
        """Record a value of a limit's drop counter."""
        limit = self.standing.get(decision)
        if limit is None or now <= limit.readings[-1][0]:
            return
        while len(limit.readings) > 1:
            limit.readings.pop()
        limit.readings.append((now, packets))

    def confirm(self, confirmation: Confirmation) -> None:
        """Record a confirmation of the switch; a limit that failed is not in force."""
        limit = self.standing.get(confirmation.id)
        if limit is not None and confirmation.state in {"failed", "removed", "expired"}:
            del self.standing[confirmation.id]

    def due(self, now: int) -> list[Decision]:
        """Decisions due by time alone: limits that are extended or lifted."""
        over = [each for each in self.standing.values() if 0 < each.decision.expires <= now]
        return [self._end(each, now) for each in over]

    def _end(self, limit: StandingLimit, now: int) -> Decision:
        old = limit.decision
        assert old.limit is not None  # noqa: S101 - all of them have one
        begun = limit.readings[0][0]
        if limit.heard > begun or limit.drop_rate() >= GOING_ON_SHARE * old.limit.rate:
            limit.decision = structs.replace(old, event_time=now, expires=now + self.rules.limit_s * SECOND)
            limit.readings = deque([(now, limit.readings[-1][1])])
            return limit.decision
        return self._lifted(limit, now, "the flood is over")

    def holds(self, which: str) -> bool:
        """Whether a rate limit has this id or victim."""
        return any(_is(which, each.decision) for each in self.standing.values())

    def release(self, which: str, now: int, reason: str) -> list[Decision]:
        """Lift rate limits by id or victim; a flood that goes on sets them again."""
        found = [each for each in self.standing.values() if _is(which, each.decision)]
        return [self._lifted(each, now, reason) for each in found]

    def release_all(self, now: int, reason: str) -> list[Decision]:
        """Lift all rate limits."""
        return [self._lifted(each, now, reason) for each in list(self.standing.values())]

    def restore(self, decisions: Iterable[Decision]) -> None:
        """Restore rate limits from before a restart."""
        for decision in decisions:
            if decision.action == "meter":
                begun = deque([(decision.event_time, 0)])
                self.standing[decision.id] = StandingLimit(decision, begun)

    def _lifted(self, limit: StandingLimit, now: int, reason: str) -> Decision:
        del self.standing[limit.decision.id]
        return structs.replace(limit.decision, action="unmeter", event_time=now, reason=reason)


def _is(which: str, decision: Decision) -> bool:
    return which in (decision.id, decision.target.address)
