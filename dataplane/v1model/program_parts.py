"""The parts that every construct of BMv2 JSON is made of: headers, fields, expressions, statements.

program.py reads parser, pipelines and externs on top of it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from dataplane.errors import ProgramError, Unsupported
from dataplane.v1model import tree
from dataplane.v1model.bmv2_json import Json, hexadecimal, limited, once, whole
from dataplane.v1model.tree import ActionSpec, Expression, FieldRef, FieldType, ParamSpec, Statement

MAX_WIDTH = 512
"""Widest field, bits."""
MAX_FIELDS = 4096
"""Fields of a header, parameters of an action."""
MAX_NESTED = 64
"""Conditions within conditions of an action."""
MAX_LOOKAHEAD = 1 << 16
"""Bits ahead of the parser's cursor."""
_LONGEST_VARBIT = 1 << 16

_BINARY = frozenset({"+", "-", "*", "/", "%", "&", "|", "^", "<<", ">>", "and", "or"})
_CASTS = frozenset({"two_comp_mod", "usat_cast", "sat_cast"})
_BINARY |= {"==", "!=", "<", "<=", ">", ">="} | _CASTS
_UNARY = frozenset({"~", "not", "d2b", "b2d"})


class PartReader:
    """One document being read; `place` names where, for error texts."""

    def __init__(self, document: Json) -> None:
        self.doc = document
        self.where: list[str] = []
        self.headers: dict[str, tree.Header] = {}
        self.stacks: dict[str, tree.Stack] = {}
        self.aliases: dict[str, tuple[str, str]] = {}
        self.widths: tuple[int, ...] = ()
        """Widths of the action parameters in sight."""
        self.nested = 0

    @property
    def place(self) -> str:
        return " / ".join(self.where) or "top level"

    @contextmanager
    def at(self, place: str) -> Iterator[None]:
        self.where.append(place)
        yield
        self.where.pop()

    def refuse(self, what: str) -> NoReturn:
        raise Unsupported(f"{what} is not supported by the embedded switch (at {self.place})")

    # -- headers ------------------------------------------------------------------------------------

    def read_headers(self) -> None:
        self.aliases = {a: (t[0], t[1]) for a, t in self.doc.get("field_aliases", [])}
        types = {
            t["name"]: self.header_type(t) for t in once(self.doc["header_types"], "name", "header types")
        }
        once(self.doc["headers"], "id", "headers")
        for header in once(self.doc["headers"], "name", "headers"):
            name = header["name"]
            self.headers[name] = tree.Header(name, types[header["header_type"]], bool(header["metadata"]))
        names = {h["id"]: h["name"] for h in self.doc["headers"]}
        for stack in once(self.doc.get("header_stacks", []), "name", "header stacks"):
            members = tuple(names[i] for i in stack["header_ids"])
            self.stacks[stack["name"]] = tree.Stack(stack["name"], members)

    def header_type(self, data: Json) -> tree.HeaderType:
        fields: list[FieldType] = []
        offset = 0
        with self.at(f"header type {data['name']}"):
            for item in limited(data["fields"], MAX_FIELDS, "fields"):
                name, width = item[0], item[1]
                if fields and fields[-1].varbit:
                    self.refuse(f"field {name} behind a varbit field")
                if width == "*":
                    fields.append(FieldType(name, 0, offset, varbit=True))
                    continue
                if whole(width, 0, 1 << 32, f"the width of field {name}") > MAX_WIDTH:
                    self.refuse(f"field {name} of {width} bits (at most {MAX_WIDTH})")
                if any(name == known.name for known in fields):
                    raise ProgramError(f"two fields are called {name:.60} at {self.place}")
                flags = [bool(x) for x in item[2:4]] + [False, False]
                fields.append(FieldType(name, width, offset, flags[0], flags[1]))
                offset += width
        varbit = bool(fields) and fields[-1].varbit
        longest = whole(data.get("max_length") or 0, 0, _LONGEST_VARBIT, "max_length")
        return tree.HeaderType(data["name"], tuple(fields), offset, longest if varbit else 0)

    def field(self, value: list[str]) -> FieldRef:
        header, name = value
        alias = self.aliases.get(f"{header}.{name}")
        if alias is not None:
            header, name = alias
        if header not in self.headers:
            raise ProgramError(f"unknown header {header} at {self.place}")
        found = self.headers[header].type.field(name)
        if found is None:
            raise ProgramError(f"unknown field {header}.{name} at {self.place}")
        return FieldRef(header, found)

    def field_or_valid(self, value: list[str]) -> Expression:
        return tree.Valid(value[0]) if value[1] == "$valid$" else self.field(value)

    def stack_last(self, value: list[str]) -> tree.StackLast:
        stack = self.stacks[value[0]]
        found = self.headers[stack.headers[0]].type.field(value[1])
        if found is None:
            raise ProgramError(f"unknown field {value} at {self.place}")
        return tree.StackLast(stack.name, found)

    # -- expressions --------------------------------------------------------------------------------

    def expression(self, data: Json | None) -> Expression:
        """Any value: a field, constant, parameter or an operator over values."""
        if data is None:
            raise ProgramError(f"missing operand at {self.place}")
        if "type" not in data:
            return self.operator(data)
        kind, value = data["type"], data.get("value")
        readers: dict[str, Callable[[Any], Expression]] = {
            "expression": self.expression,
            "field": self.field_or_valid,
            "hexstr": lambda v: tree.Const(hexadecimal(v)),
            "bool": lambda v: tree.Const(int(v)),
            "runtime_data": self.param,
            "local": self.param,
            "stack_field": self.stack_last,
            "lookahead": lambda v: tree.Lookahead(
                whole(v[0], 0, MAX_LOOKAHEAD, "an offset ahead"), whole(v[1], 1, MAX_WIDTH, "bits ahead")
            ),
        }
        if kind not in readers:
            self.refuse(f"operand of type {kind}")
        return readers[kind](value)

    def param(self, index: int) -> tree.Param:
        number = whole(index, 0, len(self.widths) - 1, "the number of a parameter")
        return tree.Param(number, self.widths[number])

    def operator(self, data: Json) -> Expression:
        op, left, right = data["op"], data.get("left"), data.get("right")
        if op == "?":
            return tree.Conditional(
                self.expression(data["cond"]), self.expression(left), self.expression(right)
            )
        if op in ("last_stack_index", "size_stack"):
            offset = -1 if op == "last_stack_index" else 0
            return tree.StackCount((right or {})["value"], offset)
        if op in _UNARY:
            return tree.Unary(op, self.expression(right))
        if op not in _BINARY:
            self.refuse(f"operator {op}")
        if op in _CASTS:
            width = self.expression(right)
            if not isinstance(width, tree.Const) or not 0 < width.value <= MAX_WIDTH:
                self.refuse(f"{op} to a width that is not a constant within 1..{MAX_WIDTH}")
            return tree.Binary(op, self.expression(left), width)
        if left is None and op in "+-":
            return tree.Binary(op, tree.Const(0), self.expression(right))
        return tree.Binary(op, self.expression(left), self.expression(right))

    # -- statements ---------------------------------------------------------------------------------

    def action(self, number: int, data: Json) -> tree.Action:
        with self.at(f"action {data['name']}"):
            given = limited(data["runtime_data"], MAX_FIELDS, "parameters")
            params = tuple(ParamSpec(p["name"], whole(p["bitwidth"], 0, 1 << 32, "bitwidth")) for p in given)
            for p in params:
                if p.width > MAX_WIDTH:
                    self.refuse(f"parameter {p.name} of {p.width} bits")
            self.widths = tuple(p.width for p in params)
            primitives = data["primitives"]
            body = self.block(primitives, 0, len(primitives))
            self.widths = ()
            return tree.Action(number, ActionSpec(data["name"], params), body)

    def block(self, primitives: list[Json], start: int, end: int) -> tuple[Statement, ...]:
        """Statements [start, end); jumps are folded into `If` (p4c writes forward jumps of if-else only)."""
        body: list[Statement] = []
        here = start
        while here < end:
            primitive = primitives[here]
            op = primitive["op"]
            if op == "_jump_if_zero":
                statement, here = self.branch(primitives, here, end)
                body.append(statement)
                continue
            if op == "_jump":
                self.refuse("unstructured _jump")
            body.extend(self.primitive(primitive))
            here += 1
        return tuple(body)

    def branch(self, primitives: list[Json], here: int, end: int) -> tuple[Statement, int]:
        if self.nested >= MAX_NESTED:
            self.refuse(f"more than {MAX_NESTED} conditions within one another")
        self.nested += 1
        try:
            return self.nested_branch(primitives, here, end)
        finally:
            self.nested -= 1

    def nested_branch(self, primitives: list[Json], here: int, end: int) -> tuple[Statement, int]:
        condition = self.expression(primitives[here]["parameters"][0])
        target = min(hexadecimal(primitives[here]["parameters"][1]["value"]), end)
        if target <= here:
            self.refuse("backward _jump_if_zero")
        last = primitives[target - 1]
        if last["op"] == "_jump" and target - 1 > here:
            after = min(hexadecimal(last["parameters"][0]["value"]), end)
            then = self.block(primitives, here + 1, target - 1)
            return tree.If(condition, then, self.block(primitives, target, after)), max(after, target)
        return tree.If(condition, self.block(primitives, here + 1, target)), target

    def primitive(self, data: Json) -> list[Statement]:
        op, parameters = data["op"], data["parameters"]
        reader = _PRIMITIVES.get(op)
        if op in _NO_EFFECT:
            return []
        if reader is None:
            self.refuse(f"primitive {op}")
        with self.at(f"primitive {op}"):
            return [reader(self, parameters)]

    def assign(self, p: list[Json]) -> Statement:
        if p[0]["type"] != "field" or p[0]["value"][1] == "$valid$":
            self.refuse(f"assignment to {p[0]['type']} {p[0]['value']}")
        return tree.Assign(self.target(p[0]), self.expression(p[1]))

    def target(self, data: Json) -> FieldRef:
        if data["type"] != "field":
            self.refuse(f"result in {data['type']} {data.get('value')}")
        found = self.field(data["value"])
        if found.field.varbit:
            self.refuse(f"assignment to varbit {found.header}.{found.field.name}")
        return found

    def constant(self, data: Json) -> int:
        value = self.expression(data)
        if not isinstance(value, tree.Const):
            self.refuse("an argument that is not a constant")
        return value.value


