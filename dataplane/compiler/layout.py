"""Which parts of a packet's state the generated code keeps, and in which slot.

A field has a slot only if the program reads or writes it.  A header that was extracted keeps its bytes;
it leaves as those bytes with the fields that the program may have written laid over them.
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
    for group in _linked(program, parts):
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
    return layout
