"""Whether a tree that was read can be compiled: types, references, sizes.

    program.py ──► Program ── check ──► compilers

The compilers write numbers of the tree into their text, follow its names without asking, and walk it by
recursion.  So every number has to be one, every name has to be the name of something, and whatever may
double at each step is bounded here.
"""

from collections.abc import Callable, Container, Iterable
from dataclasses import fields
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from dataplane.compiler.layout import walk
from dataplane.errors import ProgramError, Unsupported
from dataplane.v1model import tree
from dataplane.v1model.bmv2_json import MAX_NAME
from dataplane.v1model.tree import Program

MAX_STATE_BYTES = 256 << 20
"""Registers, counters and meters of a program together."""
MAX_WEIGHT = 10_000
"""Operators of one expression as they are written out: a divisor, for one, stands there twice."""
MAX_HASHED_BITS = 1 << 17
MAX_HEADER_BYTES = 1 << 16
_METER_BYTES = 256
_PLAIN = (int, str, bool, type(None))
_TWICE = frozenset({"/", "%", "<<"})


def check(program: Program) -> None:
    """Raises ProgramError, or Unsupported where a limit is passed."""
    nodes = list(walk(program))
    for node in nodes:
        _check_types(node)
    for header in program.headers.values():
        for each in header.type.fields:
            _check_types(each)
    for node in nodes:
        _check_names(node, program)
    for state in program.parser.states.values():
        _check_state(state, program)
    for pipeline in (program.ingress, program.egress):
        _check_pipeline(pipeline, program)
    _check_ahead(program, nodes)
    _check_headers(program)
    _check_sizes(program)
    _check_weights(nodes)


# -- types ------------------------------------------------------------------------------------------


_Fields = tuple[tuple[str, tuple[type, ...]], ...]
_KNOWN_FIELDS: dict[type, _Fields] = {}


def _plain_fields(kind: Any) -> _Fields:
    """Fields of a class of the tree that hold numbers and texts, and which of these."""
    hints = get_type_hints(kind, vars(tree))
    found = []
    for one in fields(kind):
        hint = hints[one.name]
        allowed = get_args(hint) if isinstance(hint, UnionType) else (hint,)
        if all(each in _PLAIN for each in allowed):
            found.append((one.name, tuple(allowed)))
        elif get_origin(hint) is tuple and get_args(hint)[0] in _PLAIN:
            found.append((one.name, (tuple, get_args(hint)[0])))
    return tuple(found)


def _check_types(node: Any) -> None:
    kind = type(node)
    if kind not in _KNOWN_FIELDS:
        _KNOWN_FIELDS[kind] = _plain_fields(kind)
    for name, allowed in _KNOWN_FIELDS[kind]:
        value = getattr(node, name)
        values = value if allowed[0] is tuple else (value,)
        for each in values:
            if type(each) not in allowed or (isinstance(each, str) and len(each) > MAX_NAME):
                raise ProgramError(f"malformed BMv2 JSON: {name} of a {type(node).__name__} is {each!r:.60}")


# -- names ------------------------------------------------------------------------------------------


def _known(name: object, among: Container[object], what: str) -> None:
    if not isinstance(name, int | str) or name not in among:
        raise ProgramError(f"malformed BMv2 JSON: there is no {what} {name!r:.60}")


def _packet_header(name: str, program: Program) -> None:
    if name not in program.headers or program.headers[name].metadata:
        raise ProgramError(f"malformed BMv2 JSON: there is no header {name!r:.60} that can be valid or not")


def _check_copy(node: tree.CopyHeader, program: Program) -> None:
    _packet_header(node.target, program)
    _packet_header(node.source, program)
    if program.headers[node.target].type != program.headers[node.source].type:
        raise ProgramError(f"malformed BMv2 JSON: {node.target:.60} is assigned another type of header")


_REFERENCES: dict[type, Callable[[Any, Program], None]] = {
    tree.Valid: lambda node, p: _known(node.header, p.headers, "header"),
    tree.StackCount: lambda node, p: _known(node.stack, p.stacks, "header stack"),
    tree.ShiftStack: lambda node, p: _known(node.stack, p.stacks, "header stack"),
    tree.AddHeader: lambda node, p: _packet_header(node.header, p),
    tree.RemoveHeader: lambda node, p: _packet_header(node.header, p),
    tree.CopyHeader: _check_copy,
    tree.Count: lambda node, p: _known(node.array, p.counters, "counter"),
    tree.ExecuteMeter: lambda node, p: _known(node.array, p.meters, "meter"),
    tree.RegisterRead: lambda node, p: _known(node.array, p.registers, "register"),
    tree.RegisterWrite: lambda node, p: _known(node.array, p.registers, "register"),
    tree.Hash: lambda node, p: _known(node.calculation, p.calculations, "calculation"),
    tree.Checksum: lambda node, p: _known(node.calculation, p.calculations, "calculation"),
    tree.SendDigest: lambda node, p: _known(node.digest, {0, *p.digests}, "digest"),
}


