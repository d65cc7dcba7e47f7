"""What the controller may name: p4info's ids, bound to the parts of the loaded program.

    p4info ─┐
            ├── bind() ──► Schema: id → table, action, counter, meter, register, digest, packet headers
    Program ┘      └──► InvalidArgument with every contradiction, where the two are not of one compilation

BMv2 takes a p4info that does not fit its JSON and fails later, write by write; here the pair is
checked once, so a stale file shows when the pipeline is set.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dataplane.p4runtime.status import InvalidArgument
from dataplane.v1model.tree import ActionSpec, ArraySpec, MatchKind, Program, TableSpec
from p4rt import p4info as info

_SHOWN = 8
_DEEPEST, _MOST_MEMBERS = 16, 4096
_MOST_METADATA, _WIDEST = 256, 512
_KINDS: dict[int, MatchKind] = {
    info.MatchField.EXACT: MatchKind.EXACT,
    info.MatchField.LPM: MatchKind.LPM,
    info.MatchField.TERNARY: MatchKind.TERNARY,
    info.MatchField.RANGE: MatchKind.RANGE,
    info.MatchField.OPTIONAL: MatchKind.OPTIONAL,
}


@dataclass(frozen=True, slots=True)
class BoundAction:
    """An action as one table has it; `param_ids` in the order of the program's parameters."""

    id: int
    spec: ActionSpec
    param_ids: tuple[int, ...]
    in_entries: bool
    as_default: bool


@dataclass(frozen=True, slots=True)
class BoundTable:
    """A table with the ids by which the controller names its parts.

    kinds: match kinds as the controller sees them; p4c makes "ternary" of "optional" in the program
    """

    id: int
    spec: TableSpec
    field_ids: tuple[int, ...]
    kinds: tuple[MatchKind, ...]
    actions: tuple[BoundAction, ...]
    const_default: bool


@dataclass(frozen=True, slots=True)
class BoundArray:
    """A counter, meter or register array; `width` in bits for registers, `meter_type` as in p4info."""

    id: int
    name: str
    size: int
    width: int = 0
    meter_type: int = 0


@dataclass(frozen=True, slots=True)
class BoundDigest:
    """A digest and the widths of its members, in bits."""

    id: int
    name: str
    widths: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MetadataField:
    """One field of the packet_in or packet_out header."""

    id: int
    name: str
    width: int


@dataclass(frozen=True, slots=True)
class Schema:
    """Everything by id; `packet_in` and `packet_out` are empty where the program has no such header."""

    tables: Mapping[int, BoundTable]
    counters: Mapping[int, BoundArray]
    meters: Mapping[int, BoundArray]
    registers: Mapping[int, BoundArray]
    digests: Mapping[int, BoundDigest]
    direct_meter_types: Mapping[int, int]
    packet_in: tuple[MetadataField, ...]
    packet_out: tuple[MetadataField, ...]

    def table_of(self, name: str) -> BoundTable:
        """The table with this name in the program; KeyError where p4info hides it."""
        return next(table for table in self.tables.values() if table.spec.name == name)


def bind(p4info: Any, program: Program) -> Schema:
    """Check that `p4info` describes `program`, and index it.

    Raises InvalidArgument, whose text lists the contradictions.
    """
    _once(p4info)
    faults: list[str] = []
    actions = {action.preamble.id: action for action in p4info.actions}
    tables = [_table(table, actions, program, faults) for table in p4info.tables]
    _missing("table", (t.preamble.name for t in p4info.tables), program.tables, faults)
    schema = Schema(
        tables={table.id: table for table in tables if table is not None},
        counters=_arrays("counter", p4info.counters, _indirect(program.counters), faults),
        meters=_arrays("meter", p4info.meters, _indirect(program.meters), faults),
        registers=_arrays("register", p4info.registers, program.registers, faults),
        digests=_digests(p4info, program, faults),
        direct_meter_types={meter.direct_table_id: meter.spec.type for meter in p4info.direct_meters},
        packet_in=_header("packet_in", p4info, program, faults),
        packet_out=_header("packet_out", p4info, program, faults),
    )
    if faults:
        more = f" and {len(faults) - _SHOWN} more" if len(faults) > _SHOWN else ""
        raise InvalidArgument(
            f"the p4info does not fit the program {program.name!r}: {'; '.join(faults[:_SHOWN])}{more}; "
            "send the p4info of the same compilation"
        )
    return schema


def _once(p4info: Any) -> None:
    """Ids say what is meant; one that stands there twice says nothing.  Raises InvalidArgument."""
    for part in ("tables", "actions", "counters", "meters", "registers", "digests"):
        ids = [item.preamble.id for item in getattr(p4info, part)]
        if len(set(ids)) != len(ids):
            raise InvalidArgument(f"the p4info has two {part} with the same id; send what p4c wrote")


def _indirect(arrays: Mapping[str, ArraySpec]) -> dict[str, ArraySpec]:
    return {name: spec for name, spec in arrays.items() if not spec.table}


def _missing(what: str, named: Iterable[str], have: Iterable[str], faults: list[str]) -> None:
    faults += [f"{what} {name} of the program is not in it" for name in sorted(set(have) - set(named))]


