"""The typed tree of a v1model program: what program.py makes of BMv2 JSON and the compilers walk.

    Program
    ├── headers, stacks        instances and their types (metadata are headers that are always valid)
    ├── parser                 states: operations, then a select
    ├── ingress, egress        graphs of table and condition nodes (acyclic)
    ├── actions                statements; conditions inside actions are `If`
    ├── checksums, deparser    what leaves
    └── tables, counters …     what the control plane sees

Expressions have unbounded integers, as in BMv2: a program masks where its types wrap.
"""

from dataclasses import dataclass, field
from enum import StrEnum

# -- data -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FieldType:
    """`offset` in bits from the start of its header; a varbit has width 0 and stands last."""

    name: str
    width: int
    offset: int
    signed: bool = False
    saturating: bool = False
    varbit: bool = False


@dataclass(frozen=True, slots=True)
class HeaderType:
    """`width`: bits of the fixed part; `max_bytes`: with the varbit at its longest, 0 = no varbit."""

    name: str
    fields: tuple[FieldType, ...]
    width: int
    max_bytes: int = 0

    def field(self, name: str) -> FieldType | None:
        return next((f for f in self.fields if f.name == name), None)


@dataclass(frozen=True, slots=True)
class Header:
    name: str
    type: HeaderType
    metadata: bool


@dataclass(frozen=True, slots=True)
class Stack:
    name: str
    headers: tuple[str, ...]


# -- expressions ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Const:
    value: int


@dataclass(frozen=True, slots=True)
class FieldRef:
    header: str
    field: FieldType


@dataclass(frozen=True, slots=True)
class Valid:
    """1 where the header is valid."""

    header: str


@dataclass(frozen=True, slots=True)
class StackLast:
    """A field of the header extracted last into a stack."""

    stack: str
    field: FieldType


@dataclass(frozen=True, slots=True)
class StackCount:
    """Number of headers in a stack plus `offset` (-1: index of the last one)."""

    stack: str
    offset: int


@dataclass(frozen=True, slots=True)
class Param:
    """Run-time argument of an action."""

    index: int
    width: int


@dataclass(frozen=True, slots=True)
class Lookahead:
    """Bits ahead of the parser's cursor."""

    offset: int
    width: int


@dataclass(frozen=True, slots=True)
class Unary:
    """op: ~ not d2b b2d"""

    op: str
    operand: "Expression"


@dataclass(frozen=True, slots=True)
class Binary:
    """op: + - * / % & | ^ << >> == != < <= > >= and or two_comp_mod usat_cast sat_cast"""

    op: str
    left: "Expression"
    right: "Expression"


@dataclass(frozen=True, slots=True)
class Conditional:
    condition: "Expression"
    yes: "Expression"
    no: "Expression"


Expression = (
    Const | FieldRef | Valid | StackLast | StackCount | Param | Lookahead | Unary | Binary | Conditional
)

# -- statements -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Assign:
    target: FieldRef
    value: Expression


@dataclass(frozen=True, slots=True)
class CopyHeader:
    target: str
    source: str


@dataclass(frozen=True, slots=True)
class AddHeader:
    header: str


@dataclass(frozen=True, slots=True)
class RemoveHeader:
    header: str


@dataclass(frozen=True, slots=True)
class ShiftStack:
    """`by` > 0: push_front, < 0: pop_front."""

    stack: str
    by: int


@dataclass(frozen=True, slots=True)
class MarkToDrop:
    pass


@dataclass(frozen=True, slots=True)
class Count:
    array: str
    index: Expression


@dataclass(frozen=True, slots=True)
class ExecuteMeter:
    array: str
    index: Expression
    target: FieldRef


@dataclass(frozen=True, slots=True)
class RegisterRead:
    target: FieldRef
    array: str
    index: Expression


@dataclass(frozen=True, slots=True)
class RegisterWrite:
    array: str
    index: Expression
    value: Expression


@dataclass(frozen=True, slots=True)
class Hash:
    """target = calculation % max(size, 1) + base"""

    target: FieldRef
    calculation: str
    base: Expression
    size: Expression


@dataclass(frozen=True, slots=True)
class Random:
    target: FieldRef
    low: Expression
    high: Expression


@dataclass(frozen=True, slots=True)
class Clone:
    """Whether it is I2E or E2E follows from the pipeline it stands in."""

    session: Expression
    field_list: int


@dataclass(frozen=True, slots=True)
class SendDigest:
    digest: int


@dataclass(frozen=True, slots=True)
class Resubmit:
    field_list: int


@dataclass(frozen=True, slots=True)
class Recirculate:
    field_list: int


@dataclass(frozen=True, slots=True)
class Truncate:
    length: Expression


@dataclass(frozen=True, slots=True)
class Exit:
    pass


@dataclass(frozen=True, slots=True)
class If:
    condition: Expression
    then: tuple["Statement", ...]
    otherwise: tuple["Statement", ...] = ()


Statement = (
    Assign
    | CopyHeader
    | AddHeader
    | RemoveHeader
    | ShiftStack
    | MarkToDrop
    | Count
    | ExecuteMeter
    | RegisterRead
    | RegisterWrite
    | Hash
    | Random
    | Clone
    | SendDigest
    | Resubmit
    | Recirculate
    | Truncate
    | Exit
    | If
)

# -- parser -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Extract:
    """Extract into a header, or into the next one of a stack (`stack`); `varbit_bits`: its length."""

    header: str
    stack: str = ""
    varbit_bits: Expression | None = None


