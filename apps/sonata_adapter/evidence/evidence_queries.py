"""All queries that are evidence: those under whose keys somebody has an interest.

network.evidence.sonata_adapter.<query> ─ wanted ─► requests, as if somebody wanted the query's results
results, training, capture time ─► evidence; baselines to keep
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Final

from apps.evidence import EVIDENCE, Evidence, TrainingState
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from apps.sonata_adapter.evidence.recipes import recipe_of
from apps.sonata_adapter.evidence.watched_query import WatchedQuery
from apps.sonata_adapter.keys import QueryRequest
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.results import QueryResult
from due import Key
from due.errors import DueError

EVIDENCE_PREFIX: Final = f"{EVIDENCE}.sonata_adapter"
MOST_QUERIES: Final = 64
_MOST_TRAINERS: Final = 16


class EvidenceQueries:
    """Not thread-safe: one thread calls at a time.

    Args:
        stored: the baseline that an earlier run has kept for a query, by name.
    """

    def __init__(self, stored: Callable[[str], CountBaseline | None] = lambda _: None) -> None:
        self._stored = stored
        self._watched: dict[str, WatchedQuery] = {}
        self._owners: dict[str, WatchedQuery] = {}
        """By identity of their requests."""
        self._training: dict[str, TrainingState] = {}
        self._kept: dict[str, CountBaseline | None] = {}
        self.written = 0

    @property
    def requests(self) -> tuple[QueryRequest, ...]:
        """What has to run."""
        return tuple(request for each in self._watched.values() for request in each.requests)

    def want(self, keys: Iterable[str], templates: Mapping[str, Template]) -> dict[str, str]:
        """Replace the wanted keys; returns those that cannot be served, and why."""
        refused: dict[str, str] = {}
        watched: dict[str, WatchedQuery] = {}
        for key in sorted(set(keys)):
            try:
                parsed = Key.parse(key)
                if not parsed.concrete:
                    continue  # a wildcard receives what others ask for
                recipe = recipe_of(_template(parsed, templates))
            except (SonataError, DueError) as error:
                refused[key] = str(error)
                continue
            if len(watched) >= MOST_QUERIES:
                refused[key] = f"{MOST_QUERIES} queries are evidence already; withdraw some"
                continue
            former = self._watched.get(key)
            if former is not None and former.recipe.text == recipe.text:
                watched[key] = former
                continue
            watched[key] = WatchedQuery(key, recipe, self._stored(recipe.name))
            if self._training:
                watched[key].train(self._network())
            self._kept[key] = watched[key].baseline
        self._watched = watched
        self._assign()
        return refused

    def owns(self, identity: str) -> bool:
        """Whether it is one of the requests."""
        return identity in self._owners

    def take(self, results: Iterable[tuple[str, str, QueryResult]]) -> list[tuple[str, Evidence]]:
        """Results, each with the identity of its request and its switch; returns keys and what to write there."""
        found: list[tuple[str, Evidence]] = []
        # thresholds of one query are reached one after the other, but may be reported in any order
        for identity, switch, result in sorted(results, key=lambda each: each[2].at_us):
            watched = self._owners.get(identity)
            if watched is not None:
                found += self._addressed(watched, watched.take(switch, result))
        return found

    def train(self, app: str, state: TrainingState) -> list[tuple[str, Evidence]]:
        """Note how far the training of an app is; the network's is over when that of all apps is."""
        if app in self._training or len(self._training) < _MOST_TRAINERS:
            self._training[app] = state
        network = self._network()
        found = [each for one in self._watched.values() for each in self._addressed(one, one.train(network))]
        self._assign()
        return found

    def hear(self, now_us: int) -> list[tuple[str, Evidence]]:
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

    def health(self) -> dict[str, str]:
        """For each query whether it learns, and the thresholds that it has."""
        return {
            each.recipe.name: "learning"
            if each.learning
            else ", ".join(one.identity for one in each.requests)
            for each in self._watched.values()
        }

    def _network(self) -> TrainingState:
        """The state of the app whose training is behind."""
        return min(self._training.values(), key=lambda state: (state.done, -state.event_time))

    def _assign(self) -> None:
        self._owners = {
            request.identity: each for each in self._watched.values() for request in each.requests
        }

    def _addressed(self, watched: WatchedQuery, found: list[Evidence]) -> list[tuple[str, Evidence]]:
        self.written += len(found)
        return [(watched.key, evidence) for evidence in found]


def _template(key: Key, templates: Mapping[str, Template]) -> Template:
    name = key.segments[-1]
    template = templates.get(name)
    if template is None or len(key.segments) != 4 or key.specs:
        raise SonataError(
            f"{key}: there is no such evidence; write {EVIDENCE_PREFIX}.<query> for one of {', '.join(templates)}"
        )
    return template
