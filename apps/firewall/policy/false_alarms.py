"""What operators have called false alarms, and what follows for evidence of the same kind.  Pure.

    decision ──► its grounds: sender, source, service     "false alarm" ──► a lesson about these grounds
    evidence ──► a lesson about it? ──► a tenth of its nats, and only beside other evidence

A lesson is as narrow as its evidence: who did it, which statistic or query found it, and the service; where there is
no service, the victim.  Everything else that the same sender does counts in full.  Evidence of a lesson is
`supporting`: it makes up 30 % of a bound at most, so that alone it decides nothing, and beside an attack it still counts.
"""

from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import structs

from apps.evidence import Evidence
from apps.firewall.evidence.shared import shared_text
from apps.messages import MOST_GROUNDS, Decision, FalseAlarm, Ground, Sender

WEIGHT: Final = 0.1
"""Factor on the nats of evidence that was called a false alarm once; twice: its square, and no less."""
MOST_LESSONS: Final = 1_000
MOST_SUBJECTS: Final = 4_096
MOST_DECISIONS: Final = 4_096
"""Decisions whose grounds are remembered; the archive has those of others."""
EPHEMERAL: Final = 32_768
"""Ports from here on are anybody's: their number says nothing about a service."""
SUFFIX: Final = ".false_alarm"
"""Behind the source of evidence that counts less, so that its sum stays apart."""
_HALF_LIFE_NS: Final = 600_000_000_000
_HELD_NS: Final = 6 * _HALF_LIFE_NS
"""Capture time after its last evidence for which a subject's grounds are kept."""
_LEAST_SHARE: Final = 0.05
"""Grounds with a smaller share of the strongest one's nats are left out."""
_SAID: Final = " (called a false alarm before, so it counts less)"
_DAY_NS: Final = 86_400_000_000_000
_MOST_TEXT: Final = 4_000

_Ground = tuple[str, Sender | None, str, str]
_Subject = Sender | tuple[str, str]


def ground_of(evidence: Evidence, app: str) -> Ground:
    """The kind of evidence that a piece belongs to.

    Args:
        evidence: with the sender that was last seen with its address, if there is one.
        app: who wrote it.
    """
    service = victim = ""
    if evidence.kind != "unlike_training":  # a score is about a conversation, whichever it was
        service = _steady(evidence.service)
        by_victim = evidence.sender is None or not service or evidence.kind == "spoofing"
        victim = evidence.victims[0] if evidence.victims and by_victim else ""
    return Ground(
        source=shared_text(f"{app}.{evidence.source}"),
        sender=evidence.sender,
        victim=victim,
        service=service,
        nats=evidence.nats,
    )


def _steady(service: str) -> str:
    protocol, _, port = service.partition("/")
    return f"{protocol}/ephemeral" if port.isdecimal() and int(port) >= EPHEMERAL else service


def _identity(ground: Ground) -> _Ground:
    return ground.source, ground.sender, ground.victim, ground.service


class GroundBook:
    """Which kinds of evidence the sums against senders and about victims consist of."""

    def __init__(self) -> None:
        self._subjects: OrderedDict[_Subject, dict[_Ground, tuple[float, int]]] = OrderedDict()

    def note(self, subject: _Subject, ground: Ground, now: int) -> None:
        """Note what a piece of evidence about a subject has added at a capture time, ns."""
        grounds = self._subjects.setdefault(subject, {})
        self._subjects.move_to_end(subject)
        name = _identity(ground)
        nats, then = grounds.pop(name, (0.0, now))
        grounds[name] = ground.nats + _faded(nats, then, now), max(then, now)
        while len(self._subjects) > MOST_SUBJECTS or self._newest_of_the_oldest() < now - _HELD_NS:
            self._subjects.popitem(last=False)
        if len(grounds) > 2 * MOST_GROUNDS:
            del grounds[min(grounds, key=lambda each: _faded(*grounds[each], now))]

    def _newest_of_the_oldest(self) -> int:
        return max(then for _, then in next(iter(self._subjects.values())).values())

    def take(self, subject: _Subject, now: int) -> tuple[Ground, ...]:
        """What a decision about a subject rests on, the strongest first; it is then forgotten."""
        kinds = self._subjects.pop(subject, {})
        weights = sorted(((_faded(*kinds[each], now), each) for each in kinds), key=lambda pair: -pair[0])
        return tuple(
            Ground(source=source, sender=sender, victim=victim, service=service, nats=nats)
            for nats, (source, sender, victim, service) in weights[:MOST_GROUNDS]
            if nats > 0 and nats >= _LEAST_SHARE * weights[0][0]
        )


def _faded(nats: float, then: int, now: int) -> float:
    return float(nats * 0.5 ** (max(0, now - then) / _HALF_LIFE_NS))