_Primitive = Callable[[PartReader, list[Json]], Statement]
_NO_EFFECT = frozenset({"no_op", "log_msg"})
_PRIMITIVES: dict[str, _Primitive] = {
    "assign": PartReader.assign,
    "modify_field": PartReader.assign,
    "assign_header": lambda _, p: tree.CopyHeader(p[0]["value"], p[1]["value"]),
    "copy_header": lambda _, p: tree.CopyHeader(p[0]["value"], p[1]["value"]),
    "add_header": lambda _, p: tree.AddHeader(p[0]["value"]),
    "remove_header": lambda _, p: tree.RemoveHeader(p[0]["value"]),
    "push": lambda r, p: tree.ShiftStack(p[0]["value"], r.constant(p[1])),
    "pop": lambda r, p: tree.ShiftStack(p[0]["value"], -r.constant(p[1])),
    "drop": lambda _, _p: tree.MarkToDrop(),
    "mark_to_drop": lambda _, _p: tree.MarkToDrop(),
    "count": lambda r, p: tree.Count(p[0]["value"], r.expression(p[1])),
    "execute_meter": lambda r, p: tree.ExecuteMeter(p[0]["value"], r.expression(p[1]), r.target(p[2])),
    "register_read": lambda r, p: tree.RegisterRead(r.target(p[0]), p[1]["value"], r.expression(p[2])),
    "register_write": lambda r, p: tree.RegisterWrite(p[0]["value"], r.expression(p[1]), r.expression(p[2])),
    "modify_field_with_hash_based_offset": lambda r, p: tree.Hash(
        r.target(p[0]), p[2]["value"], r.expression(p[1]), r.expression(p[3])
    ),
    "modify_field_rng_uniform": lambda r, p: tree.Random(
        r.target(p[0]), r.expression(p[1]), r.expression(p[2])
    ),
    "clone_ingress_pkt_to_egress": lambda r, p: tree.Clone(r.expression(p[0]), r.constant(p[1])),
    "clone_egress_pkt_to_egress": lambda r, p: tree.Clone(r.expression(p[0]), r.constant(p[1])),
    "generate_digest": lambda r, p: tree.SendDigest(r.constant(p[1])),
    "resubmit": lambda r, p: tree.Resubmit(r.constant(p[0])),
    "recirculate": lambda r, p: tree.Recirculate(r.constant(p[0])),
    "truncate": lambda r, p: tree.Truncate(r.expression(p[0])),
    "exit": lambda _, _p: tree.Exit(),
}
