"""Read: entities that match the request's filters, in messages of bounded size."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from dataplane import status
from dataplane.errors import DataplaneError
from dataplane.pipeline import Pipeline
from dataplane.status import Refused
from dataplane.writes import absent
from p4rt import p4runtime

_PER_RESPONSE = 512
Selector = Callable[[Any], Iterator[Any]]


class Reader:
    """Answers ReadRequests; the caller holds the control lock."""

    def __init__(self, pipeline: Pipeline) -> None:
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

    def read(self, filters: Any) -> tuple[list[Any], list[Refused | None]]:
        """All ReadResponses, and one result per filter (empty where all were valid)."""
        found: list[Any] = []
        results: list[Refused | None] = []
        for entity in filters:
            try:
                found += self._one(entity)
            except DataplaneError as error:
                results.append(status.of(error))
            else:
                results.append(None)
        responses = [
            p4runtime.ReadResponse(entities=found[start : start + _PER_RESPONSE])
            for start in range(0, len(found), _PER_RESPONSE)
        ]
        return responses, results if any(results) else []

    def _one(self, entity: Any) -> list[Any]:
        name = entity.WhichOneof("entity")
        selector = self._selectors.get(name)
        if selector is None:
            # an empty list is the truth about kinds that no program here can have
            if name is not None and name != "extern_entry":
                return []
            raise absent(name)
        return list(selector(getattr(entity, name)))
