"""`threshold=auto`: thresholds that fit the network, with a budget of false reports.

network.traffic_query.sonata.<query>:threshold=auto ─ wanted ─► it learns, then runs at a threshold of its own
training ─► baseline ─► the count that benign traffic reaches once in 100 hours ─► results from there on
less than that, but more than training saw ─► the baseline follows

Where a result says no count but names limits on both sides, as slowloris does, the lower limit is learnt.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from apps.sonata_adapter.evidence.learnt_queries import LearntQueries
from apps.sonata_adapter.evidence.learnt_query import SLACK_US, LearntQuery, subject_of
from apps.sonata_adapter.evidence.recipes import EvidenceRecipe, plain_recipe_of
from apps.sonata_adapter.keys import QUERY_PREFIX, QueryRequest, is_auto, values_beside_auto
from apps.sonata_adapter.query.catalogue import Template
from apps.sonata_adapter.results import QueryResult
from due import Key
from due.errors import DueError

FALSE_AN_HOUR: Final = 0.01
"""False reports of a query that are accepted."""
FOLLOW_US: Final = 3_600_000_000
"""A threshold changes at most once in so long: with it the entry in the switch changes."""
_MOST_WAITING: Final = 4_096


def auto_threshold(baseline: CountBaseline, declared: int) -> int:
    """The count from which a result is reported: benign traffic reaches it `FALSE_AN_HOUR` times an hour.

    Where training has not even seen the lowest count that it looks for, the declared threshold holds: it is about
    four times that.
    """
    return baseline.rare(FALSE_AN_HOUR) if baseline.windows else declared


class AutoQuery(LearntQuery[QueryResult]):
    """A query at a threshold of its own.

    Args:
        key: of the interest.
        output: the key of its results.
        recipe: what it counts.
        baseline: of an earlier run.
    """

    def __init__(
        self, key: str, output: str, recipe: EvidenceRecipe, baseline: CountBaseline | None = None
    ) -> None:
        super().__init__(key, recipe, baseline)
        self.output = output
        self.threshold: int | None = None
        """None while it learns for the first time."""
        self._judged_us = 0
        """When the threshold was chosen."""
        self._low: dict[tuple[tuple[str, ...], int], tuple[int, int]] = {}
        """Hosts beyond the baseline, by window: when the window is over, us, and the highest count."""
        self._high: dict[tuple[tuple[str, ...], int], int] = {}
        """Hosts reported in each window, until it is over."""

    def hear(self, now_us: int) -> list[QueryResult]:
        """Capture time has come to `now_us`: follow what was benign."""
        found = super().hear(now_us)
        over = [place for place, (end_us, _) in self._low.items() if end_us <= now_us]
        for place in over:
            _, count = self._low.pop(place)
            if place not in self._high:
                self._follow(count)
        for place in [place for place, end_us in self._high.items() if end_us <= now_us]:
            del self._high[place]
        if self.threshold is not None and not self.learning and now_us - self._judged_us >= FOLLOW_US:
            self.requests = self._requests_judging()
        return found

    def _requests_judging(self) -> tuple[QueryRequest, ...]:
        baseline, now_us = self.baseline, self._now_us or 0
        assert baseline is not None  # noqa: S101 - it is set before results are judged
        self._judged_us = now_us
        self.threshold = auto_threshold(baseline, self.recipe.declared)
        beyond = max(self.recipe.low, int(max(baseline.newcomer, baseline.low - 1.0)) + 1)
        thresholds = {min(beyond, self.threshold)}
        if self.recipe.crosses:
            thresholds.add(self.threshold)
        return tuple(self.recipe.at(self.key, each) for each in sorted(thresholds))

    def _judged(self, switch: str, result: QueryResult) -> list[QueryResult]:  # noqa: ARG002
        count = int(result.fields[self.recipe.measure])
        if self.threshold is None or result.may_be_too_large:
            return []
        end_us = result.window_us + result.length_us + result.length_us // 4 + SLACK_US
        place = (subject_of(result), result.window_us)
        if count >= self.threshold:
            self._high[place] = end_us
            while len(self._high) > _MOST_WAITING:
                del self._high[next(iter(self._high))]
            return [result]
        if len(self._low) < _MOST_WAITING:
            self._low[place] = (end_us, count)
        return []

    def _follow(self, count: int) -> None:
        """Benign traffic has come to this count."""
        baseline = self.baseline
        if baseline is not None and count > baseline.newcomer:
            newest = (*baseline.maxima[1:], float(count)) if baseline.maxima else ()
            self.baseline = msgspec.structs.replace(baseline, newcomer=float(count), maxima=newest)


class AutoThresholds(LearntQueries[AutoQuery, QueryResult]):
    """Queries whose keys say `threshold=auto`."""

    def outputs(self, keys: Iterable[str]) -> set[str]:
        """The keys under which results for these keys are written."""
        return {self._watched[key].output for key in keys if key in self._watched}

    def of(self, key: str) -> AutoQuery | None:
        """The query of a key that is wanted."""
        return self._watched.get(key)

    def health(self) -> dict[str, str]:
        """For each key the threshold, or that it learns."""
        return {
            each.output: "learning"
            if each.threshold is None
            else f"{each.recipe.measure} >= {each.threshold}"
            for each in self._watched.values()
        }

    def _make(self, key: Key, templates: Mapping[str, Template]) -> AutoQuery:
        template = templates.get(key.segments[-1])
        if template is None or ".".join(key.segments[:-1]) != QUERY_PREFIX:
            raise InvalidRequest(
                f"{key}: there is no query {key.segments[-1]}; there are {', '.join(templates)}"
            )
        values, output = values_beside_auto(key, template)
        recipe = plain_recipe_of(template, values)
        return AutoQuery(key.text, output, recipe, self._stored(recipe.name, recipe.text))


def auto_keys(keys: Iterable[str]) -> frozenset[str]:
    """Those that say `threshold=auto`."""
    found: set[str] = set()
    for key in keys:
        try:
            parsed = Key.parse(key)
        except DueError:
            continue
        if is_auto(parsed):
            found.add(key)
    return frozenset(found)


def auto_told(query: AutoQuery) -> dict[str, Any]:
    """What `explain` says about the threshold."""
    baseline = query.baseline
    if query.threshold is None or baseline is None:
        return {"threshold": None, "learning": True, "text": auto_text(query)}
    return {
        "text": auto_text(query),
        "threshold": query.threshold,
        "measure": query.recipe.measure,
        "learning": query.learning,
        "usual": baseline.newcomer,
        "seconds": baseline.seconds,
        "false_an_hour": FALSE_AN_HOUR,
    }


def auto_text(query: AutoQuery) -> str:
    """The same in a sentence."""
    baseline, measure = query.baseline, query.recipe.measure
    if query.threshold is None or baseline is None:
        return f"threshold=auto: it learns how far {measure} comes here, and reports nothing before it knows"
    seen = f"training saw {baseline.newcomer:,.0f} at most" if baseline.windows else "training saw none"
    return (
        f"threshold=auto: {measure} >= {query.threshold:,} is reported; {seen}, in {baseline.seconds:,.0f} s; "
        f"budget {FALSE_AN_HOUR:g} false reports an hour"
    )
