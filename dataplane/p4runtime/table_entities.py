"""TableEntry, DirectCounterEntry and DirectMeterEntry: writes and reads on the switch's tables.

Each `write_…` returns how to undo what it did, for batches that roll back.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from dataplane.p4runtime.meters import meter_config, write_meter_config
from dataplane.p4runtime.schema import Schema
from dataplane.p4runtime.status import Denied, InvalidArgument, MissingEntity, Unimplemented
from dataplane.p4runtime.table_codec import (
    PackedReader,
    TableCodec,
    pack_metadata,
    packed_reader,
    unpack_metadata,
)
from dataplane.p4runtime.update_forms import UpdateForms
from dataplane.v1model.externs import CounterValue, MeterConfig
from dataplane.v1model.switch import Switch
from dataplane.v1model.tables import Match, Table, TableEntry
from p4rt import p4runtime

INSERT, MODIFY, DELETE = p4runtime.Update.INSERT, p4runtime.Update.MODIFY, p4runtime.Update.DELETE
Undo = Callable[[], None]
PAGE = 512
"""Entities that are read at a time."""
_MOST = 2**63 - 1
_Direct = tuple[MeterConfig | None, CounterValue | None]


class TableEntities:
    """All tables of a pipeline, as the controller sees them.

    clock: the packets' clock in µs, for the age of entries
    """

    def __init__(self, schema: Schema, switch: Switch, clock: Callable[[], int]) -> None:
        self._switch = switch
        self._clock = clock
        self._meter_types = schema.direct_meter_types
        self.has_idle_timeouts = False
        self._parts: dict[int, tuple[TableCodec, Table]] = {
            table.id: (TableCodec(table), switch.tables[table.spec.name]) for table in schema.tables.values()
        }
        self._packed: dict[int, PackedReader] = {
            table_id: packed_reader(codec.table, table.key)
            for table_id, (codec, table) in self._parts.items()
        }
        self._default_metadata: dict[int, bytes] = {}
        """Of default actions that were set with some, by table id."""
        self._id_of = {codec.name: table_id for table_id, (codec, _) in self._parts.items()}
        self._forms = UpdateForms()

    def codec_of(self, table: Table) -> TableCodec:
        """The codec of a table of the switch."""
        return self._parts[self._id_of[table.name]][0]

    def _find(self, table_id: int) -> tuple[TableCodec, Table]:
        found = self._parts.get(table_id)
        if found is None:
            raise InvalidArgument(f"table id {table_id} is not in the p4info")
        return found

    # -- TableEntry -----------------------------------------------------------------------------------

    def write_update(self, update: Any) -> Undo | None:
        """An Update of the same form as an earlier one; None where it has to be read.

        Raises the table's own errors.
        """
        found = self._forms.find(update)
        if found is None:
            return None
        form, key = found
        table = form.table
        if form.content is None:
            return table.take(key)
        table.insert_packed(key, *form.content)
        return lambda: table.delete(key)

    def learn(self, update: Any, message: Any) -> None:
        """An Update of a table entry, `message`, has succeeded: more of its form may follow."""
        if self._forms.is_full:
            return
        codec, table = self._find(message.table_id)
        if update.type == MODIFY or not table.key.all_exact or not _is_plain(message):
            return
        if self._packed[codec.table.id](message.match) is not None:
            self._forms.learn(update, table, codec.content(message) if update.type == INSERT else None)

    def write_entry(self, kind: int, message: Any) -> Undo:
        """Insert, modify or delete an entry, or modify a default action.

        Raises InvalidArgument, Denied, Unimplemented and the table's own errors.
        """
        codec, table = self._find(message.table_id)
        if message.is_const:
            raise InvalidArgument(f"table {codec.name}: is_const must be false in a Write")
        if message.is_default_action:
            return self._write_default(kind, message, codec, table)
        # of a deletion only the key counts, so that an entry can be deleted as it was read
        has_direct = kind != DELETE and _check_written(codec, message)
        if table.spec.is_const and (kind != MODIFY or message.HasField("action")):
            raise Denied(
                f"table {codec.name} is constant; only its entries' counters and meters can be modified"
            )
        if kind == INSERT:
            return self._insert(message, codec, table, has_direct=has_direct)
        if kind == MODIFY:
            return self._modify(message, codec, table)
        packed = self._packed[codec.table.id](message.match)
        match = codec.match(message.match) if packed is None else packed
        return table.take(match, codec.priority(message))

    def _insert(self, message: Any, codec: TableCodec, table: Table, *, has_direct: bool) -> Undo:
        packed = None if has_direct else self._packed[codec.table.id](message.match)
        if packed is not None:
            return self._insert_packed(packed, message, codec, table)
        entry = codec.entry(message)
        if entry.idle_timeout_ns:
            self._begin_to_age()
        if has_direct:
            values = self._direct_values(message, codec)
            with self._switch.lock:
                table.insert(entry)
                self._write_direct(values, table, entry)
        else:
            table.insert(entry)
        return lambda: table.delete(entry.match, entry.priority)

    def _insert_packed(self, key: int, message: Any, codec: TableCodec, table: Table) -> Undo:
        """The same for the common case, without an object for the match and its fields."""
        name, params, idle_timeout_ns, metadata = codec.content(message)
        codec.priority(message)
        if idle_timeout_ns:
            self._begin_to_age()
        table.insert_packed(key, name, params, idle_timeout_ns, metadata)
        return lambda: table.delete(key)

    def _modify(self, message: Any, codec: TableCodec, table: Table) -> Undo:
        match, priority = codec.match(message.match), codec.priority(message)
        old = _snapshot(table, match, priority)
        if old is None:
            raise MissingEntity(f"table {codec.name} has no such entry")
        values = self._direct_values(message, codec)
        with self._switch.lock:
            entry = old[0]
            # without an action only counter and meter are modified, as the specification has it
            if message.HasField("action"):
                entry = codec.entry(message)
                if entry.idle_timeout_ns:
                    self._begin_to_age()
                table.modify(entry)
            self._write_direct(values, table, entry)

        def undo() -> None:
            if message.HasField("action"):
                table.modify(old[0])
            _restore_direct(table, old)

        return undo

    def _begin_to_age(self) -> None:
        """The switch's clock stands at its latest frame, which may be long ago."""
        self._switch.advance(self._clock())
        self.has_idle_timeouts = True

    def _direct_values(self, message: Any, codec: TableCodec) -> _Direct:
        """Checked before the entry is touched: an update is done whole or not at all."""
        meter, counter = None, None
        if message.HasField("meter_config"):
            meter = meter_config(message.meter_config, self._meter_types.get(codec.table.id, 0), codec.name)
        if message.HasField("counter_data"):
            counter = counter_value(message.counter_data, codec.name)
        return meter, counter

    @staticmethod
    def _write_direct(values: _Direct, table: Table, entry: TableEntry) -> None:
        meter, counter = values
        if table.spec.has_meter:
            table.set_meter(entry.match, entry.priority, meter)
        if counter is not None:
            table.set_counter(entry.match, entry.priority, counter)

    def _write_default(self, kind: int, message: Any, codec: TableCodec, table: Table) -> Undo:
        if kind != MODIFY:
            raise InvalidArgument(f"table {codec.name}: a default action can only be modified")
        if message.match or message.priority or message.idle_timeout_ns:
            raise InvalidArgument(
                f"table {codec.name}: a default action has no match, priority or idle time-out"
            )
        if message.HasField("meter_config") or message.HasField("counter_data"):
            raise Unimplemented(
                f"table {codec.name}: counters and meters of default actions cannot be written"
            )
        if codec.table.const_default:
            raise Denied(f"table {codec.name}: its default action is constant")
        old, old_metadata = table.default, self._default_metadata.get(codec.table.id, b"")
        metadata = pack_metadata(message.controller_metadata, message.metadata)
        if message.HasField("action"):
            table.set_default(*codec.action(message.action, default=True))
            self._default_metadata[codec.table.id] = metadata
        else:
            table.reset_default()
            self._default_metadata[codec.table.id] = b""

        def undo() -> None:
            if old is None:
                table.reset_default()
            else:
                table.set_default(*old)
            self._default_metadata[codec.table.id] = old_metadata

        return undo

    def read_entries(self, message: Any) -> Iterator[Any]:
        """Entities for a TableEntry filter; table id 0 = all tables."""
        for codec, table in self._selected(message):
            if message.is_default_action:
                yield from self._read_default(message, codec, table)
                continue
            for entry in self._filtered(message, codec, table):
                if entry is None:
                    yield None
                    continue
                entity = p4runtime.Entity()
                codec.write(entry, entity.table_entry)
                entity.table_entry.is_const = table.spec.is_const
                self._read_direct(message, entity.table_entry, table, entry)
                yield entity

    def _read_default(self, asked: Any, codec: TableCodec, table: Table) -> Iterator[Any]:
        default, metadata = table.default, self._default_metadata.get(codec.table.id, b"")
        if default is not None and _metadata_fits(asked, metadata):
            entity = p4runtime.Entity()
            entry = entity.table_entry
            entry.table_id = codec.table.id
            entry.is_default_action = True
            codec.write_action(*default, entry)
            entry.controller_metadata, entry.metadata = unpack_metadata(metadata)
            yield entity

    def entries_looked_at(self, entity: Any) -> int:
        """How many entries a Read of this filter goes through, at most."""
        name = entity.WhichOneof("entity")
        if name == "table_entry":
            asked = entity.table_entry
        elif name in ("direct_counter_entry", "direct_meter_entry"):
            asked = getattr(entity, name).table_entry
        else:
            return 1
        if asked.table_id:
            part = self._parts.get(asked.table_id)
            return 1 if part is None else 1 + len(part[1])
        return sum(1 + len(table) for _, table in self._parts.values())

    def _selected(self, message: Any) -> list[tuple[TableCodec, Table]]:
        if message.table_id:
            return [self._find(message.table_id)]
        if message.match or message.priority or message.HasField("action"):
            raise InvalidArgument(
                "a TableEntry filter without a table id can have no match, priority or action"
            )
        return list(self._parts.values())

    @staticmethod
    def _filtered(message: Any, codec: TableCodec, table: Table) -> Iterator[TableEntry | None]:
        """Entries that fit; None after each PAGE of those that were looked at."""
        action = message.action.action.action_id if message.HasField("action") else 0
        match = codec.match(message.match) if message.match else None
        parts: Iterable[list[TableEntry]] = table.entries_by(PAGE)
        if match is not None and (message.priority or not table.spec.needs_priority):
            found = table.get(match, message.priority)
            parts = [] if found is None else [[found]]
        for part in parts:
            for entry in part:
                fits = (
                    (match is None or entry.match == match)
                    and message.priority in (0, entry.priority)
                    and (not action or codec.action_id(entry.action) == action)
                    and _metadata_fits(message, entry.metadata)
                )
                if fits:
                    yield entry
            if len(part) == PAGE:
                yield None

    def _read_direct(self, asked: Any, message: Any, table: Table, entry: TableEntry) -> None:
        if asked.HasField("counter_data") and table.spec.has_counter:
            write_counter(table.counter(entry.match, entry.priority), message.counter_data)
        if asked.HasField("meter_config") and table.spec.has_meter:
            config = table.meter(entry.match, entry.priority)
            if config is not None:
                write_meter_config(config, message.meter_config)
        if asked.HasField("time_since_last_hit"):
            if table.spec.has_idle_timeout:
                idle = table.idle_ns(entry.match, entry.priority, self._clock())
                message.time_since_last_hit.elapsed_ns = idle
            elif asked.table_id:
                raise InvalidArgument(f"table {table.name} has no idle time-out")

    # -- direct counters and meters -------------------------------------------------------------------

    def write_counter(self, kind: int, message: Any) -> Undo:
        """Modify a DirectCounterEntry."""
        _, table, match, priority = self._direct(kind, message, "counter")
        old = table.counter(match, priority)
        if message.HasField("data"):
            table.set_counter(match, priority, counter_value(message.data, table.name))
        return lambda: table.set_counter(match, priority, old)

    def write_meter(self, kind: int, message: Any) -> Undo:
        """Modify a DirectMeterEntry; no config = always green."""
        codec, table, match, priority = self._direct(kind, message, "meter")
        if message.HasField("counter_data"):
            raise Unimplemented(f"table {codec.name}: this target does not count by meter colour")
        old = table.meter(match, priority)
        config = None
        if message.HasField("config"):
            config = meter_config(message.config, self._meter_types.get(codec.table.id, 0), codec.name)
        table.set_meter(match, priority, config)
        return lambda: table.set_meter(match, priority, old)

    def _direct(self, kind: int, message: Any, what: str) -> tuple[TableCodec, Table, Match, int]:
        if kind != MODIFY:
            raise InvalidArgument(f"a direct {what} can only be modified")
        codec, table = self._find(message.table_entry.table_id)
        if not (table.spec.has_counter if what == "counter" else table.spec.has_meter):
            raise InvalidArgument(f"table {codec.name} has no direct {what}")
        if message.table_entry.is_default_action:
            raise Unimplemented(f"table {codec.name}: the default action's {what} cannot be written")
        return codec, table, codec.match(message.table_entry.match), codec.priority(message.table_entry)

    def read_counters(self, message: Any) -> Iterator[Any]:
        """Entities for a DirectCounterEntry filter."""
        for codec, table, entry in self._direct_entries(message.table_entry, "counter"):
            if entry is None:
                yield None
                continue
            entity = p4runtime.Entity()
            codec.write_key(entry, entity.direct_counter_entry.table_entry)
            write_counter(table.counter(entry.match, entry.priority), entity.direct_counter_entry.data)
            yield entity

    def read_meters(self, message: Any) -> Iterator[Any]:
        """Entities for a DirectMeterEntry filter."""
        for codec, table, entry in self._direct_entries(message.table_entry, "meter"):
            if entry is None:
                yield None
                continue
            entity = p4runtime.Entity()
            codec.write_key(entry, entity.direct_meter_entry.table_entry)
            config = table.meter(entry.match, entry.priority)
            if config is not None:
                write_meter_config(config, entity.direct_meter_entry.config)
            yield entity

    def _direct_entries(self, asked: Any, what: str) -> Iterator[tuple[TableCodec, Table, TableEntry | None]]:
        for codec, table in self._selected(asked):
            if not (table.spec.has_counter if what == "counter" else table.spec.has_meter):
                if asked.table_id:
                    raise InvalidArgument(f"table {codec.name} has no direct {what}")
                continue
            count = 0
            for entry in self._filtered(asked, codec, table):
                count += entry is not None
                yield codec, table, entry
            if asked.match and not count:
                raise MissingEntity(f"table {codec.name} has no such entry")


