"""Which parts of a packet's state the generated code keeps, and in which slot.

A field has a slot only if the program reads or writes it, and is a local variable of generated C where one
pipeline alone does.  A header that was extracted keeps its bytes; it leaves as those bytes with the fields that
the program may have written laid over them.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from dataplane.v1model import tree
from dataplane.v1model.tree import FieldRef, FieldType, Program

ENGINE_FIELDS = (
    "ingress_port",
    "egress_spec",
    "egress_port",
    "instance_type",
    "packet_length",
    "enq_timestamp",
    "ingress_global_timestamp",
    "egress_global_timestamp",
    "mcast_grp",
    "egress_rid",
    "checksum_error",
    "parser_error",
)
"""Fields of standard_metadata that the engine itself reads or writes."""
STANDARD = "standard_metadata"


def walk(node: Any) -> Iterator[Any]:
    """Every dataclass of a part of the tree, parents first."""
    if isinstance(node, tuple | list):
        for item in node:
            yield from walk(item)
    elif isinstance(node, dict):
        for item in node.values():
            yield from walk(item)
    elif dataclasses.is_dataclass(node):
        yield node
        if isinstance(node, FieldRef | tree.StackLast):
            return
        for part in dataclasses.fields(node):
            yield from walk(getattr(node, part.name))


@dataclass(slots=True)
class Layout:
    """fields[header]: those kept, in header order; written[header]: those laid over the bytes."""

    fields: dict[str, tuple[FieldType, ...]] = field(default_factory=dict)
    written: dict[str, tuple[FieldType, ...]] = field(default_factory=dict)
    packet_headers: tuple[str, ...] = ()
    metadata: tuple[str, ...] = ()
    private: dict[str, tuple[FieldRef, ...]] = field(default_factory=dict)
    """Metadata that ingress, or egress, alone looks at: 0 whenever it begins."""
    out_of_order: frozenset[tree.Extract] = frozenset()
    """Extractions after which a frame may not leave as it came, though nothing in it was changed."""

    def has(self, ref: FieldRef) -> bool:
        return ref.field in self.fields[ref.header]

    def standard(self, name: str) -> FieldRef | None:
        """A field of standard_metadata that has a slot."""
        found = next((f for f in self.fields.get(STANDARD, ()) if f.name == name), None)
        return FieldRef(STANDARD, found) if found else None


def used_actions(program: Program) -> tuple[int, ...]:
    """Actions that some table can run."""
    numbers: set[int] = set()
    for pipeline in (program.ingress, program.egress):
        for node in pipeline.nodes.values():
            if isinstance(node, tree.TableNode):
                numbers.update(node.actions)
    return tuple(sorted(numbers))


def _live_parts(program: Program) -> list[Any]:
    return [
        program.parser.states,
        [program.actions[n] for n in used_actions(program)],
        program.ingress.nodes,
        program.egress.nodes,
        program.calculations,
        program.checksums,
        program.digests,
        program.field_lists,
        [m for m in program.meters.values() if m.table],
    ]


def _fields(program: Program, parts: Any) -> set[FieldRef]:
    """Fields that parts of the tree read or write; of a stack's last header, all that it may be."""
    found: set[FieldRef] = set()
    for node in walk(parts):
        if isinstance(node, FieldRef):
            found.add(node)
        elif isinstance(node, tree.StackLast):
            found.update(FieldRef(header, node.field) for header in program.stacks[node.stack].headers)
        elif isinstance(node, tree.Hash):
            found |= _fields(program, program.calculations[node.calculation])
    return found


def _pipeline_fields(program: Program, pipeline: tree.Pipeline) -> set[FieldRef]:
    """Fields that the tables, conditions and actions of a pipeline read or write."""
    parts: list[Any] = [pipeline.nodes]
    for node in pipeline.nodes.values():
        if isinstance(node, tree.TableNode):
            parts += [program.actions[number] for number in node.actions]
            if node.hidden_action is not None:
                parts.append(program.actions[node.hidden_action])
            if node.meter:
                parts.append(program.meters[node.meter])
    return _fields(program, parts)


