"""One query that is evidence: it learns while the network trains, then says what goes beyond that.

    training ─ each count from a quarter of the threshold on, at the window's end ─► `CountBaseline`
    after it ─ results at thresholds that fit this network ─► what is new about somebody, in nats

Time is capture time, microseconds.
"""

import math
from collections import deque
from itertools import count
from typing import Final

from apps.evidence import Evidence, TrainingState
from apps.messages import Sender
from apps.sonata_adapter.evidence.count_baseline import CountBaseline, CountTraining
from apps.sonata_adapter.evidence.recipes import EvidenceRecipe
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.query.language import duration_text
from apps.sonata_adapter.results import QueryResult

HALF_LIFE_US: Final = 600_000_000
"""After so long without more, half of what was said is forgotten."""
LEAST_NATS: Final = 1.0
"""Less is not worth a message."""
ALONE_US: Final = 3_600_000_000
"""Training where nobody says how long it is."""
_SHORTEST_US: Final = 60_000_000
_LONGEST_US: Final = 7 * 86_400_000_000
"""The shortest and the longest training of a query that has missed the network's."""
_AHEAD_US: Final = 3_600_000_000
"""A time of training that is farther ahead of the packets than this is wrong."""
_RUNGS: Final = (5.0, 30.0)
"""Nats of an unknown host at the thresholds of a query that reports the threshold, not the count."""
_KNOWN_RUNG: Final = 5.0
"""The same for the quietest of the hosts that training knows."""
_WAITING: Final = 8_192
_MOST_SUBJECTS: Final = 65_536
_SLACK_US: Final = 1_000_000
"""Beyond a quarter of the window: results of the last window of training may take so long."""


class SaidSoFar:
    """What was said about each subject, fading with time."""

    def __init__(self) -> None:
        self._said: dict[tuple[str, ...], tuple[float, int]] = {}

    def added(self, subject: tuple[str, ...], nats: float, at_us: int) -> float:
        """The part that is new, if it is worth a message; else 0."""
        former, then_us = self._said.get(subject, (0.0, at_us))
        faded = former * math.exp2(-max(0, at_us - then_us) / HALF_LIFE_US)
        if nats - faded < LEAST_NATS:
            return 0.0
        if subject not in self._said and len(self._said) >= _MOST_SUBJECTS:
            del self._said[next(iter(self._said))]
        self._said[subject] = (nats, at_us)
        return nats - faded


