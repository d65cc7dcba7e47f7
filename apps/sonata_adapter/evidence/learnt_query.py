"""One query that learns what is normal while the network trains, and is judged by that afterwards.

    training ─ each count from a quarter of the threshold on, at the window's end ─► `CountBaseline`
    after it ─ results at thresholds that fit this network ─► what a subclass makes of them

Time is capture time, microseconds.
"""

from abc import ABC, abstractmethod
from collections import deque
from typing import Final, Generic, TypeVar

from apps.evidence import TrainingState
from apps.sonata_adapter.evidence.count_baseline import CountBaseline, CountTraining
from apps.sonata_adapter.evidence.recipes import EvidenceRecipe
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.results import QueryResult

ALONE_US: Final = 3_600_000_000
"""Length of training if no app reports one."""
SLACK_US: Final = 1_000_000
"""Beyond a quarter of the window: results of a window may take so long after its end."""
_SHORTEST_US: Final = 60_000_000
_LONGEST_US: Final = 7 * 86_400_000_000
"""The shortest and the longest training of a query that has missed the network's."""
_AHEAD_US: Final = 3_600_000_000
"""A time of training that is farther ahead of the packets than this is wrong."""
_WAITING: Final = 8_192

Made = TypeVar("Made")
"""What a result leads to."""


class LearntQuery(ABC, Generic[Made]):
    """A query that learns while the network trains; a subclass decides what its results lead to afterwards.

    Args:
        key: of the interest.
        recipe: what it counts.
        baseline: of an earlier run, if there is one for this query.
    """

    def __init__(self, key: str, recipe: EvidenceRecipe, baseline: CountBaseline | None = None) -> None:
        self.key = key
        self.recipe = recipe
        self.baseline = baseline if baseline is not None and baseline.text == recipe.text else None
        self.requests = self._requests_learning()
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

    def train(self, state: TrainingState) -> list[Made]:
        """Note the progress of the network's training."""
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

    def hear(self, now_us: int) -> list[Made]:
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
        if now_us < self._end_us + window_us + window_us // 4 + SLACK_US:
            return found
        return found + self._close(self._training, self._end_us)

    def _time_of(self, state: TrainingState) -> int:
        """Capture time of a word about training."""
        at_us = state.event_time // 1000
        wrong = self._now_us is not None and at_us > self._now_us + _AHEAD_US
        return self._now_us if wrong and self._now_us is not None else at_us

    def _decide(self) -> list[Made]:
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

    def take(self, switch: str, result: QueryResult) -> list[Made]:
        """A result of one of its requests: learnt, or judged."""
        if self._training is None:
            return self._judged(switch, result)
        if not result.exact and not self.recipe.crosses:
            return []
        self._waiting.append((switch, result))
        self._learn_waiting()
        return self._judged(switch, result)

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
            self._training.learn(subject_of(result)[0], result.window_us, result.length_us, value)

    def _close(self, training: CountTraining, end_us: int) -> list[Made]:
        """End training: what came after it is judged."""
        self._learn_waiting()
        begin_us = self._since_us if self._since_us is not None else end_us
        recipe = self.recipe
        self.baseline = training.close(recipe.text, recipe.low, begin_us=begin_us, end_us=end_us)
        return self._judge_from_now()

    def _judge_from_now(self) -> list[Made]:
        self._training = None
        self.requests = self._requests_judging()
        waiting, self._waiting = self._waiting, deque()
        return [found for switch, result in waiting for found in self._judged(switch, result)]

    def _requests_learning(self) -> tuple[QueryRequest, ...]:
        return (self.recipe.learning(self.key),)

    @abstractmethod
    def _requests_judging(self) -> tuple[QueryRequest, ...]:
        """What runs after training."""

    @abstractmethod
    def _judged(self, switch: str, result: QueryResult) -> list[Made]:
        """Process a result after training; during training, by an older baseline."""


def _end_us(result: QueryResult) -> int:
    return result.window_us + result.length_us


def subject_of(result: QueryResult) -> tuple[str, ...]:
    """Whose count it is: the host, by its address or MAC, first."""
    return tuple(str(result.fields[name]) for name in ("src", "mac", "dst") if name in result.fields)
