"""BMv2 JSON (as p4c writes it) -> a typed tree.  The only file that knows the JSON's names.

What is outside the subset of docs/dataplane.md is refused here with `Unsupported`, whose text names the
primitive or construct and where it stands; what is no such JSON at all with `ProgramError`.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from dataplane import tree
from dataplane.errors import ProgramError, Unsupported
from dataplane.tree import (
    ActionSpec,
    ArraySpec,
    DigestSpec,
    Expression,
    FieldRef,
    FieldType,
    KeySpec,
    MatchKind,
    ParamSpec,
    Program,
    Statement,
    TableSpec,
)

__all__ = [
    "ActionSpec",
    "ArraySpec",
    "DigestSpec",
    "KeySpec",
    "MatchKind",
    "ParamSpec",
    "Program",
    "TableSpec",
    "load",
]

_Json = dict[str, Any]
MAX_WIDTH = 512
"""Widest field, bits."""

HASHES = frozenset({"crc32", "crc32_custom", "crc16", "crc16_custom", "csum16", "cksum16", "identity"})
HASHES |= {"xor16", "xor32", "crcCCITT"}

_BINARY = frozenset({"+", "-", "*", "/", "%", "&", "|", "^", "<<", ">>", "and", "or"})
_BINARY |= {"==", "!=", "<", "<=", ">", ">=", "two_comp_mod", "usat_cast", "sat_cast"}
_UNARY = frozenset({"~", "not", "d2b", "b2d"})
_REFUSED = ("parse_vsets", "header_unions", "header_union_stacks", "extern_instances")


def load(data: bytes | str) -> Program:
    """Read BMv2 JSON.

    Raises ProgramError where it is not such JSON, Unsupported where it uses what this target lacks (the
    text names the primitive or construct and where it stands).
    """
    try:
        document = json.loads(data)
    except ValueError as error:
        raise ProgramError(f"not BMv2 JSON: {error}; compile the program with p4c-bm2-ss") from error
    if not isinstance(document, dict) or "pipelines" not in document:
        raise ProgramError("not BMv2 JSON: no pipelines in it; compile the program with p4c-bm2-ss")
    reader = _Reader(document)
    try:
        return reader.program()
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ProgramError(f"malformed BMv2 JSON at {reader.place}: {error!r}") from error


def _number(text: str) -> int:
    return int(text, 16)


class _Reader:
    """One document being read; `place` names where, for error texts."""

    def __init__(self, document: _Json) -> None:
        self.doc = document
        self.where: list[str] = []
        self.headers: dict[str, tree.Header] = {}
        self.stacks: dict[str, tree.Stack] = {}
        self.aliases: dict[str, tuple[str, str]] = {}
        self.widths: tuple[int, ...] = ()
        """Widths of the action parameters in sight."""

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

    # -- whole program ------------------------------------------------------------------------------

    def program(self) -> Program:
        for name in _REFUSED:
            if self.doc.get(name):
                self.refuse(f"{name.removesuffix('s').replace('_', ' ')} {self.doc[name][0].get('name', '')}")
        self.read_headers()
        digests = {d["id"]: self.digest(d) for d in self.doc.get("learn_lists", [])}
        field_lists = {f["id"]: self.field_list(f) for f in self.doc.get("field_lists", [])}
        registers = {r["name"]: self.register(r) for r in self.doc.get("register_arrays", [])}
        counters = {c["name"]: self.counter(c) for c in self.doc.get("counter_arrays", [])}
        meters = {m["name"]: self.meter(m) for m in self.doc.get("meter_arrays", [])}
        calculations = {c["name"]: self.calculation(c) for c in self.doc.get("calculations", [])}
        actions = tuple(self.action(i, a) for i, a in enumerate(self.doc["actions"]))
        self.action_numbers = {a["id"]: i for i, a in enumerate(self.doc["actions"])}
        self.actions = actions
        self.tables: dict[str, TableSpec] = {}
        pipelines = {p["name"]: self.pipeline(p) for p in self.doc["pipelines"]}
        deparser = self.doc["deparsers"][0]
        if deparser.get("primitives"):
            with self.at("deparser"):
                self.refuse(f"primitive {deparser['primitives'][0].get('op')}")
        return Program(
            name=str(self.doc.get("program", "")),
            headers=self.headers,
            stacks=self.stacks,
            errors=dict(self.doc.get("errors", [])),
            parser=self.parser(self.doc["parsers"][0]),
            ingress=pipelines["ingress"],
            egress=pipelines["egress"],
            actions=actions,
            tables=self.tables,
            calculations=calculations,
            checksums=tuple(self.checksum(c) for c in self.doc.get("checksums", [])),
            deparser=tuple(deparser["order"]),
            field_lists=field_lists,
            digests=digests,
            counters=counters,
            meters=meters,
            registers=registers,
            aliases=self.aliases,
        )

    # -- headers ------------------------------------------------------------------------------------

    def read_headers(self) -> None:
        self.aliases = {a: (t[0], t[1]) for a, t in self.doc.get("field_aliases", [])}
        types = {t["name"]: self.header_type(t) for t in self.doc["header_types"]}
        for header in self.doc["headers"]:
            name = header["name"]
            self.headers[name] = tree.Header(name, types[header["header_type"]], bool(header["metadata"]))
        names = {h["id"]: h["name"] for h in self.doc["headers"]}
        for stack in self.doc.get("header_stacks", []):
            members = tuple(names[i] for i in stack["header_ids"])
            self.stacks[stack["name"]] = tree.Stack(stack["name"], members)

    def header_type(self, data: _Json) -> tree.HeaderType:
        fields: list[FieldType] = []
        offset = 0
        with self.at(f"header type {data['name']}"):
            for item in data["fields"]:
                name, width = item[0], item[1]
                if fields and fields[-1].varbit:
                    self.refuse(f"field {name} behind a varbit field")
                if width == "*":
                    fields.append(FieldType(name, 0, offset, varbit=True))
                    continue
                if width > MAX_WIDTH:
                    self.refuse(f"field {name} of {width} bits (at most {MAX_WIDTH})")
                flags = [bool(x) for x in item[2:4]] + [False, False]
                fields.append(FieldType(name, width, offset, flags[0], flags[1]))
                offset += width
        varbit = bool(fields) and fields[-1].varbit
        longest = int(data.get("max_length") or 0)
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

    def expression(self, data: _Json | None) -> Expression:
        """Any value: a field, constant, parameter or an operator over values."""
        if data is None:
            raise ProgramError(f"missing operand at {self.place}")
        if "type" not in data:
            return self.operator(data)
        kind, value = data["type"], data.get("value")
        readers: dict[str, Callable[[Any], Expression]] = {
            "expression": self.expression,
            "field": self.field_or_valid,
            "hexstr": lambda v: tree.Const(_number(v)),
            "bool": lambda v: tree.Const(int(v)),
            "runtime_data": self.param,
            "local": self.param,
            "stack_field": self.stack_last,
            "lookahead": lambda v: tree.Lookahead(v[0], v[1]),
        }
        if kind not in readers:
            self.refuse(f"operand of type {kind}")
        return readers[kind](value)

    def param(self, index: int) -> tree.Param:
        return tree.Param(index, self.widths[index])

    def operator(self, data: _Json) -> Expression:
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
        if left is None and op in "+-":
            return tree.Binary(op, tree.Const(0), self.expression(right))
        return tree.Binary(op, self.expression(left), self.expression(right))

    # -- statements ---------------------------------------------------------------------------------

    def action(self, number: int, data: _Json) -> tree.Action:
        with self.at(f"action {data['name']}"):
            params = tuple(ParamSpec(p["name"], p["bitwidth"]) for p in data["runtime_data"])
            for p in params:
                if p.width > MAX_WIDTH:
                    self.refuse(f"parameter {p.name} of {p.width} bits")
            self.widths = tuple(p.width for p in params)
            primitives = data["primitives"]
            body = self.block(primitives, 0, len(primitives))
            self.widths = ()
            return tree.Action(number, ActionSpec(data["name"], params), body)

    def block(self, primitives: list[_Json], start: int, end: int) -> tuple[Statement, ...]:
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

    def branch(self, primitives: list[_Json], here: int, end: int) -> tuple[Statement, int]:
        condition = self.expression(primitives[here]["parameters"][0])
        target = min(_number(primitives[here]["parameters"][1]["value"]), end)
        if target <= here:
            self.refuse("backward _jump_if_zero")
        last = primitives[target - 1]
        if last["op"] == "_jump" and target - 1 > here:
            after = min(_number(last["parameters"][0]["value"]), end)
            then = self.block(primitives, here + 1, target - 1)
            return tree.If(condition, then, self.block(primitives, target, after)), max(after, target)
        return tree.If(condition, self.block(primitives, here + 1, target)), target

    def primitive(self, data: _Json) -> list[Statement]:
        op, parameters = data["op"], data["parameters"]
        reader = _PRIMITIVES.get(op)
        if op in _NO_EFFECT:
            return []
        if reader is None:
            self.refuse(f"primitive {op}")
        with self.at(f"primitive {op}"):
            return [reader(self, parameters)]

    def assign(self, p: list[_Json]) -> Statement:
        if p[0]["type"] != "field" or p[0]["value"][1] == "$valid$":
            self.refuse(f"assignment to {p[0]['type']} {p[0]['value']}")
        return tree.Assign(self.target(p[0]), self.expression(p[1]))

    def target(self, data: _Json) -> FieldRef:
        if data["type"] != "field":
            self.refuse(f"result in {data['type']} {data.get('value')}")
        found = self.field(data["value"])
        if found.field.varbit:
            self.refuse(f"assignment to varbit {found.header}.{found.field.name}")
        return found

    def constant(self, data: _Json) -> int:
        value = self.expression(data)
        if not isinstance(value, tree.Const):
            self.refuse("an argument that is no constant")
        return value.value

    # -- parser -------------------------------------------------------------------------------------

    def parser(self, data: _Json) -> tree.Parser:
        states = {}
        for state in data["parse_states"]:
            with self.at(f"parser state {state['name']}"):
                states[state["name"]] = self.state(state)
        return tree.Parser(data["init_state"], states)

    def state(self, data: _Json) -> tree.State:
        ops = [op for item in data["parser_ops"] for op in self.parser_op(item)]
        keys = tuple(self.expression(k) for k in data["transition_key"])
        widths = tuple(self.key_width(k) for k in keys)
        cases: list[tree.Case] = []
        default: str | None = None
        for transition in data["transitions"]:
            kind = transition.get("type", "hexstr")
            if kind == "default" or transition["value"] == "default":
                default = transition["next_state"]
            elif kind == "hexstr":
                cases.append(self.case(transition, widths))
            else:
                self.refuse(f"transition of type {kind}")
        return tree.State(data["name"], tuple(ops), keys, widths, tuple(cases), default)

    @staticmethod
    def key_width(key: Expression) -> int:
        if isinstance(key, FieldRef | tree.StackLast):
            return key.field.width
        return key.width if isinstance(key, tree.Lookahead) else 1

    @staticmethod
    def case(data: _Json, widths: tuple[int, ...]) -> tree.Case:
        """Values and masks are concatenations of the keys, each padded to whole bytes."""
        value = _number(data["value"])
        mask = -1 if data["mask"] is None else _number(data["mask"])
        parts: list[tuple[int, int]] = []
        for width in reversed(widths):
            full = (1 << width) - 1
            m = mask & full
            parts.append((value & m, m))
            value >>= (width + 7) // 8 * 8
            mask >>= (width + 7) // 8 * 8
        return tree.Case(tuple(reversed(parts)), data["next_state"])

    def parser_op(self, data: _Json) -> list[tree.ParserOp]:
        op, p = data["op"], data["parameters"]
        with self.at(f"operation {op}"):
            if op in ("extract", "extract_VL"):
                return [self.extract(p)]
            if op == "set":
                return [self.assign(p)]
            if op == "primitive":
                return list(self.primitive(p[0]))
            if op == "verify":
                return [tree.Verify(self.expression(p[0]), self.expression(p[1]))]
            if op == "advance":
                return [tree.Advance(self.expression(p[0]))]
            if op == "shift":
                return [tree.Advance(tree.Const(int(p[0]) * 8))]
            return self.refuse(f"parser operation {op}")

    def extract(self, p: list[_Json]) -> tree.Extract:
        kind, name = p[0]["type"], p[0]["value"]
        bits = self.expression(p[1]) if len(p) > 1 else None
        if kind == "regular":
            header, stack = name, ""
        elif kind == "stack":
            header, stack = self.stacks[name].headers[0], name
        else:
            self.refuse(f"extraction into {kind} {name}")
        if self.headers[header].type.max_bytes and bits is None:
            self.refuse(f"extraction of {header} without a length for its varbit field")
        return tree.Extract(header, stack, bits)

    # -- pipelines ----------------------------------------------------------------------------------

    def pipeline(self, data: _Json) -> tree.Pipeline:
        nodes: dict[str, tree.Node] = {}
        with self.at(f"{data['name']} pipeline"):
            if data.get("action_profiles"):
                self.refuse(f"action profile {data['action_profiles'][0]['name']}")
            for table in data["tables"]:
                with self.at(f"table {table['name']}"):
                    nodes[table["name"]] = self.table(table)
            for condition in data["conditionals"]:
                with self.at(f"condition {condition['name']}"):
                    nodes[condition["name"]] = tree.ConditionNode(
                        condition["name"],
                        self.expression(condition["expression"]),
                        condition.get("true_next"),
                        condition.get("false_next"),
                    )
            for call in data.get("action_calls", []):
                number = self.action_numbers[call["action_id"]]
                nodes[call["name"]] = self.call(call["name"], number, call["next_node"])
        return tree.Pipeline(data["name"], data["init_table"], nodes)

    @staticmethod
    def call(name: str, action: int, following: str | None) -> tree.TableNode:
        return tree.TableNode(
            name, (), (), (action,), {action: following}, False, None, following, hidden_action=action
        )

    def table(self, data: _Json) -> tree.TableNode:
        if data["type"] != "simple":
            self.refuse(f"table of type {data['type']}")
        actions = tuple(self.action_numbers[i] for i in data["action_ids"])
        specs = tuple(self.actions[n].spec for n in actions)
        keys = tuple(self.key(k) for k in data["key"])
        following = {self.actions[n].spec.name: n for n in actions}
        default = data.get("default_entry")
        constant = default is not None and bool(default.get("action_const", False))
        after = data["next_tables"]
        by_hit = "__HIT__" in after
        node = tree.TableNode(
            name=data["name"],
            keys=tuple(k[1] for k in keys),
            key_masks=tuple(k[2] for k in keys),
            actions=actions,
            next_by_action={} if by_hit else {following[a]: n for a, n in after.items() if a in following},
            by_hit=by_hit,
            next_on_hit=after.get("__HIT__"),
            next_on_miss=after["__MISS__"] if by_hit else data.get("base_default_next"),
            meter=data.get("direct_meters") or "",
            hidden_action=self.hidden_action(data["name"], default) if constant and not keys else None,
        )
        self.tables[data["name"]] = TableSpec(
            name=data["name"],
            keys=tuple(k[0] for k in keys),
            actions=specs,
            size=data["max_size"],
            has_counter=bool(data.get("with_counters")),
            has_meter=bool(data.get("direct_meters")),
            has_idle_timeout=bool(data.get("support_timeout")),
            default_is_const=constant,
            default=self.default(default),
            const_entries=tuple(self.const_entry(e, keys) for e in data.get("entries", [])),
        )
        if node.hidden_action is not None:
            del self.tables[data["name"]]
        return node

    def hidden_action(self, table: str, default: _Json | None) -> int | None:
        """The action of a table that p4c made around a statement; p4info does not know it."""
        if default is None:
            return None
        number = self.action_numbers[default["action_id"]]
        return number if table.startswith("tbl_") and not self.actions[number].spec.params else None

    def default(self, data: _Json | None) -> tuple[str, tuple[int, ...]] | None:
        if data is None:
            return None
        action = self.actions[self.action_numbers[data["action_id"]]]
        return action.spec.name, tuple(_number(v) for v in data["action_data"])

    def key(self, data: _Json) -> tuple[KeySpec, Expression, int]:
        try:
            kind = MatchKind(data["match_type"])
        except ValueError:
            self.refuse(f"match kind {data['match_type']}")
        target = self.field_or_valid(data["target"])
        width = target.field.width if isinstance(target, FieldRef) else 1
        full = (1 << width) - 1
        mask = full if data.get("mask") is None else _number(data["mask"]) & full
        name = data.get("name") or ".".join(data["target"])
        return KeySpec(name, kind, width), target, mask

    def const_entry(self, data: _Json, keys: tuple[tuple[KeySpec, Expression, int], ...]) -> tree.ConstEntry:
        parts = []
        for item, (spec, _, _) in zip(data["match_key"], keys, strict=True):
            parts.append(self.const_key(item, spec))
        action = self.actions[self.action_numbers[data["action_entry"]["action_id"]]]
        params = tuple(_number(v) for v in data["action_entry"]["action_data"])
        # BMv2's smallest number wins, P4Runtime's largest
        return tree.ConstEntry(tuple(parts), (1 << 24) - data.get("priority", 0), action.spec.name, params)

    @staticmethod
    def const_key(item: _Json, spec: KeySpec) -> tuple[MatchKind, int, int]:
        if spec.kind is MatchKind.RANGE:
            return spec.kind, _number(item["start"]), _number(item["end"])
        value = _number(item["key"])
        if spec.kind is MatchKind.LPM:
            return spec.kind, value, item["prefix_length"]
        if spec.kind in (MatchKind.TERNARY, MatchKind.OPTIONAL):
            return spec.kind, value, _number(item["mask"])
        return spec.kind, value, 0

    # -- externs ------------------------------------------------------------------------------------

    def register(self, data: _Json) -> ArraySpec:
        with self.at(f"register {data['name']}"):
            if data["bitwidth"] > MAX_WIDTH:
                self.refuse(f"width of {data['bitwidth']} bits (at most {MAX_WIDTH})")
        return ArraySpec(data["name"], data["size"], data["bitwidth"])

    @staticmethod
    def counter(data: _Json) -> ArraySpec:
        table = data["binding"] if data["is_direct"] else ""
        return ArraySpec(data["name"], data.get("size", 0), unit="both", table=table)

    def meter(self, data: _Json) -> ArraySpec:
        with self.at(f"meter {data['name']}"):
            if data["rate_count"] != 2:
                self.refuse(f"a meter of {data['rate_count']} rates (two)")
            table = data["binding"] if data["is_direct"] else ""
            target = self.field(data["result_target"]) if data["is_direct"] else None
            return ArraySpec(data["name"], data["size"], unit=data["type"], table=table, target=target)

    def digest(self, data: _Json) -> DigestSpec:
        with self.at(f"digest {data['name']}"):
            fields = tuple(self.expression(e) for e in data["elements"])
            return DigestSpec(data["name"], fields, tuple(self.key_width(f) for f in fields))

    def field_list(self, data: _Json) -> tuple[FieldRef, ...]:
        with self.at(f"field list {data['name']}"):
            return tuple(self.target(e) for e in data["elements"])

    def calculation(self, data: _Json) -> tree.Calculation:
        inputs: list[tuple[Expression, int]] = []
        payload = False
        with self.at(f"calculation {data['name']}"):
            if data["algo"] not in HASHES:
                self.refuse(f"hash algorithm {data['algo']}")
            for item in data["input"]:
                if item["type"] == "payload":
                    payload = True
                elif item["type"] == "hexstr":
                    inputs.append((tree.Const(_number(item["value"])), item["bitwidth"]))
                elif item["type"] == "field":
                    ref = self.field(item["value"])
                    inputs.append((ref, ref.field.width))
                else:
                    self.refuse(f"input of type {item['type']}")
        return tree.Calculation(data["name"], data["algo"], tuple(inputs), payload)

    def checksum(self, data: _Json) -> tree.Checksum:
        with self.at(f"checksum {data['name']}"):
            if data["type"] != "generic":
                self.refuse(f"checksum of type {data['type']}")
            condition = data.get("if_cond")
            return tree.Checksum(
                data["name"],
                self.field(data["target"]),
                data["calculation"],
                self.expression(condition) if condition else None,
                bool(data.get("verify")),
                bool(data.get("update")),
            )


_Primitive = Callable[[_Reader, list[_Json]], Statement]
_NO_EFFECT = frozenset({"no_op", "log_msg"})
_PRIMITIVES: dict[str, _Primitive] = {
    "assign": _Reader.assign,
    "modify_field": _Reader.assign,
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