class WatchedQuery:
    """A query under which somebody has an interest in evidence.

    Args:
        key: of the interest.
        recipe: how its results become evidence.
        baseline: of an earlier run, if there is one for this query.
    """

    def __init__(self, key: str, recipe: EvidenceRecipe, baseline: CountBaseline | None = None) -> None:
        self.key = key
        self.recipe = recipe
        self.baseline = baseline if baseline is not None and baseline.text == recipe.text else None
        self.requests = self._requests_learning()
        self._said = SaidSoFar()
        self._numbers = count(1)
        self._state: TrainingState | None = None
        self._waiting: deque[tuple[str, QueryResult]] = deque()
        self._training: CountTraining | None = CountTraining()
        self._now_us: int | None = None
        self._since_us: int | None = None
        """When it came into force."""
        self._safe_us = 0
        """Training lasts until then at least."""
        self._end_us: int | None = None
        """When training ends, as soon as that is known."""

    @property
    def learning(self) -> bool:
        """Whether results are learnt."""
        return self._training is not None

    def train(self, state: TrainingState) -> list[Evidence]:
        """Note how far the network's training is."""
        self._state = state
        if state.done:
            return self._decide()
        at_us = self._time_of(state)
        if self._training is None:  # the network trains again; until it is done the old baseline holds
            self._begin(at_us)
        if self._since_us is None:
            self._since_us = at_us
        self._end_us = None
        self._safe_us = max(self._safe_us, at_us)
        self._learn_waiting()
        return []

    def hear(self, now_us: int) -> list[Evidence]:
        """Capture time has come to `now_us`."""
        self._now_us = now_us
        if self._training is None:
            return []
        if self._since_us is None:
            self._since_us = now_us
        found = self._decide()
        if self._training is None or self._end_us is None:
            return found
        window_us = self.recipe.query.window_us
        if now_us < self._end_us + window_us + window_us // 4 + _SLACK_US:
            return found
        return found + self._close(self._training, self._end_us)

    def _time_of(self, state: TrainingState) -> int:
        """Capture time of a word about training."""
        at_us = state.event_time // 1000
        wrong = self._now_us is not None and at_us > self._now_us + _AHEAD_US
        return self._now_us if wrong and self._now_us is not None else at_us

    def _decide(self) -> list[Evidence]:
        """Decide when training ends, once the network's is over and this query has come as far."""
        state, since_us, now_us = self._state, self._since_us, self._now_us
        decided = self._training is None or self._end_us is not None
        if decided or since_us is None or now_us is None:
            return []
        if state is None:
            if now_us - since_us >= ALONE_US:
                self._end_us = since_us + ALONE_US  # nobody trains here
            return []
        at_us = self._time_of(state)
        if not state.done or now_us < at_us:
            return []
        self._safe_us = 0
        if at_us - since_us >= state.seconds * 1e6 / 2:
            self._end_us = at_us
        elif self.baseline is not None:
            return self._judge_from_now()
        else:
            self._end_us = since_us + min(max(_SHORTEST_US, int(state.seconds * 1e6)), _LONGEST_US)
        return []

    def take(self, switch: str, result: QueryResult) -> list[Evidence]:
        """A result of one of its requests: learnt, or weighed."""
        if self._training is None:
            return self._weighed(switch, result)
        if not result.exact and not self.recipe.crosses:
            return []
        self._waiting.append((switch, result))
        self._learn_waiting()
        return self._weighed(switch, result)

    def _begin(self, now_us: int) -> None:
        self._training, self._since_us, self._end_us = CountTraining(), now_us, None
        self.requests = self._requests_learning()

    def _learn_waiting(self) -> None:
        """Learn the results that belong to training for certain; if too many wait, the oldest as well."""
        assert self._training is not None  # noqa: S101 - called while it trains
        sure_us = max(self._safe_us, self._end_us or 0)
        waiting = self._waiting
        while waiting and (len(waiting) > _WAITING or _end_us(waiting[0][1]) <= sure_us):
            _, result = waiting.popleft()
            value = max(0.0, float(result.fields[self.recipe.measure]))
            self._training.learn(_subject(result)[0], result.window_us, result.length_us, value)

    def _close(self, training: CountTraining, end_us: int) -> list[Evidence]:
        """End training: what came after it is weighed."""
        self._learn_waiting()
        begin_us = self._since_us if self._since_us is not None else end_us
        recipe = self.recipe
        self.baseline = training.close(recipe.text, recipe.low, begin_us=begin_us, end_us=end_us)
        return self._judge_from_now()

    def _judge_from_now(self) -> list[Evidence]:
        self._training = None
        self.requests = self._requests_judging()
        waiting, self._waiting = self._waiting, deque()
        return [found for switch, result in waiting for found in self._weighed(switch, result)]

    def _requests_learning(self) -> tuple[QueryRequest, ...]:
        return (self.recipe.learning(self.key),)

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

    def _weighed(self, switch: str, result: QueryResult) -> list[Evidence]:
        baseline, recipe = self.baseline, self.recipe
        # a count that may be too large is no evidence: an innocent host may share it
        if baseline is None or result.may_be_too_large or (not result.exact and not recipe.crosses):
            return []
        subject = _subject(result)
        value = int(result.fields[recipe.measure])
        nats = self._said.added(subject, baseline.nats(subject[0], value), result.at_us)
        if not nats:
            return []
        return [self._evidence(switch, result, value, nats, baseline)]

    def _evidence(
        self, switch: str, result: QueryResult, value: int, nats: float, baseline: CountBaseline
    ) -> Evidence:
        fields, recipe = result.fields, self.recipe
        host = _subject(result)[0]
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


def _end_us(result: QueryResult) -> int:
    return result.window_us + result.length_us


def _subject(result: QueryResult) -> tuple[str, ...]:
    """Whose count it is: the host, by its address or MAC, first."""
    return tuple(str(result.fields[name]) for name in ("src", "mac", "dst") if name in result.fields)