def _table(table: Any, actions: Mapping[int, Any], program: Program, faults: list[str]) -> BoundTable | None:
    name = table.preamble.name
    spec = program.tables.get(name)
    if spec is None:
        faults.append(f"table {name} is not in the program")
        return None
    fields = [(field.name, _KINDS.get(field.match_type), field.bitwidth) for field in table.match_fields]
    wanted = [(key.name, key.kind, key.width) for key in spec.keys]
    if [_as_compiled(field) for field in fields] != [_as_compiled(field) for field in wanted]:
        faults.append(f"table {name} has the key {_key_text(fields)}, the program {_key_text(wanted)}")
    if table.implementation_id:
        faults.append(f"table {name} uses an action profile, which this target does not have")
    if bool(table.idle_timeout_behavior) != spec.has_idle_timeout:
        faults.append(f"table {name} differs in its idle time-out")
    if table.size and table.size != spec.size and not spec.is_const:
        faults.append(f"table {name} has size {table.size}, the program {spec.size}")
    return BoundTable(
        id=table.preamble.id,
        spec=spec,
        field_ids=tuple(field.id for field in table.match_fields),
        kinds=tuple(kind for _, kind, _ in fields if kind is not None),
        actions=tuple(_actions(table, spec, actions, faults)),
        const_default=bool(table.const_default_action_id) or spec.default_is_const,
    )


def _as_compiled(field: tuple[str, MatchKind | None, int]) -> tuple[str, MatchKind | None, int]:
    name, kind, width = field
    return name, MatchKind.TERNARY if kind is MatchKind.OPTIONAL else kind, width


def _key_text(fields: Sequence[tuple[str, MatchKind | None, int]]) -> str:
    return "(" + ", ".join(f"{name} {kind} {width}" for name, kind, width in fields) + ")"


def _actions(table: Any, spec: TableSpec, actions: Mapping[int, Any], faults: list[str]) -> list[BoundAction]:
    have = {action.name: action for action in spec.actions}
    bound = []
    for ref in table.action_refs:
        action = actions.get(ref.id)
        name = "" if action is None else action.preamble.name
        if action is None or name not in have:
            faults.append(f"action {name or ref.id} of table {spec.name} is not in the program")
            continue
        params = [(param.name, param.bitwidth) for param in action.params]
        wanted = [(param.name, param.width) for param in have[name].params]
        if params != wanted:
            faults.append(f"action {name} has the parameters {params}, the program {wanted}")
        bound.append(
            BoundAction(
                id=ref.id,
                spec=have[name],
                param_ids=tuple(param.id for param in action.params),
                in_entries=ref.scope != info.ActionRef.DEFAULT_ONLY,
                as_default=ref.scope != info.ActionRef.TABLE_ONLY,
            )
        )
    return bound


def _arrays(
    what: str, arrays: Any, have: Mapping[str, ArraySpec], faults: list[str]
) -> dict[int, BoundArray]:
    bound = {}
    for array in arrays:
        name = array.preamble.name
        spec = have.get(name)
        if spec is None:
            faults.append(f"{what} {name} is not in the program")
            continue
        if array.size != spec.size:
            faults.append(f"{what} {name} has size {array.size}, the program {spec.size}")
        width, meter_type = 0, 0
        if what == "register":
            width = array.type_spec.bitstring.bit.bitwidth
            if width != spec.width:
                faults.append(f"register {name} has {width} bits, the program {spec.width}")
        elif what == "meter":
            meter_type = array.spec.type
        bound[array.preamble.id] = BoundArray(array.preamble.id, name, array.size, width, meter_type)
    _missing(what, (array.preamble.name for array in arrays), have, faults)
    return bound


def _digests(p4info: Any, program: Program, faults: list[str]) -> dict[int, BoundDigest]:
    bound = {}
    have = {spec.name: spec for spec in program.digests.values()}
    for digest in p4info.digests:
        name = digest.preamble.name
        spec = have.get(name)
        widths = tuple(_member_widths(digest.type_spec, p4info.type_info, name, faults))
        if spec is None:
            faults.append(f"digest {name} is not in the program")
        elif spec.widths != widths:
            faults.append(f"digest {name} has members of {widths} bits, the program {spec.widths}")
        bound[digest.preamble.id] = BoundDigest(digest.preamble.id, name, widths)
    return bound


def _member_widths(spec: Any, types: Any, digest: str, faults: list[str]) -> list[int]:
    widths: list[int] = []
    waiting = [(spec, 0)]
    while waiting:
        one, depth = waiting.pop()
        kind = one.WhichOneof("type_spec")
        if kind == "bitstring":
            bits = one.bitstring
            signed = bits.WhichOneof("type_spec") == "int"
            widths.append(bits.int.bitwidth if signed else bits.bit.bitwidth)
        elif depth > _DEEPEST or len(waiting) + len(widths) > _MOST_MEMBERS:
            faults.append(f"digest {digest} has members within members without end")
            return widths
        elif kind == "new_type":
            waiting.append((types.new_types[one.new_type.name].original_type, depth + 1))
        elif kind == "struct":
            members = types.structs[one.struct.name].members
            waiting += [(member.type_spec, depth + 1) for member in reversed(members)]
        else:
            faults.append(f"digest {digest} has a member of type {kind}, which this target cannot send")
    return widths


def _header(name: str, p4info: Any, program: Program, faults: list[str]) -> tuple[MetadataField, ...]:
    for header in p4info.controller_packet_metadata:
        if header.preamble.name != name:
            continue
        fields = tuple(MetadataField(field.id, field.name, field.bitwidth) for field in header.metadata)
        bits = sum(field.width for field in fields)
        if len(fields) > _MOST_METADATA or not all(0 < field.width <= _WIDEST for field in fields):
            raise InvalidArgument(
                f"header {name} of the p4info has more than {_MOST_METADATA} fields, or one that is not of"
                f" 1..{_WIDEST} bits"
            )
        if bits % 8:
            faults.append(f"header {name} has {bits} bits, which is not a whole number of bytes")
        have = program.headers.get(name)
        if have is not None and [field.width for field in fields] != [
            field.width for field in have.type.fields
        ]:
            faults.append(f"header {name} differs from the program's")
        return fields
    return ()