_Snapshot = tuple[TableEntry, CounterValue | None, MeterConfig | None]


def _snapshot(table: Table, match: Match, priority: int) -> _Snapshot | None:
    entry = table.get(match, priority)
    if entry is None:
        return None
    counter = table.counter(match, priority) if table.spec.has_counter else None
    meter = table.meter(match, priority) if table.spec.has_meter else None
    return entry, counter, meter


def _restore_direct(table: Table, old: _Snapshot) -> None:
    entry, counter, meter = old
    if counter is not None:
        table.set_counter(entry.match, entry.priority, counter)
    if table.spec.has_meter:
        table.set_meter(entry.match, entry.priority, meter)


def _check_written(codec: TableCodec, message: Any) -> bool:
    """Whether a counter or meter is written with the entry."""
    has_meter, has_counter = message.HasField("meter_config"), message.HasField("counter_data")
    if message.HasField("time_since_last_hit"):
        raise InvalidArgument(f"table {codec.name}: time_since_last_hit cannot be written")
    if has_meter and not codec.table.spec.has_meter:
        raise InvalidArgument(f"table {codec.name} has no direct meter")
    if has_counter and not codec.table.spec.has_counter:
        raise InvalidArgument(f"table {codec.name} has no direct counter")
    if message.HasField("meter_counter_data"):
        raise Unimplemented(f"table {codec.name}: this target does not count by meter colour")
    return bool(has_meter or has_counter)