def _private(program: Program, layout: Layout, linked: list[set[str]]) -> dict[str, tuple[FieldRef, ...]]:
    """Metadata of one pipeline alone.

    Nothing carries it to the next pass of a packet or out of the switch: no list of fields that a copy
    keeps, no digest, no checksum, no parser.
    """
    elsewhere = _fields(
        program, [program.parser.states, program.checksums, program.digests, program.field_lists]
    )
    for checksum in program.checksums:
        elsewhere |= _fields(program, program.calculations[checksum.calculation])
    elsewhere |= {ref for name in ENGINE_FIELDS if (ref := layout.standard(name))}
    copied = set().union(*linked)
    candidates = [FieldRef(h, f) for h in layout.metadata if h not in copied for f in layout.fields[h]]
    ingress, egress = (_pipeline_fields(program, each) for each in (program.ingress, program.egress))
    return {
        name: tuple(ref for ref in candidates if ref in mine and ref not in others and ref not in elsewhere)
        for name, mine, others in (("ingress", ingress, egress), ("egress", egress, ingress))
    }


def _linked(program: Program, parts: list[Any]) -> list[set[str]]:
    """Sets of headers whose contents move between one another."""
    groups = [set(s.headers) for s in program.stacks.values()]
    groups += [{n.target, n.source} for n in walk(parts) if isinstance(n, tree.CopyHeader)]
    merged: list[set[str]] = []
    for group in groups:
        touching = [g for g in merged if g & group]
        merged = [g for g in merged if not g & group]
        merged.append(group.union(*touching))
    return merged


def _emission_ranks(program: Program) -> dict[str, int]:
    """Where the deparser emits a header, or a stack: -1 where it does not, or not in one piece."""
    direct = {
        op.header
        for state in program.parser.states.values()
        for op in state.ops
        if isinstance(op, tree.Extract) and not op.stack
    }
    emitted = {name: rank for rank, name in enumerate(program.deparser)}
    ranks = {name: -1 if program.deparser.count(name) > 1 else rank for name, rank in emitted.items()}
    for stack in program.stacks.values():
        places = [ranks.get(name, -1) for name in stack.headers]
        together = places == list(range(places[0], places[0] + len(places))) and places[0] >= 0
        if not together or direct & set(stack.headers):
            ranks |= dict.fromkeys(stack.headers, -1)
        for name in stack.headers[1:]:
            ranks[name] = ranks.get(stack.headers[0], -1)
    return ranks


def _out_of_order(program: Program) -> frozenset[tree.Extract]:
    """Extractions after which the deparser may not emit the extracted headers as they stood in the frame."""
    ranks, states = _emission_ranks(program), program.parser.states

    def rank(op: tree.Extract) -> int:
        return ranks.get(program.stacks[op.stack].headers[0] if op.stack else op.header, -1)

    highest = dict.fromkeys(states, -1)  # what may stand before a state
    wrong: set[tree.Extract] = set()
    waiting = list(states)
    while waiting:
        state = states[waiting.pop()]
        most = highest[state.name]
        for op in state.ops:
            if isinstance(op, tree.Extract):
                least = max(0, most) if op.stack else most + 1
                if rank(op) < least:
                    wrong.add(op)
                most = max(most, rank(op))
        for following in {*(case.next for case in state.cases), state.default}:
            if following is not None and highest[following] < most:
                highest[following] = most
                waiting.append(following)
    return frozenset(wrong)


def make(program: Program) -> Layout:
    """Lay out a program's packet state."""
    parts = _live_parts(program)
    used: dict[str, set[str]] = {name: set() for name in program.headers}
    written: dict[str, set[str]] = {name: set() for name in program.headers}
    for node in walk(parts):
        if isinstance(node, FieldRef):
            used[node.header].add(node.field.name)
        elif isinstance(node, tree.StackLast):
            for header in program.stacks[node.stack].headers:
                used[header].add(node.field.name)
        target = getattr(node, "target", None)
        if isinstance(target, FieldRef):
            written[target.header].add(target.field.name)
            used[target.header].add(target.field.name)
    used.get(STANDARD, set()).update(ENGINE_FIELDS)
    linked = _linked(program, parts)
    for group in linked:
        for table in (used, written):
            everything = set().union(*(table[h] for h in group))
            for header in group:
                table[header] = everything
    layout = Layout()
    for name, instance in program.headers.items():
        fields = instance.type.fields
        layout.fields[name] = tuple(f for f in fields if f.name in used[name] and not f.varbit)
        layout.written[name] = tuple(f for f in fields if f.name in written[name] and not f.varbit)
    layout.packet_headers = tuple(n for n, h in program.headers.items() if not h.metadata)
    layout.metadata = tuple(n for n, h in program.headers.items() if h.metadata)
    layout.out_of_order = _out_of_order(program)
    layout.private = _private(program, layout, linked)
    return layout