@dataclass(frozen=True, slots=True)
class Advance:
    bits: Expression


@dataclass(frozen=True, slots=True)
class Verify:
    condition: Expression
    error: Expression


ParserOp = Extract | Advance | Verify | Statement


@dataclass(frozen=True, slots=True)
class Case:
    """One (value, mask) per key of the select; next None = the parser's end."""

    matches: tuple[tuple[int, int], ...]
    next: str | None


@dataclass(frozen=True, slots=True)
class ParserState:
    name: str
    ops: tuple[ParserOp, ...]
    keys: tuple[Expression, ...]
    key_widths: tuple[int, ...]
    cases: tuple[Case, ...]
    default: str | None


@dataclass(frozen=True, slots=True)
class Parser:
    start: str
    states: dict[str, ParserState]


# -- match-action -----------------------------------------------------------------------------------


class MatchKind(StrEnum):
    EXACT = "exact"
    LPM = "lpm"
    TERNARY = "ternary"
    RANGE = "range"
    OPTIONAL = "optional"


@dataclass(frozen=True, slots=True)
class KeySpec:
    """One key field of a table: `name` as p4info shows it, `width` in bits."""

    name: str
    kind: MatchKind
    width: int


@dataclass(frozen=True, slots=True)
class ParamSpec:
    name: str
    width: int


@dataclass(frozen=True, slots=True)
class ActionSpec:
    name: str
    params: tuple[ParamSpec, ...]


@dataclass(frozen=True, slots=True)
class Action:
    """`number` is the action's index in Program.actions."""

    number: int
    spec: ActionSpec
    body: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class ConstEntry:
    """An entry written in the program: per key (kind, value, second), where second is the mask, prefix
    length or upper bound; priority as P4Runtime counts it."""

    keys: tuple[tuple[MatchKind, int, int], ...]
    priority: int
    action: str
    params: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class TableSpec:
    """What the control plane needs to know of a table; `default` as the program sets it."""

    name: str
    keys: tuple[KeySpec, ...]
    actions: tuple[ActionSpec, ...]
    size: int
    has_counter: bool = False
    has_meter: bool = False
    has_idle_timeout: bool = False
    default_is_const: bool = False
    default: tuple[str, tuple[int, ...]] | None = None
    const_entries: tuple[ConstEntry, ...] = ()

    @property
    def is_const(self) -> bool:
        """Its entries are the program's and cannot be changed."""
        return bool(self.const_entries)

    @property
    def needs_priority(self) -> bool:
        return any(k.kind in (MatchKind.TERNARY, MatchKind.RANGE, MatchKind.OPTIONAL) for k in self.keys)


@dataclass(frozen=True, slots=True)
class TableNode:
    """next_by_action, or next_on_hit and next_on_miss where `by_hit`."""

    name: str
    keys: tuple[Expression, ...]
    key_masks: tuple[int, ...]
    actions: tuple[int, ...]
    next_by_action: dict[int, str | None]
    by_hit: bool
    next_on_hit: str | None
    next_on_miss: str | None
    meter: str = ""
    hidden_action: int | None = None
    """A table that only runs this action: no key, a constant default."""


@dataclass(frozen=True, slots=True)
class ConditionNode:
    name: str
    condition: Expression
    yes: str | None
    no: str | None


Node = TableNode | ConditionNode


@dataclass(frozen=True, slots=True)
class Pipeline:
    name: str
    start: str | None
    nodes: dict[str, Node]


# -- externs ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Calculation:
    """A hash or checksum over `inputs`: bit strings written one behind the other."""

    name: str
    algorithm: str
    inputs: tuple[tuple[Expression, int], ...]
    """(expression, width); a varbit field and the payload have width 0."""
    with_payload: bool = False


@dataclass(frozen=True, slots=True)
class Checksum:
    name: str
    target: FieldRef
    calculation: str
    condition: Expression | None
    verify: bool
    update: bool


@dataclass(frozen=True, slots=True)
class DigestSpec:
    name: str
    fields: tuple[Expression, ...]
    widths: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """A counter, meter or register array; `unit` is "packets", "bytes" or "both" where it applies.

    table: the table of a direct counter or meter; target: where a direct meter writes its colour.
    """

    name: str
    size: int
    width: int = 0
    unit: str = ""
    table: str = ""
    target: FieldRef | None = None


@dataclass(frozen=True, slots=True)
class Program:
    """A loaded program.  `tables` are those that the control plane may see."""

    name: str
    headers: dict[str, Header]
    stacks: dict[str, Stack]
    errors: dict[str, int]
    parser: Parser
    ingress: Pipeline
    egress: Pipeline
    actions: tuple[Action, ...]
    tables: dict[str, TableSpec]
    calculations: dict[str, Calculation]
    checksums: tuple[Checksum, ...]
    deparser: tuple[str, ...]
    field_lists: dict[int, tuple[FieldRef, ...]]
    digests: dict[int, DigestSpec]
    counters: dict[str, ArraySpec]
    meters: dict[str, ArraySpec]
    registers: dict[str, ArraySpec]
    aliases: dict[str, tuple[str, str]] = field(default_factory=dict)

    def standard(self, name: str) -> FieldRef | None:
        """A field of standard_metadata, or None where the program has no such field."""
        header = self.headers.get("standard_metadata")
        found = header.type.field(name) if header else None
        return FieldRef("standard_metadata", found) if found else None

    def direct_meter(self, table: str) -> ArraySpec | None:
        return next((m for m in self.meters.values() if m.table == table), None)
