"""Which of the firewall's own findings are news: when one begins, when it has doubled, and when it is over.

    found ──► begins, or has doubled ──► a message with all that was not told yet
              neither ─────────────────► counted for the next message
    quiet for a minute ────────────────► a last message, if there was a first one

Pure; times are capture time in ns.
"""

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from msgspec import structs

from apps.evidence import Evidence
from apps.firewall.policy.sequential_test import HALF_LIFE_S

GROWTH: Final = 2
"""A finding that goes on is told again when it has so many times the packets that were told."""
QUIET_S: Final = 60
"""Seconds of capture time without more after which a finding is over."""
MOST: Final = 4_096
"""Findings followed at a time; the one heard of least recently is forgotten, without a last message."""
BEGINNINGS: Final = 50
"""Findings that may begin within a second without leading to a decision: who has many names fills no archive."""
_SECOND: Final = 1_000_000_000
_TEXT: Final = 3_900


class OwnFinding(NamedTuple):
    """What decides and, if it is told, what is written."""

    evidence: Evidence
    """With all packets and nats that no message has told yet."""
    news: bool
    """Whether it is worth a message even if nothing is decided."""


@dataclass(slots=True)
class _Ongoing:
    since: int
    latest: Evidence
    packets: int = 0
    told: int | None = None
    """Packets that messages have told; None: there was no message."""
    nats: float = 0.0
    """What messages came to at `told_at`; it fades."""
    told_at: int = 0

    def said(self, now: int) -> float:
        return self.nats * math.exp2(-max(0, now - self.told_at) / _SECOND / HALF_LIFE_S)


_Subject = tuple[object, ...]


class OngoingFindings:
    """Findings that go on, by source, sender, victim and service."""

    def __init__(self) -> None:
        self._ongoing: OrderedDict[_Subject, _Ongoing] = OrderedDict()
        """The one heard of last is the last."""
        self._second = self._begun = 0
        self.put_off = 0
        """Beginnings put off because there were too many within a second."""

    def __len__(self) -> int:
        return len(self._ongoing)

    def found(self, evidence: Evidence, *, again: bool = False) -> OwnFinding:
        """Take what was found.

        Args:
            evidence: `nats` is what it proves by itself.
            again: its packets are those of an earlier look, and what has come since.

        Returns:
            The evidence as it decides: since the begin of the finding, with what was not told yet.
        """
        now, subject = evidence.event_time, _subject(evidence)
        known = self._ongoing.pop(subject, None)
        if known is None or _is_quiet(known, now):
            known = _Ongoing(evidence.since, evidence)
        self._ongoing[subject] = known
        if len(self._ongoing) > MOST:
            self._ongoing.popitem(last=False)
        known.latest = evidence
        known.packets = max(known.packets, evidence.packets) if again else known.packets + evidence.packets
        whole = structs.replace(
            evidence,
            since=min(known.since, now),
            packets=known.packets - (known.told or 0),
            nats=max(0.0, evidence.nats - known.said(now)),
        )
        return OwnFinding(whole, self._is_news(known, now))

    def told(self, evidence: Evidence) -> None:
        """A message was written with what `found` has returned."""
        known = self._ongoing.get(_subject(evidence))
        if known is not None:
            self._begun += known.told is None
            known.nats = known.said(evidence.event_time) + evidence.nats
            known.told, known.told_at = known.packets, evidence.event_time

    def _is_news(self, known: _Ongoing, now: int) -> bool:
        if known.told is not None:
            return known.packets >= GROWTH * max(1, known.told)
        if now // _SECOND > self._second:
            self._second, self._begun = now // _SECOND, 0
        if self._begun >= BEGINNINGS:
            self.put_off += 1
        return self._begun < BEGINNINGS

    def over(self, now: int) -> Iterator[Evidence]:
        """The last messages of findings that are over by a capture time; they weigh nothing."""
        while self._ongoing:
            subject, known = next(iter(self._ongoing.items()))
            if not _is_quiet(known, now):
                return
            del self._ongoing[subject]
            if known.told is not None:
                latest = known.latest
                seconds = (latest.event_time - known.since) / _SECOND
                text = f"over, after {seconds:,.1f} s and {known.packets:,} packets: {latest.text[:_TEXT]}"
                yield structs.replace(
                    latest,
                    id=f"{latest.id}-over",
                    since=known.since,
                    packets=known.packets - known.told,
                    nats=0.0,
                    text=text,
                )


def _is_quiet(known: _Ongoing, now: int) -> bool:
    return now - known.latest.event_time > QUIET_S * _SECOND


def _subject(evidence: Evidence) -> _Subject:
    return evidence.source, evidence.sender, evidence.address, evidence.victims, evidence.service
