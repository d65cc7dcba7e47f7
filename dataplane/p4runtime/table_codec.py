"""p4.v1.TableEntry ↔ TableEntry of the switch, one codec per table, made when the pipeline is set."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from dataplane.p4runtime import bytestrings
from dataplane.p4runtime.schema import BoundAction, BoundTable
from dataplane.p4runtime.status import Denied, InvalidArgument, Refused
from dataplane.v1model.keys import Exact, Lpm, Match, MatchValue, Optional, Range, TableKey, Ternary
from dataplane.v1model.tables import TableEntry
from dataplane.v1model.tree import KeySpec, MatchKind

Reader = Callable[[Any], MatchValue]
Writer = Callable[[Any, Any], None]
""" (match value, the message's repeated field `match`): adds the field unless it matches anything. """
PackedReader = Callable[[Any], int | None]
""" The repeated field `match` as a packed key (keys.py); None where TableCodec.match must look at it. """
MAX_METADATA = 4096
"""Bytes of an entry's `metadata`."""
_COOKIE_BYTES = 8


class TableCodec:
    """Reads and writes the entries of one table as P4Runtime messages."""

    def __init__(self, table: BoundTable) -> None:
        self.table = table
        self.name = table.spec.name
        self._needs_priority = table.spec.needs_priority
        self._by_action_id = {action.id: action for action in table.actions}
        self._by_action_name = {action.spec.name: action for action in table.actions}
        keys = list(zip(table.field_ids, table.kinds, table.spec.keys, strict=True))
        self._fields: dict[int, tuple[int, str, Reader]] = {
            field_id: (position, kind.value, _READERS[kind](key, f"table {self.name}, {key.name}"))
            for position, (field_id, kind, key) in enumerate(keys)
        }
        self._wildcards: list[MatchValue | None] = [_wildcard(key) for _, _, key in keys]
        self._required = sum(1 << n for n, value in enumerate(self._wildcards) if value is None)
        self._writers = [_WRITERS[kind](key, field_id) for field_id, kind, key in keys]

    # -- from the controller ------------------------------------------------------------------------

    def match(self, fields: Iterable[Any]) -> Match:
        """The match of a TableEntry message; fields left out match anything.

        Raises InvalidArgument: unknown or repeated field, an exact field left out, a kind that is not
        the table's, or a value that is not canonical (bits outside its mask, a wildcard written out).
        """
        values = self._wildcards.copy()
        seen = 0
        for field in fields:
            found = self._fields.get(field.field_id)
            if found is None:
                raise InvalidArgument(f"table {self.name} has no match field {field.field_id}")
            position, kind, reader = found
            if seen >> position & 1:
                raise InvalidArgument(f"table {self.name}: match field {field.field_id} is given twice")
            seen |= 1 << position
            if field.WhichOneof("field_match_type") != kind:
                raise InvalidArgument(f"table {self.name}: match field {field.field_id} must be {kind}")
            values[position] = reader(getattr(field, kind))
        if self._required & ~seen:
            key = self.table.spec.keys[values.index(None)]
            raise InvalidArgument(f"table {self.name}: exact match field {key.name} is missing")
        return tuple(values)  # type: ignore[arg-type]

    def priority(self, message: Any) -> int:
        """The entry's priority, checked against the table's key.  Raises InvalidArgument."""
        priority: int = message.priority
        if self._needs_priority:
            if priority <= 0:
                raise InvalidArgument(f"table {self.name}: priority must be 1 or more, it is {priority}")
        elif priority:
            raise InvalidArgument(
                f"table {self.name}: priority must be 0, no field is ternary, range or optional"
            )
        return priority

    def action(self, message: Any, *, default: bool = False) -> tuple[str, tuple[int, ...]]:
        """Name and parameters of a TableAction.  Raises InvalidArgument, or Denied out of its scope."""
        given = message.action
        found = self._by_action_id.get(given.action_id)
        if found is None:
            kind = message.WhichOneof("type")
            if kind != "action":
                raise InvalidArgument(f"table {self.name} needs an action, not {kind or 'nothing'}")
            raise InvalidArgument(f"table {self.name} has no action {given.action_id}")
        if not (found.as_default if default else found.in_entries):
            place = "as default" if default else "in entries"
            raise Denied(f"table {self.name}: action {found.spec.name} is not allowed {place}")
        return found.spec.name, self._params(found, given.params)

    def _params(self, action: BoundAction, given: Any) -> tuple[int, ...]:
        if not action.param_ids and not given:
            return ()
        values = {param.param_id: param.value for param in given}
        if len(values) != len(given) or values.keys() != set(action.param_ids):
            raise InvalidArgument(
                f"action {action.spec.name} takes the parameters {list(action.param_ids)} once each, "
                f"given are {[param.param_id for param in given]}"
            )
        try:
            return tuple(
                bytestrings.decode(values[param_id], spec.width, spec.name)
                for param_id, spec in zip(action.param_ids, action.spec.params, strict=True)
            )
        except Refused as error:
            raise InvalidArgument(f"action {action.spec.name}, parameter {error}") from error

    def entry(self, message: Any) -> TableEntry:
        """A whole TableEntry message.  Raises InvalidArgument, Denied."""
        name, params, idle_timeout_ns, metadata = self.content(message)
        match, priority = self.match(message.match), self.priority(message)
        return TableEntry(match, name, params, priority, idle_timeout_ns, metadata)

    def content(self, message: Any) -> tuple[str, tuple[int, ...], int, bytes]:
        """Action, parameters, idle time-out and metadata of an entry.  Raises InvalidArgument, Denied."""
        idle_timeout_ns = message.idle_timeout_ns
        if idle_timeout_ns:
            self._check_idle_timeout(idle_timeout_ns)
        name, params = self.action(message.action)
        return name, params, idle_timeout_ns, pack_metadata(message.controller_metadata, message.metadata)

    def _check_idle_timeout(self, idle_timeout_ns: int) -> None:
        if not self.table.spec.has_idle_timeout:
            raise InvalidArgument(f"table {self.name} has no idle time-out")
        if idle_timeout_ns < 0:
            raise InvalidArgument(f"table {self.name}: idle time-out {idle_timeout_ns} ns is negative")

    # -- to the controller --------------------------------------------------------------------------

    def write_key(self, entry: TableEntry, message: Any) -> None:
        """Table id, match, priority and metadata into a TableEntry message."""
        message.table_id = self.table.id
        message.priority = entry.priority
        for value, write in zip(entry.match, self._writers, strict=True):
            write(value, message.match)
        message.controller_metadata, message.metadata = unpack_metadata(entry.metadata)
        message.idle_timeout_ns = entry.idle_timeout_ns

    def write_action(self, name: str, params: Iterable[int], message: Any) -> None:
        """An action with its parameters into a TableEntry message."""
        action = self._by_action_name[name]
        message.action.action.action_id = action.id
        for param_id, value in zip(action.param_ids, params, strict=True):
            message.action.action.params.add(param_id=param_id, value=bytestrings.encode(value))

    def write(self, entry: TableEntry, message: Any) -> None:
        """A whole entry into a TableEntry message."""
        self.write_key(entry, message)
        self.write_action(entry.action, entry.params, message)

    def action_id(self, name: str) -> int:
        """The id of one of the table's actions."""
        return self._by_action_name[name].id


def packed_reader(bound: BoundTable, key: TableKey) -> PackedReader:
    """The short way for keys whose fields are all exact and come in their order, as bulk writers send them."""
    if not key.all_exact:
        return _never
    places = tuple(
        (field_id, spec.width, shift)
        for field_id, (spec, shift) in zip(bound.field_ids, key.fields, strict=True)
    )
    count = len(places)
    number = int.from_bytes

    def read(fields: Any) -> int | None:
        if len(fields) != count:
            return None
        packed = 0
        for field, (field_id, width, shift) in zip(fields, places, strict=True):
            data = field.exact.value
            value = number(data, "big")
            if not data or value >> width or field.field_id != field_id:
                return None
            packed |= value << shift
        return packed

    return read


def _never(_: Any) -> None:
    return None


def pack_metadata(controller_metadata: int, metadata: bytes) -> bytes:
    """The controller's two opaque fields in the one that the switch keeps."""
    if len(metadata) > MAX_METADATA:
        raise InvalidArgument(f"metadata of {len(metadata)} bytes; at most {MAX_METADATA} are kept")
    if not controller_metadata and not metadata:
        return b""
    return bytes(controller_metadata.to_bytes(_COOKIE_BYTES, "big") + metadata)


def unpack_metadata(data: bytes) -> tuple[int, bytes]:
    """`controller_metadata` and `metadata` again."""
    return int.from_bytes(data[:_COOKIE_BYTES], "big"), data[_COOKIE_BYTES:]


def _wildcard(key: KeySpec) -> MatchValue | None:
    match key.kind:
        case MatchKind.TERNARY:
            return Ternary(0, 0)
        case MatchKind.LPM:
            return Lpm(0, 0)
        case MatchKind.RANGE:
            return Range(0, (1 << key.width) - 1)
        case MatchKind.OPTIONAL:
            return Optional(None)
        case _:
            return None


def _number(data: bytes, width: int, what: str) -> int:
    # the specification asks for INVALID_ARGUMENT in match fields, OUT_OF_RANGE elsewhere
    try:
        return bytestrings.decode(data, width, what)
    except Refused as error:
        raise InvalidArgument(str(error)) from error


def _read_exact(key: KeySpec, what: str) -> Reader:
    width = key.width

    def read(field: Any) -> MatchValue:
        data = field.value
        value = int.from_bytes(data, "big")
        if value >> width or not data:
            _number(data, width, what)
        return Exact(value)

    return read


def _read_optional(key: KeySpec, what: str) -> Reader:
    width = key.width
    if key.kind is MatchKind.TERNARY:
        mask = (1 << width) - 1
        return lambda field: Ternary(_number(field.value, width, what), mask)
    return lambda field: Optional(_number(field.value, width, what))


def _read_ternary(key: KeySpec, what: str) -> Reader:
    width = key.width

    def read(field: Any) -> MatchValue:
        value, mask = _number(field.value, width, what), _number(field.mask, width, f"{what} (mask)")
        if not mask:
            raise InvalidArgument(f"{what}: a mask of 0 matches anything; leave the field out")
        if value & ~mask:
            raise InvalidArgument(f"{what}: value {value:#x} has bits outside its mask {mask:#x}")
        return Ternary(value, mask)

    return read


def _read_lpm(key: KeySpec, what: str) -> Reader:
    width = key.width

    def read(field: Any) -> MatchValue:
        value, length = _number(field.value, width, what), field.prefix_len
        if not 0 < length <= width:
            raise InvalidArgument(
                f"{what}: prefix length {length} is not within 1..{width}; leave the field out for 0"
            )
        if value & ((1 << (width - length)) - 1):
            raise InvalidArgument(f"{what}: value {value:#x} has bits behind its prefix of {length}")
        return Lpm(value, length)

    return read


def _read_range(key: KeySpec, what: str) -> Reader:
    width = key.width

    def read(field: Any) -> MatchValue:
        low, high = _number(field.low, width, f"{what} (low)"), _number(field.high, width, f"{what} (high)")
        if low > high:
            raise InvalidArgument(f"{what}: low {low} is over high {high}")
        if low == 0 and high == (1 << width) - 1:
            raise InvalidArgument(f"{what}: the whole range matches anything; leave the field out")
        return Range(low, high)

    return read


_READERS: Mapping[MatchKind, Callable[[KeySpec, str], Reader]] = {
    MatchKind.EXACT: _read_exact,
    MatchKind.OPTIONAL: _read_optional,
    MatchKind.TERNARY: _read_ternary,
    MatchKind.LPM: _read_lpm,
    MatchKind.RANGE: _read_range,
}


def _write_exact(_key: KeySpec, field_id: int) -> Writer:
    def write(value: Any, match: Any) -> None:
        match.add(field_id=field_id).exact.value = bytestrings.encode(value.value)

    return write


def _write_optional(key: KeySpec, field_id: int) -> Writer:
    ternary = key.kind is MatchKind.TERNARY

    def write(value: Any, match: Any) -> None:
        if value.mask if ternary else value.value is not None:
            match.add(field_id=field_id).optional.value = bytestrings.encode(value.value)

    return write


def _write_ternary(_key: KeySpec, field_id: int) -> Writer:
    def write(value: Any, match: Any) -> None:
        if value.mask:
            ternary = match.add(field_id=field_id).ternary
            ternary.value, ternary.mask = bytestrings.encode(value.value), bytestrings.encode(value.mask)

    return write


def _write_lpm(_key: KeySpec, field_id: int) -> Writer:
    def write(value: Any, match: Any) -> None:
        if value.prefix_len:
            lpm = match.add(field_id=field_id).lpm
            lpm.value, lpm.prefix_len = bytestrings.encode(value.value), value.prefix_len

    return write


def _write_range(key: KeySpec, field_id: int) -> Writer:
    whole = Range(0, (1 << key.width) - 1)

    def write(value: Any, match: Any) -> None:
        if value != whole:
            bounds = match.add(field_id=field_id).range
            bounds.low, bounds.high = bytestrings.encode(value.low), bytestrings.encode(value.high)

    return write


_WRITERS: Mapping[MatchKind, Callable[[KeySpec, int], Writer]] = {
    MatchKind.EXACT: _write_exact,
    MatchKind.OPTIONAL: _write_optional,
    MatchKind.TERNARY: _write_ternary,
    MatchKind.LPM: _write_lpm,
    MatchKind.RANGE: _write_range,
}
