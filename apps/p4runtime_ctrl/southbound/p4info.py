"""A P4 program by names: tables, actions and headers of a p4info, and entries built and shown with them.

P4Runtime's numbers and byte strings are used here and in `values` only; other modules use names such as
`ingress.block_src`.  An entry that does not fit the program is refused here, with the names in the message,
because a switch may accept it and fail later.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, TypeVar

from google.protobuf import text_format

from apps.messages import TableUpdate
from apps.p4runtime_ctrl.errors import EntryError, P4InfoError
from apps.p4runtime_ctrl.southbound import values
from p4rt import p4info, p4runtime

EXACT: Final = p4info.MatchField.EXACT
LPM: Final = p4info.MatchField.LPM
TERNARY: Final = p4info.MatchField.TERNARY
RANGE: Final = p4info.MatchField.RANGE
OPTIONAL: Final = p4info.MatchField.OPTIONAL
_PRIORITISED = (TERNARY, RANGE, OPTIONAL)


_Named = TypeVar("_Named", "FieldInfo", "ActionInfo", "TableInfo")


@dataclass(frozen=True)
class FieldInfo:
    """A match field of a table, or a parameter of an action (then `kind` is 0)."""

    id: int
    name: str
    width: int
    kind: int = 0


@dataclass(frozen=True)
class ActionInfo:
    id: int
    name: str
    params: tuple[FieldInfo, ...]


@dataclass(frozen=True)
class TableInfo:
    id: int
    name: str
    fields: tuple[FieldInfo, ...]
    actions: tuple[ActionInfo, ...]
    """Actions that entries may use; default-only actions are in `default_actions`."""
    default_actions: tuple[ActionInfo, ...]
    constant_default: bool
    idle_timeout: bool
    counted: bool
    """It has a direct counter."""
    size: int

    @cached_property
    def has_priority(self) -> bool:
        return any(match.kind in _PRIORITISED for match in self.fields)


class ProgramInfo:
    """A p4info, by names.

    Tables, actions, fields and parameters are found by their full name or by its last part, where
    that is unique.
    """

    def __init__(self, message: Any) -> None:
        self.message = message
        self.actions = {action.preamble.id: _action(action) for action in message.actions}
        counted = {counter.direct_table_id for counter in message.direct_counters}
        self.tables = {
            table.preamble.id: _table(table, self.actions, table.preamble.id in counted)
            for table in message.tables
        }
        self.headers = {
            header.preamble.name: tuple(
                FieldInfo(meta.id, meta.name, meta.bitwidth) for meta in header.metadata
            )
            for header in message.controller_packet_metadata
        }
        self._meters = {meter.preamble.name: meter.preamble.id for meter in message.meters}
        self.names = frozenset(table.name for table in self.tables.values())
        self._tables_by_name = _index(self.tables.values(), "table")

    @classmethod
    def from_text(cls, text: str) -> "ProgramInfo":
        """Read a p4info in protobuf text format; raises `P4InfoError` for any other text."""
        try:
            return cls(text_format.Parse(text, p4info.P4Info()))
        except (text_format.ParseError, ValueError) as error:
            # ValueError: a number that its field cannot hold
            raise P4InfoError(f"not a p4info in text format: {error}") from error
        except KeyError as error:
            raise P4InfoError(
                f"an incomplete p4info: a table has action {error}, which is not there"
            ) from error

    def table(self, name: str) -> TableInfo:
        """Raises `EntryError` with the existing names."""
        found = self._tables_by_name.get(name)
        if found is None:
            raise EntryError(f"no table {name!r} in the program; it has {_names(self.tables.values())}")
        return found

    def meter(self, name: str) -> int:
        """Number of an indirect meter; raises `EntryError` if the program has none of that name."""
        if name not in self._meters:
            raise EntryError(f"no meter {name!r} in the program; it has {', '.join(self._meters) or 'none'}")
        return int(self._meters[name])

    def header(self, name: str, needed: Iterable[str]) -> dict[str, FieldInfo]:
        """Fields of a controller header by name; raises `P4InfoError` if one of `needed` is missing."""
        fields = {meta.name: meta for meta in self.headers.get(name, ())}
        missing = [wanted for wanted in needed if wanted not in fields]
        if missing:
            raise P4InfoError(
                f"header {name!r} of the program lacks {', '.join(missing)}; load the program of SDNator"
            )
        return fields

    def digest(self, struct: str) -> list[tuple[str, int]]:
        """Members of a digest by name and width; raises `P4InfoError` if the program has no such digest."""
        if struct not in self.message.type_info.structs:
            raise P4InfoError(f"the program has no digest {struct!r}; load the program of SDNator")
        members = self.message.type_info.structs[struct].members
        return [(member.name, member.type_spec.bitstring.bit.bitwidth) for member in members]

    def digest_id(self, struct: str) -> int:
        """Number of a digest, 0 if the program has none of that name."""
        return next((int(one.preamble.id) for one in self.message.digests if one.preamble.name == struct), 0)

    def entry(self, update: TableUpdate) -> Any:
        """The P4Runtime `TableEntry` that an update means.

        An update without match of a table with keys, kind `modify`, means the default action.
        Raises `EntryError` that names table, field and rule.
        """
        table = self.table(update.table)
        entry = p4runtime.TableEntry(table_id=table.id)
        if update.kind == "modify" and not update.match and not (table.fields and update.priority):
            self._set_default(entry, table, update)
            return entry
        _set_match(entry, table, update.match)
        _set_priority(entry, table, update.priority)
        if update.kind != "delete":
            _set_action(entry, table, table.actions, update)
            _set_idle_timeout(entry, table, update.idle_timeout_ns)
        return entry

    def _set_default(self, entry: Any, table: TableInfo, update: TableUpdate) -> None:
        if table.constant_default:
            raise EntryError(f"{table.name}: its default action is constant; give a match")
        entry.is_default_action = True
        _set_action(entry, table, table.default_actions, update)

    def describe(self, entry: Any) -> str:
        """An entry as text: `ingress.block_mac[ingress_port=1,eth_src=..]`."""
        if isinstance(entry, p4runtime.MeterEntry):
            names = {number: name for name, number in self._meters.items()}
            return f"{names.get(entry.meter_id, hex(entry.meter_id))}[{entry.index.index}]"
        table = self.tables.get(entry.table_id)
        if table is None:
            return f"table {entry.table_id:#x}"
        if entry.is_default_action:
            return f"{table.name}[default]"
        by_id = {match.id: match for match in table.fields}
        shown = ",".join(_shown_match(match, by_id.get(match.field_id)) for match in entry.match)
        return f"{table.name}[{shown}]" + (f"@{entry.priority}" if entry.priority else "")


def _action(message: Any) -> ActionInfo:
    params = tuple(FieldInfo(param.id, param.name, param.bitwidth) for param in message.params)
    return ActionInfo(message.preamble.id, message.preamble.name, params)


def _table(message: Any, actions: Mapping[int, ActionInfo], counted: bool) -> TableInfo:
    only_default = p4info.ActionRef.DEFAULT_ONLY
    only_entries = p4info.ActionRef.TABLE_ONLY
    return TableInfo(
        id=message.preamble.id,
        name=message.preamble.name,
        fields=tuple(
            FieldInfo(match.id, match.name, match.bitwidth, match.match_type)
            for match in message.match_fields
        ),
        actions=tuple(actions[ref.id] for ref in message.action_refs if ref.scope != only_default),
        default_actions=tuple(actions[ref.id] for ref in message.action_refs if ref.scope != only_entries),
        constant_default=message.const_default_action_id != 0,
        idle_timeout=message.idle_timeout_behavior != p4info.Table.NO_TIMEOUT,
        counted=counted,
        size=message.size,
    )


def _index(named: Iterable[_Named], what: str) -> dict[str, _Named]:
    """By full name and by every unique tail of it (`ingress.block`, `block`)."""
    full: dict[str, _Named] = {}
    tails: dict[str, list[_Named]] = {}
    for thing in named:
        if thing.name in full:
            raise P4InfoError(f"two objects are called {what} {thing.name!r}")
        full[thing.name] = thing
        parts = thing.name.split(".")
        for start in range(1, len(parts)):
            tails.setdefault(".".join(parts[start:]), []).append(thing)
    unique = {tail: things[0] for tail, things in tails.items() if len(things) == 1}
    return unique | full


def _names(named: Iterable[FieldInfo | ActionInfo | TableInfo]) -> str:
    return ", ".join(thing.name for thing in named) or "none"


def _set_match(entry: Any, table: TableInfo, match: Mapping[str, Any]) -> None:
    fields = _index(table.fields, f"match field of {table.name}")
    given: dict[int, Any] = {}
    for name, value in match.items():
        if name not in fields:
            raise EntryError(f"{table.name}: no match field {name!r}; it has {_names(table.fields)}")
        given[fields[name].id] = value
    for match_field in table.fields:
        where = f"{table.name} {match_field.name}"
        if match_field.id in given:
            _add_match(entry, match_field, given[match_field.id], where)
        elif match_field.kind == EXACT:
            raise EntryError(f"{where}: an exact match field needs a value")


def _add_match(entry: Any, match_field: FieldInfo, value: Any, where: str) -> None:
    """A condition that every value meets is left out, as P4Runtime requires."""
    width = match_field.width
    if match_field.kind in (EXACT, OPTIONAL):
        kind = "exact" if match_field.kind == EXACT else "optional"
        found = values.canonical(values.parse(value, width, where=where))
        entry.match.add(field_id=match_field.id, **{kind: {"value": found}})
    elif match_field.kind == LPM:
        first, length = values.parse_prefix(*values.prefix_pair(value, width), width, where=where)
        if length:
            prefix = {"value": values.canonical(first), "prefix_len": length}
            entry.match.add(field_id=match_field.id, lpm=prefix)
    elif match_field.kind == TERNARY:
        first, mask = values.parse_masked(*_pair(value, (1 << width) - 1, where), width, where=where)
        if mask:
            masked = {"value": values.canonical(first), "mask": values.canonical(mask)}
            entry.match.add(field_id=match_field.id, ternary=masked)
    elif match_field.kind == RANGE:
        _add_range(entry, match_field, value, where)
    else:
        raise EntryError(f"{where}: match kind {match_field.kind} is not supported")


def _add_range(entry: Any, match_field: FieldInfo, value: Any, where: str) -> None:
    first, second = _pair(value, value, where)
    low = values.parse(first, match_field.width, where=where)
    high = values.parse(second, match_field.width, where=where)
    if low > high:
        raise EntryError(f"{where}: the range {low}..{high} is empty; low comes first")
    if (low, high) != (0, (1 << match_field.width) - 1):
        bounds = {"low": values.canonical(low), "high": values.canonical(high)}
        entry.match.add(field_id=match_field.id, range=bounds)


def _pair(value: Any, default: Any, where: str) -> tuple[Any, Any]:
    """`[value, mask]` as it is, `10.0.0.0/8` cut in two, anything else with the default."""
    if isinstance(value, (list, tuple)):
        if len(value) != 2:
            raise EntryError(f"{where}: {value!r} is not a pair")
        return value[0], value[1]
    if isinstance(value, str) and "/" in value:
        first, _, second = value.partition("/")
        return first, second
    return value, default


def _set_priority(entry: Any, table: TableInfo, priority: int) -> None:
    if table.has_priority and priority < 1:
        raise EntryError(f"{table.name}: entries need a priority of at least 1 (higher wins)")
    if priority and not table.has_priority:
        raise EntryError(f"{table.name}: its entries have no priority; leave it 0")
    entry.priority = priority


def _set_action(entry: Any, table: TableInfo, allowed: tuple[ActionInfo, ...], update: TableUpdate) -> None:
    action = _index(allowed, f"action of {table.name}").get(update.action)
    if action is None:
        raise EntryError(f"{table.name}: no action {update.action!r} for this; allowed are {_names(allowed)}")
    params = _index(action.params, f"parameter of {action.name}")
    unknown = [name for name in update.params if name not in params]
    if unknown:
        raise EntryError(f"{action.name}: no parameter {unknown[0]!r}; it takes {_names(action.params)}")
    given = {params[name].id: value for name, value in update.params.items()}
    entry.action.action.action_id = action.id
    for param in action.params:
        where = f"{table.name} {action.name} {param.name}"
        if param.id not in given:
            raise EntryError(f"{where}: the parameter needs a value")
        value = values.canonical(values.parse(given[param.id], param.width, where=where))
        entry.action.action.params.add(param_id=param.id, value=value)


def _set_idle_timeout(entry: Any, table: TableInfo, timeout_ns: int) -> None:
    if timeout_ns and not table.idle_timeout:
        raise EntryError(f"{table.name}: it has no idle time-out; leave it 0")
    entry.idle_timeout_ns = timeout_ns


def _shown_match(match: Any, match_field: FieldInfo | None) -> str:
    if match_field is None:
        return f"field {match.field_id}"
    kind = match.WhichOneof("field_match_type")
    condition = getattr(match, kind)
    width = match_field.width

    def text(data: bytes) -> str:
        return values.shown(values.number(data), width)

    if kind == "lpm":
        first, length = values.number(condition.value), condition.prefix_len
        if width == values.ADDRESS_BITS and first >> 32 == 0 and length >= 96:
            length -= 96
        shown = f"{values.shown(first, width)}/{length}"
    elif kind == "ternary":
        full = values.number(condition.mask) == (1 << width) - 1
        shown = text(condition.value) + ("" if full else f"&{hex(values.number(condition.mask))}")
    elif kind == "range":
        shown = f"{text(condition.low)}..{text(condition.high)}"
    else:
        shown = text(condition.value)
    return f"{match_field.name}={shown}"
