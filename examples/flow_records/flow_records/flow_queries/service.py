"""Flow records in, results of Sonata queries out.

network.flows.flow_records.<exporter> ──► FlowQueries ──► network.traffic_query.flow_queries.<query>:window=3s,…
                                                    └──► network.incompatible.flow_queries.<query>
"""

import logging
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

import due.service
from apps.messages import Intake, one_line, sender_of
from apps.sonata_adapter.errors import SonataError
from apps.sonata_adapter.query.catalogue import CATALOGUE, Template
from apps.sonata_adapter.query.templates import QueryFolder, own_queries
from due import NO_WAIT, Assignment, Capability, Engine, Interest, Item, RecordBatch
from due.errors import InvalidOption
from flow_records.columns import FLOWS, read_flows
from flow_records.flow_queries.query_windows import RESULTS, FlowResult, QueryWindows
from flow_records.packet_rows import DEFAULT_MOST

INTERESTS = (Interest(f"{FLOWS}.*"),)
_INCOMPATIBLE: Final = "network.incompatible.flow_queries"
_PARAMETERS: Final = sorted({each.name for template in CATALOGUE.values() for each in template.parameters})
CAPABILITIES = (
    Capability(
        f"{RESULTS}.*:{','.join(f'{name}=*' for name in _PARAMETERS)}", delivery="reliable", archive="always"
    ),
    Capability(f"{_INCOMPATIBLE}.*", archive="always"),
)
_LEAST_DELAY_S: Final = 0.0
_MOST_DELAY_S: Final = 3_600.0

log = logging.getLogger("flow_queries")


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the queries over flow records."""

    queries: tuple[str, ...] = ()
    """Queries that run even if nobody asks, their results archived: `new_tcp`, `port_scan:threshold=20`."""
    delay_s: float = 75.0
    """How long after its first packet a record may come: the exporters' active time-out, and some more."""
    most_packets: int = DEFAULT_MOST
    """Packets as which the records of one item are counted; beyond that, counts of packets are too small."""
    own_queries: str = ""
    """Folder of your own queries; empty: `$SDNATOR_QUERIES`, or one in the home folder."""

    def __post_init__(self) -> None:
        if not _LEAST_DELAY_S <= self.delay_s <= _MOST_DELAY_S:
            raise ValueError(f"delay_s={self.delay_s}: {_LEAST_DELAY_S:g} to {_MOST_DELAY_S:g} s")
        if not 1 <= self.most_packets <= 1 << 20:
            raise ValueError(f"most_packets={self.most_packets}: 1 to {1 << 20}")


class FlowQueriesService:
    """The app as `due.service.run` drives it."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        self._engine = engine
        self._always = frozenset(f"{RESULTS}.{query}" for query in settings.queries)
        self._folder = QueryFolder(Path(settings.own_queries) if settings.own_queries else own_queries())
        self._windows = QueryWindows(int(settings.delay_s * 1e6), settings.most_packets)
        self._lock = threading.Lock()
        self._intake = Intake(log)
        self._written = 0
        self._refused: frozenset[str] = frozenset()

    def start(self) -> None:
        """Subscribe.

        Raises:
            InvalidOption: a query of the settings cannot run.
        """
        refused = self._want(())
        if refused:
            raise InvalidOption(f"flow_queries.queries: {one_line(next(iter(refused.values())))}")
        self._engine.observe(f"{FLOWS}.*").subscribe(self._intake.reading("flows", _flows_in, self._on_flows))
        self._engine.on_assignments(self._on_assignments)

    def tick(self) -> None:
        """Close windows whose time is over."""
        with self._lock:
            self._write(self._windows.advance(time.monotonic()))

    def stop(self) -> None:
        """Write the results of open windows."""
        with self._lock:
            self._write(self._windows.finish())

    def health(self) -> dict[str, Any]:
        """Counters for `sdnator status` and Prometheus."""
        with self._lock:
            return {**self._windows.health(), "results": self._written, **self._intake.health()}

    def _on_assignments(self, assignments: tuple[Assignment, ...]) -> None:
        wanted = [each.key for each in assignments if each.key.startswith(f"{RESULTS}.")]
        for key, reason in self._want(wanted).items():
            log.warning("%s", one_line(reason))
            name = key.partition(":")[0].rpartition(".")[2]
            self._engine.write(f"{_INCOMPATIBLE}.{name}", {"key": key, "reason": reason}, [NO_WAIT])

    def _want(self, keys: Iterable[str]) -> dict[str, str]:
        """Answer these keys and those of the settings; returns what was refused and had not been before."""
        with self._lock:
            refused = self._windows.want(self._always.union(keys), self._templates())
            new = {key: reason for key, reason in refused.items() if key not in self._refused}
            self._refused = frozenset(refused)
        return new

    def _templates(self) -> dict[str, Template]:
        try:
            return self._folder.templates()
        except (SonataError, OSError) as error:
            log.error("own queries are left out: %s", error)  # noqa: TRY400 - one clear line
            return dict(CATALOGUE)

    def _on_flows(self, item: Item, flows: RecordBatch) -> None:
        with self._lock:
            self._write(self._windows.take(item.key.rpartition(".")[2], flows, time.monotonic()))

    def _write(self, found: Iterable[FlowResult]) -> None:
        for one in found:
            self._written += 1
            self._engine.write(one.key, one.to_value(), [NO_WAIT], event_time=one.result.at_us * 1000)


def _flows_in(item: Item) -> RecordBatch:
    """The decoder of received flows; raises `MessageError`."""
    sender_of(item)
    return read_flows(item.value)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the queries until a signal ends them."""
    return due.service.run("flow_queries", FlowQueriesService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
