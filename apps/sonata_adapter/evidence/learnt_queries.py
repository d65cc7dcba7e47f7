"""Queries that learn while the network trains: what has to run for them, and who gets which result.

keys ─ wanted ─► requests, as if somebody wanted the query's results
results, training, capture time ─► what the queries make of them; baselines to keep
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, Generic, TypeVar

from apps.evidence import TrainingState
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from apps.sonata_adapter.evidence.learnt_query import LearntQuery
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.results import QueryResult
from due import Key
from due.errors import DueError

MOST_QUERIES: Final = 64
_MOST_TRAINERS: Final = 16

Made = TypeVar("Made")
Learnt = TypeVar("Learnt", bound=LearntQuery[Any])


class LearntQueries(Generic[Learnt, Made]):
    """Not thread-safe: one thread calls at a time.

    Args:
        stored: the baseline that an earlier run has kept for a query, by its name and the text it belongs to.
    """

    def __init__(
        self, stored: Callable[[str, str], CountBaseline | None] = lambda _name, _text: None
    ) -> None:
        self._stored = stored
        self._watched: dict[str, Learnt] = {}
        self._owners: dict[str, list[Learnt]] = {}
        """By identity of their requests; those that learn the same share one."""
        self._training: dict[str, TrainingState] = {}
        self._kept: dict[str, CountBaseline | None] = {}
        self.written = 0

    @property
    def requests(self) -> tuple[QueryRequest, ...]:
        """What has to run."""
        found = {one.identity: one for each in self._watched.values() for one in each.requests}
        return tuple(found.values())

    def want(self, keys: Iterable[str], templates: Mapping[str, Template]) -> dict[str, str]:
        """Replace the wanted keys; returns those that cannot be served, and why."""
        refused: dict[str, str] = {}
        watched: dict[str, Learnt] = {}
        for key in sorted(set(keys)):
            try:
                parsed = Key.parse(key)
                if not parsed.concrete:
                    continue  # a wildcard receives what others ask for
                made = self._make(parsed, templates)
            except (SonataError, DueError) as error:
                refused[key] = str(error)
                continue
            if len(watched) >= MOST_QUERIES:
                refused[key] = f"{MOST_QUERIES} queries are already learning; withdraw some"
                continue
            former = self._watched.get(key)
            if former is not None and former.recipe.text == made.recipe.text:
                watched[key] = former
                continue
            watched[key] = made
            if self._training:
                made.train(self._network())
            self._kept[key] = made.baseline
        self._watched = watched
        self._kept = {key: baseline for key, baseline in self._kept.items() if key in watched}
        self._assign()
        return refused

    def owns(self, identity: str) -> bool:
        """Whether it is one of the requests."""
        return identity in self._owners

    def take(self, results: Iterable[tuple[str, str, QueryResult]]) -> list[tuple[str, Made]]:
        """Results, each with the identity of its request and its switch; returns keys and what to write there."""
        found: list[tuple[str, Made]] = []
        # thresholds of one query are reached one after the other, but may be reported in any order
        for identity, switch, result in sorted(results, key=lambda each: each[2].at_us):
            for watched in self._owners.get(identity, ()):
                found += self._addressed(watched, watched.take(switch, result))
        return found

    def train(self, app: str, state: TrainingState) -> list[tuple[str, Made]]:
        """Note the progress of an app's training; the network's is over when that of all apps is."""
        if app in self._training or len(self._training) < _MOST_TRAINERS:
            self._training[app] = state
        network = self._network()
        found = [each for one in self._watched.values() for each in self._addressed(one, one.train(network))]
        self._assign()
        return found

    def hear(self, now_us: int) -> list[tuple[str, Made]]:
        """Capture time has come to `now_us`."""
        found = [each for one in self._watched.values() for each in self._addressed(one, one.hear(now_us))]
        self._assign()
        return found

    def learnt(self) -> list[tuple[str, CountBaseline]]:
        """Baselines that are new since the last call, by the name of their query."""
        found: list[tuple[str, CountBaseline]] = []
        for key, watched in self._watched.items():
            if watched.baseline is not None and watched.baseline is not self._kept.get(key):
                self._kept[key] = watched.baseline
                found.append((watched.recipe.name, watched.baseline))
        return found

    @abstractmethod
    def _make(self, key: Key, templates: Mapping[str, Template]) -> Learnt:
        """The query of a key; raises `SonataError` for one that cannot be served."""

    def _network(self) -> TrainingState:
        """The state of the app whose training is behind."""
        return min(self._training.values(), key=lambda state: (state.done, -state.event_time))

    def _assign(self) -> None:
        self._owners = {}
        for each in self._watched.values():
            for request in each.requests:
                self._owners.setdefault(request.identity, []).append(each)

    def _addressed(self, watched: Learnt, found: list[Made]) -> list[tuple[str, Made]]:
        self.written += len(found)
        return [(watched.key, made) for made in found]
