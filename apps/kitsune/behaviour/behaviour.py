"""What senders do beyond what training saw of them, as findings with a weight.

    contacts that fail     of a sender: in all, by target (port scan), by service (sweep)
    logins                 connections of a sender to one login service
    callbacks              hosts that connect back to whoever has just logged in
    one-way traffic        packets of a sender to one host that does not take part; SYNs apart from others
    claims                 ARP replies that nobody asked for
    thefts                 ARP packets that claim the address of another, who is present
    strange sources        of a victim: unknown addresses whose contacts fail (forged floods)
    scores                 of a sender: how far Kitsune's scores lie over those of training
    threshold              a packet at or above Kitsune's threshold, without weight: for the rule of the paper

`fingerprints` adds SYNs that only scanners send.

Pure.  Each statistic has a `Baseline`; what is above it is weighed in nats, and a finding says what has been
added since the last one about the same subject.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import msgspec
import numpy as np
import numpy.typing as npt

from apps.kitsune.behaviour.baseline import BLOCKS, WINDOWS_S
from apps.kitsune.behaviour.callbacks import Callbacks
from apps.kitsune.behaviour.contacts import (
    ANY_UDP,
    ARP,
    ECHO,
    FROM_UDP,
    GRACE_S,
    TCP,
    UDP,
    UNANSWERED,
    ContactTracker,
    EndedContact,
    PacketRow,
    flooded_service,
    protocol_of,
)
from apps.kitsune.behaviour.exchanges import OPENING, Exchange
from apps.kitsune.behaviour.findings import (
    LEAST_NATS,
    Finding,
    FoundSoFar,
    SeenCount,
    Statistic,
    StatisticCounter,
    usual_score_of,
)
from apps.kitsune.behaviour.outside import NEVER, Outside
from apps.kitsune.behaviour.rows import SenderId, packet_rows, parts_of
from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import Columns
from apps.kitsune.names import ip_text, mac_text
from apps.kitsune.roles import is_inside

CONTACTS: Final[tuple[Statistic, ...]] = ("contacts", "ports", "targets")
BURST_WINDOWS_S: Final = WINDOWS_S[1:]
"""Of contacts: a program opens many at once, and how fast it does says nothing."""
WHOLE: Final[tuple[Statistic, ...]] = (*CONTACTS, "logins", "one_way", "strangers")
"""Statistics that all of training speaks of.  Scores are learnt from its end only; and all newcomers announce
themselves, but training may have seen none."""
LOGINS: Final = frozenset(
    (
        21,
        22,
        23,
        110,
        143,
        389,
        445,
        512,
        513,
        514,
        1433,
        1521,
        2222,
        2323,
        3306,
        3389,
        5432,
        5900,
        5985,
        6379,
    )
)
"""TCP ports where passwords are asked for."""
REFUSED_BYTES: Final = 5_000
"""Bytes on the wire that the initiator sends in a login that is refused, at most: the key exchange of SSH and a few
passwords are 2,000 to 4,000."""
CALIBRATION_PACKETS: Final = 5_000
"""Packets at the end of training whose scores say how benign ones lie."""
KEPT: Final = 65_536
TINY: Final = 1e-300
_FIN, _SYN, _RST, _ACK = 0x01, 0x02, 0x04, 0x10
CHOSEN: Final = 32_768
"""Clients choose ports from here on by chance (Linux; others from 49,152)."""
ASKED_S: Final = 3.0
PRESENT_S: Final = 60.0
"""Seconds for which a host that has sent something is present."""
THEFT: Final = 5.0
"""Events that a claim of the address of a present host counts as."""
AGAIN_S: Final = 10.0


@dataclass(slots=True)
class _Login:
    """A connection to a login service."""

    sender: SenderId
    moved: int
    """Bytes of the initiator."""
    settled: bool = False
    """It has ended, or moved more than a refused login does."""

    def change(self, row: PacketRow) -> float:
        """What a further packet adds to the count."""
        if self.settled:
            return 0.0
        self.moved += row.length
        self.settled = self.moved >= REFUSED_BYTES or bool(row.flags & (_FIN | _RST))
        if not self.settled:
            return 0.0
        return -0.5 if self.moved >= REFUSED_BYTES else 0.5


class Behaviour:
    """Follows all senders of all switches.

    Args:
        training_packets: packets of training, to divide it into blocks.
    """

    def __init__(self, training_packets: int) -> None:
        self._per_block = max(1, -(-training_packets // BLOCKS))
        self._packets = 0
        self._learning = True
        self.begun, self.seconds = 0.0, 1.0
        """Capture time of the first packet, and length of training."""
        self.senders: set[SenderId] = set()
        """Senders of training."""
        self._addresses: set[int] = set()
        self._owners: dict[int, set[int]] = {}
        """Address to the MACs that used it in training."""
        self._spoke: dict[int, float] = {}
        """When the owner of an address last sent something."""
        self.contacts = ContactTracker()
        self._counters: dict[Statistic, StatisticCounter] = {
            # who was quiet for an hour may do what others do: without the own highest counts
            "contacts": StatisticCounter(windows=BURST_WINDOWS_S, own=False),
            "ports": StatisticCounter(windows=BURST_WINDOWS_S),
            "targets": StatisticCounter(windows=BURST_WINDOWS_S, own=False),
            "logins": StatisticCounter(0.9, own=False),
            "one_way": StatisticCounter(8.0, (1.0,), own=False, rates=True),
            "claims": StatisticCounter(),
            "thefts": StatisticCounter(),
            "strangers": StatisticCounter(1.5, (1.0, 10.0)),
            "scores": StatisticCounter(),
        }
        self._failures = FoundSoFar()
        """Of senders: the strongest of `CONTACTS`, which are three views of the same packets."""
        self._outside = Outside()
        self._exchanges: dict[tuple[int, int], Exchange] = {}
        self._asked: dict[tuple[int, int], float] = {}
        self._logins: dict[tuple[int, int, int, int], _Login] = {}
        self._callbacks = Callbacks()
        self._called = FoundSoFar()
        self._strangers: dict[tuple[int, int, int], None] = {}
        self._tail: deque[tuple[SenderId, float]] = deque(maxlen=CALIBRATION_PACKETS)
        """Senders and times of the last packets of training."""
        self._told: dict[SenderId, float] = {}
        self.usual_score = 1.0
        """Score above which benign packets hardly ever are."""

    def add(
        self,
        batch: Columns,
        switch: str,
        scores: npt.NDArray[np.float64],
        trained: int,
        rescored: Callable[[], npt.NDArray[np.float64]],
        threshold: float = 1.0,
        blocked: Blocked | None = None,
    ) -> list[Finding]:
        """Takes a batch of which the first `trained` packets were training.

        Args:
            batch: packet columns.
            switch: where they were seen.
            scores: Kitsune's, one a packet.
            trained: packets at the beginning that belong to training.
            rescored: scores of the last packets of training by the trained model, `CALIBRATION_PACKETS` at most;
                asked for once, when training ends.
            threshold: Kitsune's.
            blocked: blocks in force; a packet to somebody whose answers a block drops proves nothing.

        Returns:
            What is worth a message.
        """
        found: list[Finding] = []
        # where training ends within this batch, the usual score is known only then
        logs = [] if self._learning else self._logs(scores)
        for number, row in enumerate(packet_rows(batch, switch)):
            block = -1
            if number < trained:
                block = self._train(row)
            elif self._learning:
                self._close_training(rescored())
                logs = self._logs(scores)
            if blocked and _is_cut_off(blocked, row):
                continue
            found += self._row(row, block)
            if block < 0 and logs[number] > 0:
                found += self._score(row, logs[number])
                if scores[number] >= threshold:
                    found += self._over(row, float(scores[number]))
        return found

    def _row(self, row: PacketRow, block: int) -> list[Finding]:
        """All statistics of one packet but its score."""
        found: list[Finding] = []
        for failed in self.contacts.due(row.time):
            found += self._ended(failed, block)
        ended = self.contacts.add(row)
        if ended is not None:
            found += self._ended(ended, block)
        found += self._login(row, block)
        found += self._one_way(row, block)
        found += self._ping(row, block)
        if row.service == ARP:
            found += self._theft(row, block)
            if row.answer:
                found += self._claim(row, block)
            else:
                self._ask(row)
        if row.source and row.sender[2] in self._owners.get(row.source, ()):
            self._spoke[row.source] = row.time
        self._outside.see(row.time, row.source)
        return found

    def _logs(self, scores: npt.NDArray[np.float64]) -> list[float]:
        logs: list[float] = np.log(np.maximum(scores, TINY) / self.usual_score).tolist()
        return logs

    def _calibrate(self, scores: npt.NDArray[np.float64]) -> None:
        """Learn from the last packets of training how their scores lie, now that the model is trained."""
        self.usual_score = usual_score_of(scores)
        tail = list(self._tail)[-len(scores) :]
        per_block = max(1, -(-len(tail) // BLOCKS))
        for number, ((sender, time), log) in enumerate(zip(tail, self._logs(scores), strict=False)):
            if log > 0:
                self._counters["scores"].see(sender, sender, time, number // per_block, log)
        self._tail.clear()

    def _train(self, row: PacketRow) -> int:
        block = min(self._packets // self._per_block, BLOCKS - 1)
        if not self._packets:
            self.begun = row.time
        self._packets += 1
        self.seconds = max(row.time - self.begun, 1.0)
        self.senders.add(row.sender)
        if row.source:
            self._addresses.add(row.source)
            self._owners.setdefault(row.source, set()).add(row.sender[2])
        self._tail.append((row.sender, row.time))
        return block

    def _close_training(self, rescored: npt.NDArray[np.float64]) -> None:
        self._learning = False
        self._calibrate(rescored)
        self._callbacks.learn(filter(self.contacts.came_about, self.contacts.seen()))
        self.contacts.close_training()
        self._close_outside()
        for name, counter in self._counters.items():
            # at the beginning every contact was new
            counter.baseline.close(BLOCKS // 2 if name in (*CONTACTS, "strangers") else 0)
            counter.trained(self.seconds)
        baselines = [self._counters[name].baseline for name in WHOLE]
        expected = sum(baseline.exceeded for baseline in baselines)
        for baseline in baselines:
            baseline.rarity = max(0.0, math.log(len(self.senders) / max(1, expected)))

    def _close_outside(self) -> None:
        self._outside.close(self.begun + self.seconds)

    def _ended(self, ended: EndedContact, block: int) -> list[Finding]:
        """A successful contact offsets a failed one."""
        found: list[Finding] = []
        if not (ended.failed and ended.half_open) and not _is_reflected(ended):
            found = self._contact(ended, block)
        if ended.failed:
            found += self._strange(ended, block)
        elif block < 0:
            found += self._callback(ended)
        return found

    def _callback(self, ended: EndedContact) -> list[Finding]:
        call = self._callbacks.heard(ended)
        if call is None:
            return []
        added = self._called.added(call.sender, self._callbacks.nats, ended.time)
        begun = ended.time - call.seconds
        seen = SeenCount(added, self._callbacks.nats, 1.0, call.seconds, float(self._callbacks.back), begun)
        found = Finding("callbacks", call.sender, call.host, call.service, *seen, ended.time, ended.arrival)
        return [found] if added else []

    def _contact(self, ended: EndedContact, block: int) -> list[Finding]:
        sender, target, time = ended.sender, ended.target, ended.time
        if self._outside.explains(ended.failed, sender, target, time):
            return []
        # hosts answer echo requests of everybody: that they do makes up for nothing
        found = self._views(ended, ended.service, block, counts=ended.failed or ended.service == ECHO)
        if ended.failed and ended.service == ECHO:
            found += self._views(ended, UNANSWERED, block, counts=True)
        return found

    def _views(self, ended: EndedContact, service: int, block: int, *, counts: bool) -> list[Finding]:
        """What ended, by the service that it counts for; beside another, only how many hosts it is about."""
        sender, target, time = ended.sender, ended.target, ended.time
        inside, protocol = is_inside(parts_of(sender[3])), protocol_of(service)
        whose = (sender, protocol)
        views: list[tuple[Statistic, Any, Any, int, int]] = [
            ("contacts", whose, (protocol, inside), 0, -1),
            ("ports", (sender, target), (protocol, inside), target, -1),
            ("targets", (sender, service), (_named(service), inside), 0, service),
        ]
        best: Finding | None = None
        for statistic, subject, kind, victim, single in views[-1:] if service == UNANSWERED else views:
            counter = self._counters[statistic]
            sums = counter.sums.add(subject, time, 1.0 if counts else -1.0)
            if block >= 0:
                counter.baseline.learn(whose, block, sums, kind)
            elif counts:
                seen = counter.measure(whose, sums, kind)
                if seen.total >= LEAST_NATS and (best is None or seen.total >= best.total):
                    best = Finding(statistic, sender, victim, single, *seen, time, ended.arrival)
        if best is None:
            return []
        added = self._failures.added(sender, best.total, time)
        return [msgspec.structs.replace(best, nats=added)] if added else []

    def _strange(self, ended: EndedContact, block: int) -> list[Finding]:
        """Unknown sources towards a victim: by what they send, and datagrams to a port each of all ports."""
        source, target = ended.sender[3], ended.target
        if block < 0 and source in self._addresses:
            return []
        key = (target, flooded_service(ended))
        if not self._fresh_stranger(source, key):
            return []
        found = self._stranger(key, ended, block)
        everywhere = (target, ANY_UDP)
        if (
            key[1] & ~0xFFFF == UDP
            and self._fresh_stranger(source, everywhere)
            and self._fresh_stranger(-key[1], everywhere)
        ):
            found += self._stranger(everywhere, ended, block)
        return found

    def _stranger(self, key: tuple[int, int], ended: EndedContact, block: int) -> list[Finding]:
        seen = self._counters["strangers"].see(key, key, ended.time, block)
        if seen is None:
            return []
        return [Finding("strangers", None, key[0], key[1], *seen, ended.time, ended.arrival)]

    def _ping(self, row: PacketRow, block: int) -> list[Finding]:
        """An echo request: hosts answer those of everybody, so that it does not fail."""
        if row.service != ECHO or row.answer or row.group or row.quoted or not row.source:
            return []
        asked = EndedContact(
            True, row.time, row.sender, row.target, ECHO, ECHO, False, row.arrival, half_open=False
        )
        return self._strange(asked, block)

    def _fresh_stranger(self, source: int, victim: tuple[int, int]) -> bool:
        key = (source, *victim)
        if key in self._strangers:
            return False
        if len(self._strangers) >= KEPT:
            self._strangers.clear()
        self._strangers[key] = None
        return True

    def _login(self, row: PacketRow, block: int) -> list[Finding]:
        """Connections to login services: half when they begin, whole when they end like a refused login.

        What has moved more than that is somebody's work, and not counted any more.
        """
        if not row.is_tcp or row.quoted:
            return []
        if row.service - TCP not in LOGINS:
            if not row.flags & (_FIN | _RST) or row.reverse - TCP not in LOGINS:
                return []
            # the server closes
            row = row._replace(
                source=row.target, target=row.source, service=row.reverse, reverse=row.service, length=0
            )
        key = (row.source, row.target, row.service, row.reverse)
        login = self._logins.get(key)
        if login is None:
            if row.flags & (_SYN | _ACK | _RST | _FIN) != _SYN:
                return []
            if len(self._logins) >= KEPT:
                self._logins.clear()
            self._logins[key] = _Login(row.sender, row.length)
            weight = 0.5
        else:
            weight = login.change(row)
        if not weight:
            return []
        row = row._replace(sender=self._logins[key].sender)
        counter = self._counters["logins"]
        sums = counter.sums.add((row.sender, row.target, row.service), row.time, weight)
        kind = (row.service, is_inside(parts_of(row.source)))
        if block >= 0:
            counter.baseline.learn((row.sender, row.service), block, sums, kind)
            return []
        # a client that logs in more often today does so at all of its services: the most counts, not the sum
        seen = counter.measure((row.sender, row.service), sums, kind)
        if seen.total >= LEAST_NATS:
            self._callbacks.login(row.sender, row.source, row.target, row.service, row.time)
        added = counter.found.added(row.sender, seen.total, row.time)
        return [self._finding("logins", row, seen._replace(nats=added))] if added else []

    def _one_way(self, row: PacketRow, block: int) -> list[Finding]:
        if row.group or row.quoted or not row.source or row.service >= ARP:
            return []
        second = int(row.time)
        back = self._exchanges.get((row.target, row.source))
        if (
            back is not None
            and back.second == second
            and not row.answer
            and not (row.is_tcp and _refuses(row.flags))
        ):
            back.back += 1
        if row.answer or (row.is_tcp and _refuses(row.flags)):
            return []
        key = (row.source, row.target)
        mine = self._exchanges.get(key)
        if mine is None:
            if len(self._exchanges) >= KEPT:
                self._exchanges.clear()
            mine = self._exchanges[key] = Exchange()
        opening = row.is_tcp and bool(row.flags & _SYN)
        alone = mine.sent(second, opening=opening, all_counts=block >= 0)
        if alone is None:
            return []
        kind = OPENING if opening else protocol_of(row.service)
        counter, whose = self._counters["one_way"], (row.sender, kind)
        if block >= 0:
            counter.baseline.learn(whose, block, (float(alone),), kind)
            return []
        # what a host sends at a time is one thing: the kind that is most unusual counts, not the sum
        seen = counter.measure(whose, (float(alone),), kind)
        added = counter.found.added(row.sender, seen.total, row.time)
        seen = seen._replace(nats=added, begun=float(int(row.time)))
        return [self._finding("one_way", row, seen)] if added else []

    def _ask(self, row: PacketRow) -> None:
        if len(self._asked) >= KEPT:
            self._asked.clear()
        self._asked[row.source, row.target] = row.time

    def _claim(self, row: PacketRow, block: int) -> list[Finding]:
        """An ARP reply; one that was asked for is none."""
        asked = self._asked.get((row.target, row.source))
        if asked is not None and row.time - asked <= ASKED_S:
            return []
        who: SenderId = (*row.sender[:3], 0)  # it may claim several addresses
        seen = self._counters["claims"].see(who, who, row.time, block)
        return [] if seen is None else [self._finding("claims", row._replace(sender=who), seen)]

    @property
    def subjects(self) -> int:
        """Hosts, services and pairs of hosts whose events of the last ten minutes are counted, by each statistic."""
        return sum(len(counter.sums) for counter in self._counters.values())

    def proven(self, address: int) -> bool:
        """Whether the address has completed a TCP handshake."""
        return self.contacts.proven(address)

    def forged(self, sender: SenderId) -> bool:
        """Whether the sender's address belonged to another MAC in training."""
        owners = self._owners.get(sender[3], set())
        return bool(owners) and sender[2] not in owners and not self._learning

    def _theft(self, row: PacketRow, block: int) -> list[Finding]:
        """A claim of an address that belongs to another, who is present."""
        if block >= 0 or not row.source or not self.forged(row.sender):
            return []
        if row.time - self._spoke.get(row.source, -math.inf) > PRESENT_S:
            return []
        who: SenderId = (*row.sender[:3], 0)
        seen = self._counters["thefts"].see(who, who, row.time, block, THEFT)
        return (
            []
            if seen is None
            else [self._finding("thefts", row._replace(sender=who, target=row.source), seen)]
        )

    def _score(self, row: PacketRow, log: float) -> list[Finding]:
        seen = self._counters["scores"].see(row.sender, row.sender, row.time, -1, log)
        if seen is None:
            return []
        there = (row.source, row.target, row.service)
        back = (row.target, row.source, row.reverse)
        answered = self.contacts.came_about(there) or self.contacts.came_about(back)
        supporting = answered or row.group or row.sender in self.senders
        return [self._finding("scores", row, seen, supporting=supporting)]

    def _over(self, row: PacketRow, score: float) -> list[Finding]:
        """At most once in ten seconds for each sender."""
        if row.time - self._told.get(row.sender, -math.inf) < AGAIN_S:
            return []
        if len(self._told) >= KEPT:
            self._told.clear()
        self._told[row.sender] = row.time
        seen = SeenCount(0.0, 0.0, score, 0.0, self.usual_score, row.time)
        return [self._finding("threshold", row, seen, supporting=True)]

    def to_state(self) -> dict[str, Any]:
        """What training has taught, as plain values for the model file."""
        return {
            "seconds": self.seconds,
            "line": self.usual_score,
            "senders": [list(sender) for sender in self.senders],
            "owners": [[address, sorted(macs)] for address, macs in self._owners.items()],
            "contacts": [list(contact) for contact in self.contacts.trained],
            "callbacks": self._callbacks.to_state(),
            "outside": [self._outside.longest, self._outside.reachable],
            "arp_grace": self.contacts.arp_grace,
            "baselines": {name: counter.baseline.to_state() for name, counter in self._counters.items()},
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """The inverse of `to_state`.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        self = cls(1)
        self._learning = False
        self.seconds, self.usual_score = float(state["seconds"]), float(state["line"])
        if not (self.seconds > 0 and self.usual_score > 0):
            raise ValueError(f"training of {self.seconds} s, usual score {self.usual_score}")
        self.senders = {
            (str(switch), int(port), int(mac), int(ip)) for switch, port, mac, ip in state["senders"]
        }
        self._owners = {int(address): set(map(int, macs)) for address, macs in state["owners"]}
        self._addresses = set(self._owners)
        self.contacts.trained = {(int(one), int(other), int(what)) for one, other, what in state["contacts"]}
        self.contacts.close_training()
        self.contacts.restore_grace(float(state.get("arp_grace", GRACE_S)))
        self._callbacks.restore(state.get("callbacks", (0, 0)))
        silence, reachable = state.get("outside", (NEVER, False))
        self._outside.restore(float(silence), bool(reachable))
        for name, counter in self._counters.items():
            counter.baseline.restore(state["baselines"][name])
            counter.trained(self.seconds)
        return self

    @staticmethod
    def _finding(
        statistic: Statistic,
        row: PacketRow,
        seen: SeenCount,
        *,
        supporting: bool = False,
    ) -> Finding:
        return Finding(
            statistic, row.sender, row.target, row.service, *seen, row.time, row.arrival, supporting
        )


def _is_cut_off(blocked: Blocked, row: PacketRow) -> bool:
    """Whether a packet goes to a blocked host, whose answers are dropped."""
    return blocked.covers(row.sender[0], mac_text(row.to_mac), ip_text(*parts_of(row.target)))


def _named(service: int) -> int:
    """The service; one for all ports that clients choose by chance."""
    return service if service & 0xFFFF < CHOSEN else protocol_of(service) | CHOSEN


def _is_reflected(failed: EndedContact) -> bool:
    """A datagram from a well-known port outside: who sends it may have been asked in the victim's name."""
    return flooded_service(failed) & ~0xFFFF == FROM_UDP and not is_inside(parts_of(failed.sender[3]))


def _refuses(flags: int) -> bool:
    """A RST, or a SYN-ACK, which a flooded host sends as well."""
    return bool(flags & _RST) or flags & (_SYN | _ACK) == _SYN | _ACK
