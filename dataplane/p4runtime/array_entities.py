"""CounterEntry, MeterEntry and RegisterEntry: arrays that are read and written by index."""

import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from dataplane.p4runtime import bytestrings
from dataplane.p4runtime.meters import meter_config, write_meter_config
from dataplane.p4runtime.schema import BoundArray, Schema
from dataplane.p4runtime.status import Exhausted, InvalidArgument, OutOfRange, Unimplemented
from dataplane.p4runtime.table_entities import MODIFY, PAGE, Undo, counter_value, write_counter
from dataplane.v1model.switch import Switch
from p4rt import p4runtime

V = TypeVar("V")
_ARRAYS = {"counter_entry": "counter_id", "meter_entry": "meter_id", "register_entry": "register_id"}


class ArrayEntities:
    """The indirect counters, meters and registers of a pipeline."""

    def __init__(self, schema: Schema, switch: Switch) -> None:
        self._schema = schema
        self._switch = switch
        self.cells_left = sys.maxsize
        """Cells that may still be written by the Write in hand."""

    def cells_asked_for(self, entity: Any) -> int:
        """How many cells a Read of this filter gives."""
        name = entity.WhichOneof("entity")
        if name not in _ARRAYS:
            return 0
        message, number = getattr(entity, name), _ARRAYS[name]
        if message.HasField("index"):
            return 1
        arrays: Mapping[int, BoundArray] = getattr(self._schema, f"{number.removesuffix('_id')}s")
        wanted = getattr(message, number)
        return sum(array.size for array in arrays.values() if wanted in (0, array.id))

    def _spent(self, message: Any, array: BoundArray) -> range:
        indices = _indices(message, array)
        if len(indices) > self.cells_left:
            raise Exhausted(f"{array.name}: the Write has no more cells left: write fewer at once, by index")
        self.cells_left -= len(indices)
        return indices

    def write_counter(self, kind: int, message: Any) -> Undo:
        """Modify a CounterEntry; without an index, all cells of the array."""
        array = _one(kind, message.counter_id, self._schema.counters, "counter")
        cells = self._switch.counters[array.name]
        if not message.HasField("data"):
            return _nothing
        value = counter_value(message.data, array.name)
        return _write_all(self._spent(message, array), cells.read, cells.write, value)

    def write_meter(self, kind: int, message: Any) -> Undo:
        """Modify a MeterEntry; without a config, back to always green."""
        array = _one(kind, message.meter_id, self._schema.meters, "meter")
        if message.HasField("counter_data"):
            raise Unimplemented(f"meter {array.name}: this target does not count by meter colour")
        cells = self._switch.meters[array.name]
        config = None
        if message.HasField("config"):
            config = meter_config(message.config, array.meter_type, array.name)
        return _write_all(self._spent(message, array), cells.config, cells.configure, config)

    def write_register(self, kind: int, message: Any) -> Undo:
        """Modify a RegisterEntry; without an index, all cells of the array."""
        array = _one(kind, message.register_id, self._schema.registers, "register")
        cells = self._switch.registers[array.name]
        if message.data.WhichOneof("data") != "bitstring":
            raise InvalidArgument(f"register {array.name} holds bit strings of {array.width} bits")
        value = bytestrings.decode(message.data.bitstring, array.width, f"register {array.name}")
        return _write_all(self._spent(message, array), cells.read, cells.write, value)

    def read_counters(self, message: Any) -> Iterator[Any]:
        """Entities for a CounterEntry filter; id 0 = all arrays, no index = all cells."""
        for array in _arrays(message.counter_id, self._schema.counters, "counter"):
            cells = self._switch.counters[array.name]
            for index in _indices(message, array):
                if index % PAGE == PAGE - 1:
                    yield None
                entity = p4runtime.Entity()
                entity.counter_entry.counter_id = array.id
                _write_index(index, entity.counter_entry)
                write_counter(cells.read(index), entity.counter_entry.data)
                yield entity

    def read_meters(self, message: Any) -> Iterator[Any]:
        """Entities for a MeterEntry filter."""
        for array in _arrays(message.meter_id, self._schema.meters, "meter"):
            cells = self._switch.meters[array.name]
            for index in _indices(message, array):
                if index % PAGE == PAGE - 1:
                    yield None
                entity = p4runtime.Entity()
                entity.meter_entry.meter_id = array.id
                _write_index(index, entity.meter_entry)
                config = cells.config(index)
                if config is not None:
                    write_meter_config(config, entity.meter_entry.config)
                yield entity

    def read_registers(self, message: Any) -> Iterator[Any]:
        """Entities for a RegisterEntry filter."""
        for array in _arrays(message.register_id, self._schema.registers, "register"):
            cells = self._switch.registers[array.name]
            for index in _indices(message, array):
                if index % PAGE == PAGE - 1:
                    yield None
                entity = p4runtime.Entity()
                entity.register_entry.register_id = array.id
                _write_index(index, entity.register_entry)
                entity.register_entry.data.bitstring = bytestrings.encode(cells.read(index))
                yield entity


def _one(kind: int, array_id: int, arrays: Mapping[int, BoundArray], what: str) -> BoundArray:
    if kind != MODIFY:
        raise InvalidArgument(f"a {what} can only be modified")
    array = arrays.get(array_id)
    if array is None:
        raise InvalidArgument(f"{what} id {array_id} is not in the p4info")
    return array


def _arrays(array_id: int, arrays: Mapping[int, BoundArray], what: str) -> list[BoundArray]:
    return [_one(MODIFY, array_id, arrays, what)] if array_id else list(arrays.values())


def _indices(message: Any, array: BoundArray) -> range:
    if not message.HasField("index"):
        return range(array.size)
    index = message.index.index
    if index < 0:
        raise InvalidArgument(f"{array.name}: index {index} is negative")
    if index >= array.size:
        raise OutOfRange(f"{array.name}: index {index} is not within 0..{array.size - 1}")
    return range(index, index + 1)


def _write_index(index: int, message: Any) -> None:
    message.index.SetInParent()
    message.index.index = index


def _write_all(indices: range, read: Callable[[int], V], write: Callable[[int, V], None], value: V) -> Undo:
    old = [read(index) for index in indices]
    for index in indices:
        write(index, value)

    def undo() -> None:
        for index, before in zip(indices, old, strict=True):
            write(index, before)

    return undo


def _nothing() -> None:
    return
