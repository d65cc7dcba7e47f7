"""Read: entities that match the request's filters, in pages that are made one at a time.

    Reader ── page ──► ReadResponse ── sent ──► page …      between two pages everybody else has a turn

A page is consistent in itself; what is written between two pages may be in the later one.  What one Read may
ask for is bounded, since six bytes can ask for all cells of all registers.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from dataplane.errors import DataplaneError
from dataplane.p4runtime import status
from dataplane.p4runtime.pipeline import ForwardingPipeline
from dataplane.p4runtime.status import Exhausted, Refused
from dataplane.p4runtime.table_entities import PAGE
from dataplane.p4runtime.writes import absent
from p4rt import p4runtime

MOST_FILTERS = 1 << 16
"""Entities of a ReadRequest."""
MOST_CELLS = 1 << 16
"""Cells of counter, meter and register arrays that one Read may ask for."""
MOST_ENTRIES = 1 << 22
"""Table entries that one Read may look at, over all of its filters."""
Selector = Callable[[Any], Iterator[Any]]


class Reader:
    """Answers ReadRequests; the caller holds the control lock while it takes a page."""

    def __init__(self, pipeline: ForwardingPipeline) -> None:
        self.pipeline = pipeline
        self._selectors: Mapping[str, Selector] = {
            "table_entry": pipeline.tables.read_entries,
            "direct_counter_entry": pipeline.tables.read_counters,
            "direct_meter_entry": pipeline.tables.read_meters,
            "counter_entry": pipeline.arrays.read_counters,
            "meter_entry": pipeline.arrays.read_meters,
            "register_entry": pipeline.arrays.read_registers,
            "packet_replication_engine_entry": pipeline.replication.read,
            "digest_entry": pipeline.digests.read,
        }

    def check(self, filters: Any) -> None:
        """Raises Exhausted where the filters ask for more than one Read may."""
        if len(filters) > MOST_FILTERS:
            raise Exhausted(f"the Read has {len(filters)} entities; at most {MOST_FILTERS} in one call")
        cells = entries = 0
        for entity in filters:
            cells += self.pipeline.arrays.cells_asked_for(entity)
            entries += self.pipeline.tables.entries_looked_at(entity)
            if cells > MOST_CELLS:
                raise Exhausted(
                    f"the Read asks for more than {MOST_CELLS} cells: name the array by its id and cells by index,"
                    f" at most {MOST_CELLS} in one call"
                )
            if entries > MOST_ENTRIES:
                raise Exhausted(
                    f"the Read looks at more than {MOST_ENTRIES} entries: ask for fewer tables in one call"
                )

    def pages(self, filters: Iterable[Any], results: list[Refused | None]) -> Iterator[Any]:
        """ReadResponses of about PAGE entities, some of them empty; then `results` has one for each filter."""
        page: list[Any] = []
        for entity in filters:
            try:
                for found in self._one(entity):
                    if found is None or len(page) >= PAGE:
                        yield p4runtime.ReadResponse(entities=page)
                        page = []
                    if found is not None:
                        page.append(found)
            except DataplaneError as error:
                results.append(status.of(error))
            else:
                results.append(None)
        yield p4runtime.ReadResponse(entities=page)

    def read(self, filters: Iterable[Any]) -> tuple[list[Any], list[Refused | None]]:
        """Everything at once: ReadResponses, and one result per filter (empty where all were valid)."""
        results: list[Refused | None] = []
        responses = [page for page in self.pages(filters, results) if page.entities]
        return responses, results if any(results) else []

    def _one(self, entity: Any) -> Iterator[Any | None]:
        """Entities of one filter; None where the work so far is worth a page."""
        name = entity.WhichOneof("entity")
        selector = self._selectors.get(name)
        if selector is None:
            # an empty list is the truth about kinds that no program here can have
            if name is not None and name != "extern_entry":
                return iter(())
            raise absent(name)
        return selector(getattr(entity, name))
