"""Write: a batch of updates on the pipeline's entities, with one error per update.

CONTINUE_ON_ERROR   every update is tried
ROLLBACK_ON_ERROR   at the first failure what was done is undone; the rest is not tried
DATAPLANE_ATOMIC    the same, and no packet is processed until the batch is through
"""

import contextlib
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from dataplane.errors import DataplaneError
from dataplane.p4runtime import status
from dataplane.p4runtime.pipeline import ForwardingPipeline
from dataplane.p4runtime.status import Aborted, InvalidArgument, Refused, Unimplemented
from dataplane.p4runtime.table_entities import Undo
from p4rt import p4runtime

Handler = Callable[[int, Any], Undo]
_CONTINUE = p4runtime.WriteRequest.CONTINUE_ON_ERROR
_ROLLBACK = p4runtime.WriteRequest.ROLLBACK_ON_ERROR
_ATOMIC = p4runtime.WriteRequest.DATAPLANE_ATOMIC
_KINDS = (p4runtime.Update.INSERT, p4runtime.Update.MODIFY, p4runtime.Update.DELETE)


class Writer:
    """Applies the updates of WriteRequests; one batch at a time (the caller holds the control lock)."""

    def __init__(self, pipeline: ForwardingPipeline, cells: int = sys.maxsize) -> None:
        """cells: of counters, meters and registers that one batch may write."""
        self._cells, self._arrays = cells, pipeline.arrays
        self._lock = pipeline.switch.lock
        self._tables = pipeline.tables
        self._handlers: Mapping[str, Handler] = {
            "table_entry": pipeline.tables.write_entry,
            "direct_counter_entry": pipeline.tables.write_counter,
            "direct_meter_entry": pipeline.tables.write_meter,
            "counter_entry": pipeline.arrays.write_counter,
            "meter_entry": pipeline.arrays.write_meter,
            "register_entry": pipeline.arrays.write_register,
            "packet_replication_engine_entry": pipeline.replication.write,
            "digest_entry": pipeline.digests.write,
        }

    def apply(self, updates: Iterable[Any], atomicity: int) -> list[Refused | None]:
        """One result per update, None = done.  The list is empty where all succeeded.

        Raises InvalidArgument for another atomicity than the three.
        """
        if atomicity not in (_CONTINUE, _ROLLBACK, _ATOMIC):
            raise InvalidArgument(
                f"atomicity {atomicity} is none of CONTINUE_ON_ERROR, ROLLBACK_ON_ERROR, DATAPLANE_ATOMIC"
            )
        self._arrays.cells_left = self._cells
        if atomicity == _CONTINUE:
            return self._each(updates)
        with self._lock if atomicity == _ATOMIC else contextlib.nullcontext():
            return self._all_or_none(list(updates))

    def _each(self, updates: Iterable[Any]) -> list[Refused | None]:
        results: list[Refused | None] = []
        failed = False
        for update in updates:
            try:
                self._one(update)
            except DataplaneError as error:
                failed = True
                results.append(status.of(error))
            else:
                results.append(None)
        return results if failed else []

    def _all_or_none(self, updates: list[Any]) -> list[Refused | None]:
        undos: list[Undo] = []
        for position, update in enumerate(updates):
            try:
                undos.append(self._one(update))
            except DataplaneError as error:
                for undo in reversed(undos):
                    undo()
                return self._rolled_back(len(updates), position, status.of(error))
        return []

    @staticmethod
    def _rolled_back(count: int, position: int, cause: Refused) -> list[Refused | None]:
        results: list[Refused | None] = [
            Aborted(f"undone: update {position} of the batch failed") if n < position else None
            for n in range(count)
        ]
        results[position] = cause
        for later in range(position + 1, count):
            results[later] = Aborted(f"not tried: update {position} of the batch failed")
        return results

    def _one(self, update: Any) -> Undo:
        return self._tables.write_update(update) or self._read(update)

    def _read(self, update: Any) -> Undo:
        kind = update.type
        if kind not in _KINDS:
            raise InvalidArgument(f"update type {kind} is none of INSERT, MODIFY, DELETE")
        entity = update.entity
        entry = entity.table_entry
        if entry.table_id:
            # an unset entry has no id: the common case need not ask which kind it is
            undo = self._tables.write_entry(kind, entry)
            self._tables.learn(update, entry)
            return undo
        name = entity.WhichOneof("entity")
        handler = self._handlers.get(name)
        if handler is None:
            raise absent(name)
        return handler(kind, getattr(entity, name))


def absent(name: str | None) -> Refused:
    """The refusal of an entity kind without a handler."""
    if name is None:
        return InvalidArgument("the entity is empty")
    return Unimplemented(f"{name}: this target has none")