def _check_names(node: Any, program: Program) -> None:
    reference = _REFERENCES.get(type(node))
    if reference is not None:
        reference(node, program)


def _check_pipeline(pipeline: tree.Pipeline, program: Program) -> None:
    following: list[str | None] = [pipeline.start]
    for node in pipeline.nodes.values():
        if isinstance(node, tree.ConditionNode):
            following += (node.yes, node.no)
        else:
            following += (*node.next_by_action.values(), node.next_on_hit, node.next_on_miss)
            if node.hidden_action is not None and node.hidden_action not in node.actions:
                raise ProgramError(
                    f"malformed BMv2 JSON: table {node.name:.60} does not have its default action"
                )
            if node.meter:
                _known(node.meter, program.meters, "direct meter")
    for name in following:
        if name is not None:
            _known(name, pipeline.nodes, "table or condition")


def _check_state(state: tree.ParserState, program: Program) -> None:
    for name in (*(case.next for case in state.cases), state.default):
        if name is not None:
            _known(name, program.parser.states, "parser state")
    for op in state.ops:
        if isinstance(op, tree.Extract):
            _packet_header(op.header, program)


# -- what is read ahead, headers, sizes ---------------------------------------------------------------


def _check_ahead(program: Program, nodes: Iterable[Any]) -> None:
    """Bits ahead are looked at where their number is checked: in a select, or assigned as they are."""
    checked = 0
    for state in program.parser.states.values():
        plain = [op.value for op in state.ops if isinstance(op, tree.Assign)]
        checked += sum(isinstance(each, tree.Lookahead) for each in (*state.keys, *plain))
    if sum(isinstance(node, tree.Lookahead) for node in nodes) != checked:
        raise Unsupported("lookahead within an expression is not supported by the embedded switch")


def _check_headers(program: Program) -> None:
    _known(program.parser.start, program.parser.states, "parser state")
    for stack in program.stacks.values():
        for header in stack.headers:
            _packet_header(header, program)
        if len(set(stack.headers)) != len(stack.headers) or not stack.headers:
            raise ProgramError(
                f"malformed BMv2 JSON: header stack {stack.name:.60} has a header twice, or none"
            )
        if len({program.headers[header].type for header in stack.headers}) != 1:
            raise ProgramError(f"malformed BMv2 JSON: header stack {stack.name:.60} has several types")
    for header in program.deparser:
        _packet_header(header, program)
    for table in (meter.table for meter in program.meters.values() if meter.table):
        _known(table, program.tables, "table with a direct meter")
    kinds = [header.type for header in program.headers.values()]
    octets = sum(kind.max_bytes or kind.width // 8 for kind in kinds)
    if octets > MAX_HEADER_BYTES:
        raise Unsupported(
            f"headers of {octets} bytes are not supported by the embedded switch (at most {MAX_HEADER_BYTES})"
        )


def _check_sizes(program: Program) -> None:
    octets = sum((array.width + 63) // 64 * 8 * array.size for array in program.registers.values())
    octets += sum(16 * array.size for array in program.counters.values())
    octets += sum(_METER_BYTES * array.size for array in program.meters.values() if not array.table)
    if octets > MAX_STATE_BYTES:
        raise Unsupported(
            f"registers, counters and meters of {octets} bytes are not supported by the embedded switch "
            f"(at most {MAX_STATE_BYTES})"
        )
    for calculation in program.calculations.values():
        bits = sum(width for _, width in calculation.inputs)
        if bits > MAX_HASHED_BITS:
            raise Unsupported(
                f"calculation {calculation.name} over {bits} bits is not supported by the embedded switch "
                f"(at most {MAX_HASHED_BITS})"
            )


def _check_weights(nodes: Iterable[Any]) -> None:
    weights: dict[int, int] = {}
    operators = (tree.Unary, tree.Binary, tree.Conditional)
    if any(_weight(node, weights) > MAX_WEIGHT for node in nodes if isinstance(node, operators)):
        raise Unsupported(
            f"an expression of more than {MAX_WEIGHT} operators is not supported by the embedded switch"
        )


def _weight(e: Any, known: dict[int, int]) -> int:
    """Operators of an expression as it is written out; `known` by identity, since equal ones are many."""
    if id(e) not in known:
        weight = 1
        match e:
            case tree.Unary(_, operand):
                weight += _weight(operand, known)
            case tree.Conditional(condition, yes, no):
                weight += _weight(condition, known) + _weight(yes, known) + _weight(no, known)
            case tree.Binary(op, left, right):
                weight += _weight(left, known) + _weight(right, known) * (2 if op in _TWICE else 1)
        known[id(e)] = weight
    return known[id(e)]