class FalseAlarms:
    """Lessons in force.

    Args:
        days: capture time for which a lesson holds.
    """

    def __init__(self, days: int) -> None:
        self._days = days
        self._lessons: OrderedDict[str, FalseAlarm] = OrderedDict()
        self._by_ground: dict[_Ground, dict[str, int]] = {}
        """By ground: the lessons about it, and when each ends."""
        self._grounds: OrderedDict[str, tuple[Ground, ...]] = OrderedDict()
        self.book = GroundBook()
        self._news: deque[FalseAlarm] = deque()

    def __len__(self) -> int:
        return len(self._lessons)

    def __contains__(self, decision: object) -> bool:
        """Whether a decision was called a false alarm."""
        return decision in self._lessons

    def told(self) -> Iterator[FalseAlarm]:
        """Lessons since the last call, to be published."""
        while self._news:
            yield self._news.popleft()

    def weighed(self, evidence: Evidence, app: str) -> Evidence:
        """Evidence with the weight that lessons leave it.

        Args:
            evidence: with the sender that was last seen with its address, if there is one.
            app: who wrote it.
        """
        if evidence.nats <= 0:
            return evidence
        now = evidence.event_time
        ends = self._by_ground.get(_identity(ground_of(evidence, app)), {})
        times = sum(end > now for end in ends.values())
        if times:
            evidence = structs.replace(
                evidence,
                nats=evidence.nats * WEIGHT ** min(times, 2),
                supporting=True,
                source=f"{evidence.source[:200]}{SUFFIX}",
                text=evidence.text[:_MOST_TEXT] + _SAID,
            )
        return evidence

    def note(self, evidence: Evidence, app: str) -> None:
        """Remember evidence that was added to a sum, so that a decision knows its grounds."""
        plain = structs.replace(evidence, source=evidence.source.removesuffix(SUFFIX))
        if evidence.nats > 0 and (evidence.sender is not None or evidence.victims):
            subject = evidence.sender or (evidence.victims[0], evidence.service)
            self.book.note(subject, ground_of(plain, app), evidence.event_time)

    def decided(self, decision: Decision) -> None:
        """Remember the grounds of a decision."""
        if decision.grounds:
            self._grounds[decision.id] = decision.grounds
            if len(self._grounds) > MOST_DECISIONS:
                self._grounds.popitem(last=False)

    def grounds_of(self, decision: str) -> tuple[Ground, ...]:
        """The grounds of a decision; empty if it has none, or is not remembered."""
        return self._grounds.get(decision, ())

    def teach(self, decision: str, grounds: tuple[Ground, ...], now: int, reason: str) -> FalseAlarm:
        """Learn that a decision was a false alarm.

        Raises:
            ValueError: it is known to be one, or too many are.
        """
        self._end(now)
        if decision in self._lessons:
            raise ValueError(f"{decision} has already been called a false alarm")
        if len(self._lessons) >= MOST_LESSONS:
            raise ValueError(
                f"{MOST_LESSONS} false alarms are remembered, and no more can be; revoke some with `sdnator blocks false-alarm ID "
                "--revoke`, or put the senders on the allow-list"
            )
        expires = now + self._days * _DAY_NS
        lesson = FalseAlarm(id=decision, grounds=grounds, event_time=now, expires=expires, reason=reason)
        self._keep(lesson)
        self._news.append(lesson)
        return lesson

    def revoke(self, decision: str, now: int) -> FalseAlarm:
        """Take back that a decision was a false alarm; raises ValueError if nobody said so."""
        lesson = self._forget(decision)
        if lesson is None:
            raise ValueError(f"{decision} was not called a false alarm; see `sdnator blocks false-alarms`")
        lesson = structs.replace(lesson, event_time=max(now, lesson.event_time), revoked=True)
        self._news.append(lesson)
        return lesson

    def restore(self, lessons: Iterable[FalseAlarm]) -> None:
        """Learn again what was in force before a restart, oldest first; the last word about a decision holds."""
        for lesson in lessons:
            self._forget(lesson.id)
            if not lesson.revoked:
                self._keep(lesson)
            while len(self._lessons) > MOST_LESSONS:
                self._forget(next(iter(self._lessons)))

    def _keep(self, lesson: FalseAlarm) -> None:
        self._lessons[lesson.id] = lesson
        for ground in lesson.grounds:
            self._by_ground.setdefault(_identity(ground), {})[lesson.id] = lesson.expires

    def _forget(self, decision: str) -> FalseAlarm | None:
        lesson = self._lessons.pop(decision, None)
        for ground in lesson.grounds if lesson is not None else ():
            ends = self._by_ground.get(_identity(ground), {})
            ends.pop(decision, None)
            if not ends:
                self._by_ground.pop(_identity(ground), None)
        return lesson

    def _end(self, now: int) -> None:
        for name in [name for name, each in self._lessons.items() if each.expires <= now]:
            self._forget(name)
