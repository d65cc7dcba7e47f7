"""Life cycle of decisions: in force, extended while the attack continues, probation, lifted.

Pure: every call carries its capture time.  A block that ends while its drop counter still grows at more
than three times the sender's training rate is extended.  Otherwise, or if that rate is not known, it is lifted and
the sender is on probation: one anomalous second blocks it again, for the next longer time.  A block that an
instruction asked for ends when it says, and without probation: it rests on no evidence.
"""

import hashlib
import ipaddress
import re
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from apps.firewall.evidence.history import INSTRUCTIONS
from apps.firewall.policy.rules import Rules
from apps.messages import Confirmation, Decision, Exhibit, Sender, Target

SECOND = 1_000_000_000
MINUTE = 60 * SECOND
SET_BACK = 3_600 * SECOND
"""A time that far behind an earlier one means that a clock was set back; those of several senders differ by less."""
NOTICES = 100
PROBATION_S = 600
STILL_GOING_RATIO = 3.0
"""A block is extended while its drop rate is more than this many times the training rate."""
STILL_GOING_WINDOW_S = 60
"""Time over which drops are averaged, since floods have pauses."""
STILL_GOING_FLOOR = 1.0
"""... and at least this many packets per second, for senders with a very low training rate."""


_INSTRUCTED = INSTRUCTIONS.partition("*")[0]
_GOING_ON = "still going on ({:.0f} dropped packets a second): "
_FIRST_REASON = re.compile(r"^still going on \([0-9]+ dropped packets a second\): ")
_MOST_PROBATION = 16_384
_MOST_RECENT = 65_536
_NEW_IDS = 256
"""Of decisions by hand within the second in which firewall time may stand still."""


def drops_per_second(readings: Sequence[tuple[int, int]]) -> float:
    """Packets that were dropped a second.

    Args:
        readings: capture time in ns and drop counter, oldest first.

    Returns:
        0.0 if there are fewer than two readings.
    """
    if len(readings) < 2:
        return 0.0
    (begun, first), (ended, last) = readings[0], readings[-1]
    return (last - first) * SECOND / (ended - begun)


@dataclass
class Block:
    """One block in force."""

    decision: Decision
    readings: deque[tuple[int, int]] = field(default_factory=deque)
    """Capture time and drop counter of the last minute, oldest first."""
    state: str = "decided"

    @property
    def host(self) -> str:
        """The address behind a blocked MAC, or the blocked address."""
        return self.decision.host or self.decision.target.address

    @property
    def is_asked_for(self) -> bool:
        """Whether an instruction asked for it, and said how long it lasts."""
        return any(each.key.startswith(_INSTRUCTED) for each in self.decision.evidence)

    @property
    def drop_rate(self) -> float:
        """Dropped packets a second over the last minute."""
        return drops_per_second(self.readings)


@dataclass(frozen=True)
class OperatorNotice:
    """A notice for operators."""

    kind: str
    """One word, the last segment of its key."""
    text: str
    event_time: int


