"""When a replay may begin: every query that an app has asked for is served, by the switch and on the host.

Data is made on demand, so a frame that comes before its query is not counted.

    interests of apps ─► keys assigned to the Sonata adapter ─► its queries ─► requests in the switch
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final

from apps.sonata_adapter.keys import CAPTURE_PREFIX, HANDSHAKE, QUERY_PREFIX
from due.keys import Key
from sdnator.northbound import ask

ADAPTER: Final = "sonata_adapter"
_PREFIXES: Final = (QUERY_PREFIX, CAPTURE_PREFIX, HANDSHAKE)


def wanted_keys(interests: Iterable[Mapping[str, Any]]) -> frozenset[str]:
    """Canonical keys of queries that apps have an interest in, from the Coordinator's `/interests`."""
    texts = (str(one["key"]) for one in interests)
    keys = (Key.parse(text) for text in texts if text.startswith(_PREFIXES))
    # a wildcard asks for nothing: it receives what others ask for
    return frozenset(key.text for key in keys if key.concrete)


def assigned_keys(assignments: Iterable[Mapping[str, Any]]) -> frozenset[str]:
    """Canonical keys of queries that the adapter is to serve, or that cannot be met, from `/assignments`."""
    found = set()
    for app in assignments:
        if app["app_id"] == ADAPTER:
            found |= {Key.parse(one["key"]).text for one in app["assignments"]}
        found |= {Key.parse(one["key"]).text for one in app["incompatible"]}
    return frozenset(found)


class QueriesReady:
    """Looks at the Coordinator, the adapter and the switch until they agree.

    Args:
        url: of the Coordinator's HTTP API.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._wanted: frozenset[str] | None = None
        self.missing = "the Coordinator was not asked yet"
        """What is still missing, for people; empty: nothing."""

    def look(self, telemetry: Iterable[str]) -> bool:
        """Whether all are served; twice in a row, because apps ask for one key after the other.

        Args:
            telemetry: names of the requests that the switch has in force.

        Raises:
            PipelineError: the Coordinator does not answer.
        """
        wanted = wanted_keys(ask(self._url, "/interests"))
        before, self._wanted = self._wanted, wanted
        self.missing = self._missing(wanted, len([name for name in telemetry if _is_query(name)]))
        return not self.missing and before == wanted

    def _missing(self, wanted: frozenset[str], requests: int) -> str:
        if unassigned := wanted - assigned_keys(ask(self._url, "/assignments")):
            return f"no app produces {', '.join(sorted(unassigned))}"
        health = (ask(self._url, "/health")["apps"].get(ADAPTER) or {"health": {"app": {}}})["health"]["app"]
        served = len(health.get("queries", ())) + int(health.get("refused", 0))
        if served < len(wanted):
            return f"the Sonata adapter serves {served} of {len(wanted)} queries"
        if requests < int(health.get("bits", 0)):
            return f"the switch has {requests} of {health['bits']} requests for packets"
        return ""


def _is_query(name: str) -> bool:
    return name.startswith("q") and name[1:].isdecimal()