def _is_plain(message: Any) -> bool:
    """Whether an entry has nothing but its key, action and metadata."""
    return not (
        message.is_default_action
        or message.idle_timeout_ns
        or message.HasField("meter_config")
        or message.HasField("counter_data")
        or message.HasField("meter_counter_data")
        or message.HasField("time_since_last_hit")
    )


def _metadata_fits(asked: Any, kept: bytes) -> bool:
    if not asked.controller_metadata and not asked.metadata:
        return True
    cookie, metadata = unpack_metadata(kept)
    return asked.controller_metadata in (0, cookie) and asked.metadata in (b"", metadata)


def counter_value(message: Any, what: str) -> CounterValue:
    """A CounterData message.  Raises InvalidArgument for negative counts."""
    if message.packet_count < 0 or message.byte_count < 0:
        raise InvalidArgument(f"counter of {what}: counts cannot be negative")
    return CounterValue(message.packet_count, message.byte_count)


def write_counter(value: CounterValue, message: Any) -> None:
    """A counter's value into a CounterData message (which is then set even when zero).

    The switch counts in 64 bits without sign, CounterData has one: what it has no room for reads as its largest.
    """
    message.SetInParent()
    message.packet_count, message.byte_count = min(value.packets, _MOST), min(value.bytes, _MOST)