@dataclass
class BlockLifecycle:
    """All blocks in force and all senders on probation."""

    rules: Rules
    blocks: dict[str, Block] = field(default_factory=dict)
    probation: dict[tuple[str, str, str], int] = field(default_factory=dict)
    refused: int = 0
    """Number of blocks that a cap prevented."""
    known: Collection[str] = frozenset()
    """Hosts known from handshakes."""
    trained_hosts: int = 0
    """Hosts that training saw; few of them may have finished a handshake so far."""
    notices: deque[OperatorNotice] = field(default_factory=lambda: deque(maxlen=NOTICES))
    """Notices that are not yet published."""
    stopped: str = ""
    """The cap that stops blocking; empty: none."""
    waits_for: str = ""
    """Why nobody may be blocked yet unless an instruction asks for it; empty: anybody may be."""
    _recent: deque[int] = field(default_factory=lambda: deque(maxlen=_MOST_RECENT))
    _said: dict[str, int] = field(default_factory=dict)
    _ids: deque[str] = field(default_factory=lambda: deque(maxlen=_NEW_IDS))
    _held: int = 0
    _by_address: dict[str, dict[str, int]] = field(default_factory=dict)
    """MAC or address to the ids of its blocks, each with its place in the order of blocking."""
    _prefixes: dict[str, int] = field(default_factory=dict)
    """The same for blocks of prefixes."""

    def covering(self, sender: Sender) -> Block | None:
        """The block in force that already stops this sender, the oldest of several."""
        found = [
            place for each in {sender.mac, sender.ip} for place in self._by_address.get(each, {}).items()
        ]
        for name, _ in sorted([*found, *self._prefixes.items()], key=lambda place: place[1]):
            block = self.blocks.get(name)
            if block is None or block.decision.switch not in (sender.switch, "*"):
                continue
            if _stops(block.decision.target, sender):
                return block
        return None

    def _hold(self, block: Block) -> None:
        decision = block.decision
        self.blocks[decision.id] = block
        self._held += 1
        self._places(decision).setdefault(decision.id, self._held)

    def _release(self, decision_id: str) -> Block | None:
        block = self.blocks.pop(decision_id, None)
        if block is not None:
            decision = block.decision
            places = self._places(decision)
            places.pop(decision_id, None)
            if not places:
                self._by_address.pop(decision.target.address, None)
        return block

    def _places(self, decision: Decision) -> dict[str, int]:
        address = decision.target.address
        return self._prefixes if "/" in address else self._by_address.setdefault(address, {})

    def on_probation(self, sender: Sender, now: int) -> bool:
        """True if a block of this sender was lifted less than ten minutes ago."""
        return any(
            self.probation.get((sender.switch, kind, address), 0) > now
            for kind, address in (("mac", sender.mac), ("ip", sender.ip))
        )

    def cap_reached(self, now: int, host: str = "") -> str | None:
        """Why no further block, or none of this host, may be made now; None if it may."""
        self._forget_old(now)
        if self.waits_for:
            return self.waits_for
        if len(self.blocks) >= self.rules.max_blocks:
            return f"{len(self.blocks)} blocks are in force (max_blocks)"
        if len(self._recent) >= self.rules.max_decisions_per_minute:
            return f"{len(self._recent)} blocks were decided within a minute (max_decisions_per_minute)"
        if host in self.known:
            blocked = sum(block.host in self.known for block in self.blocks.values())
            hosts = max(len(self.known), self.trained_hosts)
            if blocked >= max(1, int(self.rules.max_known_share * hosts)):
                return f"{blocked} of {hosts} known hosts are blocked (max_known_share)"
        self.stopped = ""
        return None

    def refuse(self, cap: str, who: str, now: int) -> None:
        """Count a block that a cap prevented, and report it once a minute for each cap."""
        self.refused += 1
        self.stopped = cap
        name = cap[cap.rfind("(") :]
        # a clock that was ahead may have been set right since
        if not -SET_BACK < now - self._said.get(name, now - MINUTE) < MINUTE:
            self._said[name] = now
            text = f"BLOCKING STOPPED, {cap}: {who} stays unblocked, and others after it"
            self.notices.append(OperatorNotice("cap", text, now))

    def open(
        self,
        switch: str,
        target: Target,
        reason: str,
        evidence: Iterable[Exhibit],
        now: int,
        *,
        offences: int = 0,
        first_packet: int = 0,
        training_rate: float = 0.0,
        seconds: int | None = None,
        host: str = "",
    ) -> Decision:
        """Open a block on a switch, or on all with `*`; a step longer for each earlier offence.

        `seconds` replaces the steps for blocks by hand.
        """
        level = min(offences, len(self.rules.durations_s) - 1)
        decision = Decision(
            id=self._new_id(switch, target, now),
            action="block",
            switch=switch,
            target=target,
            reason=reason,
            evidence=tuple(evidence),
            event_time=now,
            expires=now + (self.rules.durations_s[level] if seconds is None else seconds) * SECOND,
            level=level,
            dry_run=self.rules.dry_run,
            first_packet=first_packet,
            training_rate=training_rate,
            host=host,
        )
        self._hold(Block(decision, deque([(now, 0)])))
        self._forget_old(now)
        self._recent.append(now)
        return decision

    def _forget_old(self, now: int) -> None:
        """Only decisions of the last minute count towards a cap.

        Those of a clock that was ahead would keep all later ones.  Capture times of several senders differ, so that
        what is less than an hour ahead counts.
        """
        while self._recent and self._recent[-1] >= now + SET_BACK:
            self._recent.pop()
        while self._recent and self._recent[0] <= now - MINUTE:
            self._recent.popleft()

    def _new_id(self, switch: str, target: Target, now: int) -> str:
        """An id that nothing had that was decided lately: a lift ends its id for good."""
        while (name := decision_id(switch, target, now)) in self._ids:
            now += 1
        self._ids.append(name)
        return name

    def in_blocked_prefix(self, address: str) -> bool:
        """Whether a prefix that contains this address is blocked."""
        targets = (block.decision.target.address for block in self.blocks.values())
        return any(_has(target, address) for target in targets if "/" in target)

    def restore(self, decisions: Iterable[Decision]) -> None:
        """Restore blocks from before a restart."""
        for decision in decisions:
            if decision.action == "block":
                self._hold(Block(decision, deque([(decision.event_time, 0)]), "restored"))

    def matching(self, subject: str) -> list[Decision]:
        """Blocks in force with this id or address."""
        found = (block.decision for block in self.blocks.values())
        return [each for each in found if subject in (each.id, each.target.address)]

    def lift(self, decision_id: str, now: int, reason: str) -> Decision | None:
        """End a block early, without probation; None if there is none."""
        block = self._release(decision_id)
        if block is None:
            return None
        return _changed(block.decision, now, action="unblock", reason=reason)

    def confirm(self, confirmation: Confirmation) -> None:
        """Record a confirmation of the switch; a block that failed is not in force."""
        block = self.blocks.get(confirmation.id)
        if block is None:
            return
        block.state = confirmation.state
        if confirmation.state in {"failed", "removed", "expired"}:
            self._release(confirmation.id)

    def count_drops(self, decision_id: str, packets: int, now: int) -> None:
        """Record a value of a block's drop counter."""
        block = self.blocks.get(decision_id)
        if block is None or now <= block.readings[-1][0]:
            return
        block.readings.append((now, packets))
        while len(block.readings) > 2 and block.readings[1][0] <= now - STILL_GOING_WINDOW_S * SECOND:
            block.readings.popleft()

    def due(self, now: int) -> list[Decision]:
        """Decisions due by time alone: blocks that are extended or lifted."""
        return [
            self._end(block, now) for block in list(self.blocks.values()) if 0 < block.decision.expires <= now
        ]

    def _end(self, block: Block, now: int) -> Decision:
        old = block.decision
        if block.is_asked_for:
            self._release(old.id)
            return _changed(old, now, action="unblock", reason="the requested time is over")
        if _goes_on(block) and not old.dry_run:
            extended = _changed(
                old,
                now,
                expires=now + self.rules.durations_s[old.level] * SECOND,
                reason=_GOING_ON.format(block.drop_rate) + _FIRST_REASON.sub("", old.reason),
            )
            block.decision = extended
            return extended
        self._release(old.id)
        key = (old.switch, old.target.kind, old.target.address)
        self.probation = {each: until for each, until in self.probation.items() if until > now}
        self.probation[key] = now + PROBATION_S * SECOND
        if len(self.probation) > _MOST_PROBATION:
            del self.probation[next(iter(self.probation))]
        return _changed(old, now, action="unblock", reason="the block ran out; on probation for ten minutes")


def _goes_on(block: Block) -> bool:
    """Whether it drops more than its sender's usual traffic; where that is not known only new evidence can tell."""
    usual = block.decision.training_rate
    return usual is not None and block.drop_rate > max(usual * STILL_GOING_RATIO, STILL_GOING_FLOOR)


def _stops(target: Target, sender: Sender) -> bool:
    if target.kind == "mac":
        return target.address == sender.mac and target.port in (None, sender.port)
    return bool(sender.ip) and _has(target.address, sender.ip)


def _has(target: str, address: str) -> bool:
    """Whether a blocked address or prefix covers an address."""
    if "/" not in target or "/" in address:
        return target == address
    return ipaddress.ip_address(address) in ipaddress.ip_network(target)


def _changed(old: Decision, now: int, **changes: object) -> Decision:
    fields = {name: getattr(old, name) for name in old.__struct_fields__}
    return Decision(**(fields | {"event_time": now} | changes))


def decision_id(switch: str, target: Target, now: int) -> str:
    """A short id, the same for the same decision in every replay."""
    text = f"{switch} {target.kind} {target.address} {target.port} {now}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]
