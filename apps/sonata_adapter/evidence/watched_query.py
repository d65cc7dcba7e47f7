"""One query that is evidence: what goes beyond training is new about somebody, in nats.

Time is capture time, microseconds.
"""

import math
from collections import OrderedDict
from itertools import count
from typing import Final

from apps.evidence import Evidence
from apps.messages import Sender
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from apps.sonata_adapter.evidence.learnt_query import LearntQuery, subject_of
from apps.sonata_adapter.evidence.recipes import EvidenceRecipe
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.query.language import duration_text
from apps.sonata_adapter.results import QueryResult

HALF_LIFE_US: Final = 600_000_000
"""After so long without more, half of what was said is forgotten."""
LEAST_NATS: Final = 1.0
"""Less is not worth a message."""
_RUNGS: Final = (5.0, 30.0)
"""Nats of an unknown host at the thresholds of a query that reports the threshold, not the count."""
_KNOWN_RUNG: Final = 5.0
"""The same for the quietest of the hosts that training knows."""
_MOST_SUBJECTS: Final = 65_536
_HELD_US: Final = 14 * HALF_LIFE_US
"""After so long without more, nothing worth a message is left of the most that can have been said."""


class SaidSoFar:
    """What was said about each subject, fading with time."""

    def __init__(self) -> None:
        self._said: OrderedDict[tuple[str, ...], tuple[float, int]] = OrderedDict()
        """The one spoken of last is the last."""

    def __len__(self) -> int:
        return len(self._said)

    def added(self, subject: tuple[str, ...], nats: float, at_us: int) -> float:
        """The part that is new, if it is worth a message; else 0."""
        former, then_us = self._said.get(subject, (0.0, at_us))
        faded = former * math.exp2(-max(0, at_us - then_us) / HALF_LIFE_US)
        if nats - faded < LEAST_NATS:
            return 0.0
        self._said[subject] = (nats, at_us)
        self._said.move_to_end(subject)
        while len(self._said) > _MOST_SUBJECTS or self._oldest_us() < at_us - _HELD_US:
            self._said.popitem(last=False)
        return nats - faded

    def _oldest_us(self) -> int:
        return next(iter(self._said.values()))[1]


class WatchedQuery(LearntQuery[Evidence]):
    """A query under which somebody has an interest in evidence."""

    def __init__(self, key: str, recipe: EvidenceRecipe, baseline: CountBaseline | None = None) -> None:
        super().__init__(key, recipe, baseline)
        self._said = SaidSoFar()
        self._numbers = count(1)

    def _requests_judging(self) -> tuple[QueryRequest, ...]:
        baseline = self.baseline
        assert baseline is not None  # noqa: S101 - it is set before results are weighed
        unknown = max(baseline.newcomer, baseline.low - 1.0)
        quietest = min((baseline.usual(host) for host in baseline.highest), default=unknown)
        if not self.recipe.crosses:
            return (self.recipe.at(self.key, baseline.count_of(LEAST_NATS, quietest)),)
        counts = {baseline.count_of(nats, unknown) for nats in _RUNGS}
        counts.add(baseline.count_of(_KNOWN_RUNG, quietest))
        return tuple(self.recipe.at(self.key, threshold) for threshold in sorted(counts))

    def _judged(self, switch: str, result: QueryResult) -> list[Evidence]:
        baseline, recipe = self.baseline, self.recipe
        # a count that may be too large is no evidence: an innocent host may share it
        if baseline is None or result.may_be_too_large or (not result.exact and not recipe.crosses):
            return []
        subject = subject_of(result)
        value = int(result.fields[recipe.measure])
        nats = self._said.added(subject, baseline.nats(subject[0], value), result.at_us)
        if not nats:
            return []
        return [self._evidence(switch, result, value, nats, baseline)]

    def _evidence(
        self, switch: str, result: QueryResult, value: int, nats: float, baseline: CountBaseline
    ) -> Evidence:
        fields, recipe = result.fields, self.recipe
        host = subject_of(result)[0]
        whom = "of it" if host in baseline.highest else "of any host"
        sender = None
        if "mac" in fields:
            sender = Sender(switch=switch, port=int(fields["port"]), mac=str(fields["mac"]))
        victims = (str(fields["dst"]),) if "dst" in fields else ()
        return Evidence(
            id=f"sonata-{recipe.name}-{result.at_us}-{next(self._numbers)}",
            kind=recipe.kind,
            source=recipe.name,
            sender=sender,
            address=str(fields["src"]) if sender is None and "src" in fields else "",
            supporting=recipe.supporting,
            victims=victims,
            victim_count=len(victims),
            service=recipe.service,
            nats=round(nats, 3),
            since=result.window_us * 1000,
            event_time=max(result.at_us, result.window_us) * 1000,
            packets=max(0, value),
            text=f"query {recipe.name} ({recipe.meaning}): {host} came to {value:,} {recipe.unit} within "
            f"{duration_text(result.length_us // 1000)}; training saw {baseline.usual(host):,.0f} {whom} at most",
        )
