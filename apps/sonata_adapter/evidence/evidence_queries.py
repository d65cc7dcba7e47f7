"""All queries that are evidence: those under whose keys somebody has an interest.

network.evidence.sonata_adapter.<query> ─ wanted ─► requests, as if somebody wanted the query's results
results, training, capture time ─► evidence; baselines to keep
"""

from collections.abc import Mapping
from typing import Final

from apps.evidence import EVIDENCE, Evidence
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.evidence.learnt_queries import MOST_QUERIES, LearntQueries
from apps.sonata_adapter.evidence.recipes import recipe_of
from apps.sonata_adapter.evidence.watched_query import WatchedQuery
from apps.sonata_adapter.query.catalogue import Template
from due import Key

EVIDENCE_PREFIX: Final = f"{EVIDENCE}.sonata_adapter"
__all__ = ("EVIDENCE_PREFIX", "MOST_QUERIES", "EvidenceQueries")


class EvidenceQueries(LearntQueries[WatchedQuery, Evidence]):
    """Those under whose keys somebody wants evidence."""

    def health(self) -> dict[str, str]:
        """For each query whether it learns, and the thresholds that it has."""
        return {
            each.recipe.name: "learning"
            if each.learning
            else ", ".join(one.identity for one in each.requests)
            for each in self._watched.values()
        }

    def _make(self, key: Key, templates: Mapping[str, Template]) -> WatchedQuery:
        recipe = recipe_of(_template(key, templates))
        return WatchedQuery(key.text, recipe, self._stored(recipe.name, recipe.text))


def _template(key: Key, templates: Mapping[str, Template]) -> Template:
    name = key.segments[-1]
    template = templates.get(name)
    if template is None or len(key.segments) != 4 or key.specs:
        raise SonataError(
            f"{key}: there is no such evidence; write {EVIDENCE_PREFIX}.<query> for one of {', '.join(templates)}"
        )
    return template
