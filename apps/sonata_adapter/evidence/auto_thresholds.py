"""`threshold=auto`: thresholds that fit the network, with a budget of false reports.

network.traffic_query.sonata.<query>:threshold=auto ─ wanted ─► it learns, then runs at a threshold of its own
training ─► baseline ─► the count that benign traffic reaches once in 100 hours ─► results from there on
                     └► the count that new hosts reach so rarely, since they are few ─► results of new hosts
less than that, but more than training saw, or a new host ─► the baseline follows

Where a result says no count but names limits on both sides, as slowloris does, the lower limit is learnt.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from apps.sonata_adapter.errors import InvalidRequest
from apps.sonata_adapter.evidence.count_baseline import CountBaseline
from apps.sonata_adapter.evidence.known_hosts import KnownHosts
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
_MOST_A_SECOND: Final = 10.0
"""Results a second of training: where there were more, they are not looked at afterwards to tell who is new."""
_MOST_WAITING: Final = 4_096


class Thresholds(msgspec.Struct, frozen=True):
    """Counts from which a result is reported; benign traffic reaches them `FALSE_AN_HOUR` times an hour in all."""

    known: int
    """Of hosts that were seen before."""
    new: int
    """Of all others; the same where it is not known who is new."""

    @classmethod
    def of(cls, baseline: CountBaseline, declared: int) -> "Thresholds":
        """Those that fit what training saw.

        Where training has not even seen the lowest count that it looks for, the declared threshold holds: it is
        about four times that.  Half of the budget is for new hosts, if they are told apart.
        """
        if not baseline.windows:
            return cls(declared, declared)
        known, new = baseline.rare(FALSE_AN_HOUR / 2), baseline.rare_when_new(FALSE_AN_HOUR / 2)
        if new < known and baseline.windows <= _MOST_A_SECOND * baseline.seconds:
            return cls(known, new)
        same = baseline.rare(FALSE_AN_HOUR)
        return cls(same, same)


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
        self.thresholds: Thresholds | None = None
        """None while it learns for the first time."""
        self._known: KnownHosts | None = None
        self._judged_us = 0
        """When the thresholds were chosen."""
        self._low: dict[tuple[tuple[str, ...], int], tuple[int, int]] = {}
        """Hosts to be learnt, by window: when the window is over, us, and the highest count."""
        self._high: dict[tuple[tuple[str, ...], int], set[str]] = {}
        """The last hosts that were reported, by window, and from which switches; other reports of them may be late."""

    def hear(self, now_us: int) -> list[QueryResult]:
        """Capture time has come to `now_us`: follow what was benign."""
        found = super().hear(now_us)
        over = [place for place, (end_us, _) in self._low.items() if end_us <= now_us]
        for place in over:
            _, count = self._low.pop(place)
            if place not in self._high:
                self._follow(place[0][0], count, place[1])
        baseline, known = self.baseline, self._known
        if baseline is None or known is None or self.learning or now_us - self._judged_us < FOLLOW_US:
            return found
        self.baseline = known.noted(baseline, (now_us - self._judged_us) / 1e6)
        self.requests = self._requests()
        return found

    def _requests_judging(self) -> tuple[QueryRequest, ...]:
        assert self.baseline is not None  # noqa: S101 - it is set before results are judged
        self._known = KnownHosts(self.baseline)
        return self._requests()

    def _requests(self) -> tuple[QueryRequest, ...]:
        baseline, recipe = self.baseline, self.recipe
        assert baseline is not None  # noqa: S101 - it is set before results are judged
        self._judged_us = self._now_us or 0
        chosen = self.thresholds = Thresholds.of(baseline, recipe.declared)
        if chosen.new < chosen.known and not recipe.crosses:
            return self._requests_learning()  # it goes on: no window is lost
        lowest = recipe.low
        if chosen.new == chosen.known:
            beyond = max(recipe.low, int(max(baseline.newcomer, baseline.low - 1.0)) + 1)
            lowest = min(beyond, chosen.known)
        counts = {lowest, chosen.new, chosen.known} if recipe.crosses else {lowest}
        return tuple(recipe.at(self.key, each) for each in sorted(counts))

    def _judged(self, switch: str, result: QueryResult) -> list[QueryResult]:
        count = int(result.fields[self.recipe.measure])
        baseline, known, chosen = self.baseline, self._known, self.thresholds
        if baseline is None or known is None or chosen is None or result.may_be_too_large:
            return []
        end_us = result.window_us + result.length_us + result.length_us // 4 + SLACK_US
        subject = subject_of(result)
        place, seen_before = (subject, result.window_us), known.knows(subject[0], result.window_us)
        if count >= (chosen.known if seen_before else chosen.new):
            if not seen_before:
                known.suspect(subject[0], result.window_us, result.length_us)
            return self._reported(switch, place, result)
        # what began before the thresholds were chosen may be counted in part: of an attack, too
        if result.window_us < self._judged_us or (seen_before and count <= baseline.newcomer):
            return []
        _, former = self._low.get(place, (end_us, 0))
        if former or len(self._low) < _MOST_WAITING:
            self._low[place] = (end_us, max(former, count))
        return []

    def _reported(
        self, switch: str, place: tuple[tuple[str, ...], int], result: QueryResult
    ) -> list[QueryResult]:
        """The result, unless this switch has already said so of this host in this window."""
        switches = self._high.setdefault(place, set())
        if switch in switches:
            return []
        switches.add(switch)
        if len(self._high) > _MOST_WAITING:
            del self._high[next(iter(self._high))]
        return [result]

    def _follow(self, host: str, count: int, window_us: int) -> None:
        """Benign traffic of a host has come to this count."""
        baseline = self.baseline
        if self._known is not None:
            self._known.meet(host, window_us, self.recipe.query.window_us)
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
        return {each.output: _health(each) for each in self._watched.values()}

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


def _health(query: AutoQuery) -> str:
    chosen, measure = query.thresholds, query.recipe.measure
    if chosen is None:
        return "learning"
    new = f", of new hosts >= {chosen.new}" if chosen.new < chosen.known else ""
    return f"{measure} >= {chosen.known}{new}"


def auto_told(query: AutoQuery) -> dict[str, Any]:
    """What `explain` says about the threshold."""
    baseline, chosen = query.baseline, query.thresholds
    if chosen is None or baseline is None:
        nothing = {"threshold": None, "new_hosts_threshold": None}
        return {**nothing, "learning": True, "text": auto_text(query)}
    return {
        "text": auto_text(query),
        "threshold": chosen.known,
        "new_hosts_threshold": chosen.new,
        "measure": query.recipe.measure,
        "learning": query.learning,
        "usual": baseline.newcomer,
        "seconds": baseline.seconds,
        "false_an_hour": FALSE_AN_HOUR,
    }


def auto_text(query: AutoQuery) -> str:
    """The same in a sentence."""
    baseline, chosen, measure = query.baseline, query.thresholds, query.recipe.measure
    if chosen is None or baseline is None:
        return f"threshold=auto: it learns how far {measure} comes here, and reports nothing before it knows"
    seen = f"training saw {baseline.newcomer:,.0f} at most" if baseline.windows else "training saw none"
    new = f", of hosts that are new here from {chosen.new:,} on" if chosen.new < chosen.known else ""
    return (
        f"threshold=auto: {measure} >= {chosen.known:,} is reported{new}; {seen}, in {baseline.seconds:,.0f} s; "
        f"budget {FALSE_AN_HOUR:g} false reports an hour"
    )
