"""BMv2 JSON (as p4c writes it) -> a typed tree.  Nothing behind it knows the JSON's names.

    bytes ─ bmv2_json.py (size, depth) ─► dict ─ program_parts.py, this ─► tree ─ program_check.py ─► Program

What is outside the subset of docs/dataplane.md is refused here with `Unsupported`, whose text names the
primitive or construct and where it stands; what is no such JSON at all with `ProgramError`.
"""

from dataplane.errors import ProgramError
from dataplane.v1model import tree
from dataplane.v1model.bmv2_json import Json, document, hexadecimal, limited, once, whole
from dataplane.v1model.program_check import check
from dataplane.v1model.program_parts import MAX_WIDTH, PartReader
from dataplane.v1model.tree import (
    ActionSpec,
    ArraySpec,
    DigestSpec,
    Expression,
    FieldRef,
    KeySpec,
    MatchKind,
    ParamSpec,
    Program,
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

HASHES = frozenset({"crc32", "crc32_custom", "crc16", "crc16_custom", "csum16", "cksum16", "identity"})
HASHES |= {"xor16", "xor32", "crcCCITT"}

MAX_CELLS = 1 << 32
"""Of one array; program_check.py limits what all of them take."""
MAX_ENTRIES = 1 << 24
"""Largest size of a table."""
_MAX_STATES = 1024
_MAX_NODES = 4096
_MAX_PARSED = 1 << 16
_MAX_ID = (1 << 31) - 1
_REFUSED = ("parse_vsets", "header_unions", "header_union_stacks", "extern_instances")


def load(data: bytes | str) -> Program:
    """Read BMv2 JSON.

    Raises ProgramError where it is not such JSON, Unsupported where it uses what this target lacks (the
    text names the primitive or construct and where it stands).
    """
    reader = _Reader(document(data))
    try:
        program = reader.program()
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ProgramError(f"malformed BMv2 JSON at {reader.place}: {error!r:.200}") from error
    check(program)
    return program


class _Reader(PartReader):
    """The whole program."""

    # -- whole program ------------------------------------------------------------------------------

    def program(self) -> Program:
        for name in _REFUSED:
            if self.doc.get(name):
                self.refuse(f"{name.removesuffix('s').replace('_', ' ')} {self.doc[name][0].get('name', '')}")
        self.read_headers()
        digests = {self.number(d): self.digest(d) for d in self.each("learn_lists", "id")}
        field_lists = {self.number(f): self.field_list(f) for f in self.each("field_lists", "id")}
        registers = {r["name"]: self.register(r) for r in self.each("register_arrays", "name")}
        counters = {c["name"]: self.counter(c) for c in self.each("counter_arrays", "name")}
        meters = {m["name"]: self.meter(m) for m in self.each("meter_arrays", "name")}
        calculations = {c["name"]: self.calculation(c) for c in self.each("calculations", "name")}
        actions = tuple(self.action(i, a) for i, a in enumerate(self.each("actions", "id")))
        self.action_numbers = {a["id"]: i for i, a in enumerate(self.doc["actions"])}
        self.actions = actions
        self.tables: dict[str, TableSpec] = {}
        pipelines = {p["name"]: self.pipeline(p) for p in self.each("pipelines", "name")}
        deparser = self.doc["deparsers"][0]
        if deparser.get("primitives"):
            with self.at("deparser"):
                self.refuse(f"primitive {deparser['primitives'][0].get('op')}")
        return Program(
            name=str(self.doc.get("program", "")),
            headers=self.headers,
            stacks=self.stacks,
            errors={e[0]: whole(e[1], 0, _MAX_ID, "an error's number") for e in self.doc.get("errors", [])},
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

    def each(self, part: str, by: str) -> list[Json]:
        return once(self.doc.get(part, []), by, part)

    @staticmethod
    def number(data: Json) -> int:
        """Digests and field lists are known by their ids in the generated code."""
        return whole(data["id"], 1, _MAX_ID, "an id")

    # -- parser -------------------------------------------------------------------------------------

    def parser(self, data: Json) -> tree.Parser:
        states = {}
        for state in once(limited(data["parse_states"], _MAX_STATES, "parser states"), "name", "states"):
            with self.at(f"parser state {state['name']}"):
                states[state["name"]] = self.state(state)
        return tree.Parser(data["init_state"], states)

    def state(self, data: Json) -> tree.ParserState:
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
        return tree.ParserState(data["name"], tuple(ops), keys, widths, tuple(cases), default)

    @staticmethod
    def key_width(key: Expression) -> int:
        if isinstance(key, FieldRef | tree.StackLast):
            return key.field.width
        return key.width if isinstance(key, tree.Lookahead) else 1

    @staticmethod
    def case(data: Json, widths: tuple[int, ...]) -> tree.Case:
        """Values and masks are concatenations of the keys, each padded to whole bytes."""
        value = hexadecimal(data["value"])
        mask = -1 if data["mask"] is None else hexadecimal(data["mask"])
        parts: list[tuple[int, int]] = []
        for width in reversed(widths):
            full = (1 << width) - 1
            m = mask & full
            parts.append((value & m, m))
            value >>= (width + 7) // 8 * 8
            mask >>= (width + 7) // 8 * 8
        return tree.Case(tuple(reversed(parts)), data["next_state"])

    def parser_op(self, data: Json) -> list[tree.ParserOp]:
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
                return [tree.Advance(tree.Const(8 * whole(p[0], 0, _MAX_PARSED, "a shift in bytes")))]
            return self.refuse(f"parser operation {op}")

    def extract(self, p: list[Json]) -> tree.Extract:
        kind, name = p[0]["type"], p[0]["value"]
        bits = self.expression(p[1]) if len(p) > 1 else None
        if bits is not None and not (kind == "regular" and self.headers[name].type.max_bytes):
            self.refuse(f"extraction of a length into {kind} {name}, which has no varbit field,")
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

    def pipeline(self, data: Json) -> tree.Pipeline:
        nodes: dict[str, tree.Node] = {}
        with self.at(f"{data['name']} pipeline"):
            if data.get("action_profiles"):
                self.refuse(f"action profile {data['action_profiles'][0]['name']}")
            limited([*data["tables"], *data["conditionals"]], _MAX_NODES, "tables and conditions")
            for table in data["tables"]:
                self.new(table["name"], nodes)
                with self.at(f"table {table['name']}"):
                    nodes[table["name"]] = self.table(table)
            for condition in data["conditionals"]:
                self.new(condition["name"], nodes)
                with self.at(f"condition {condition['name']}"):
                    nodes[condition["name"]] = tree.ConditionNode(
                        condition["name"],
                        self.expression(condition["expression"]),
                        condition.get("true_next"),
                        condition.get("false_next"),
                    )
            for call in data.get("action_calls", []):
                number = self.action_numbers[call["action_id"]]
                self.new(call["name"], nodes)
                nodes[call["name"]] = self.call(call["name"], number, call["next_node"])
        return tree.Pipeline(data["name"], data["init_table"], nodes)

    def new(self, name: str, nodes: dict[str, tree.Node]) -> None:
        if name in nodes or name in self.tables:
            raise ProgramError(f"two tables or conditions are called {name:.60} at {self.place}")

    @staticmethod
    def call(name: str, action: int, following: str | None) -> tree.TableNode:
        return tree.TableNode(
            name, (), (), (action,), {action: following}, False, None, following, hidden_action=action
        )

    def table(self, data: Json) -> tree.TableNode:
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
            size=whole(data["max_size"], 0, MAX_ENTRIES, "max_size"),
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

    def hidden_action(self, table: str, default: Json | None) -> int | None:
        """The action of a table that p4c made around a statement; p4info does not know it."""
        if default is None:
            return None
        number = self.action_numbers[default["action_id"]]
        return number if table.startswith("tbl_") and not self.actions[number].spec.params else None

    def default(self, data: Json | None) -> tuple[str, tuple[int, ...]] | None:
        if data is None:
            return None
        action = self.actions[self.action_numbers[data["action_id"]]]
        return action.spec.name, tuple(hexadecimal(v) for v in data["action_data"])

    def key(self, data: Json) -> tuple[KeySpec, Expression, int]:
        try:
            kind = MatchKind(data["match_type"])
        except ValueError:
            self.refuse(f"match kind {data['match_type']}")
        target = self.field_or_valid(data["target"])
        width = target.field.width if isinstance(target, FieldRef) else 1
        full = (1 << width) - 1
        mask = full if data.get("mask") is None else hexadecimal(data["mask"]) & full
        name = data.get("name") or ".".join(data["target"])
        return KeySpec(name, kind, width), target, mask

    def const_entry(self, data: Json, keys: tuple[tuple[KeySpec, Expression, int], ...]) -> tree.ConstEntry:
        parts = []
        for item, (spec, _, _) in zip(data["match_key"], keys, strict=True):
            parts.append(self.const_key(item, spec))
        action = self.actions[self.action_numbers[data["action_entry"]["action_id"]]]
        params = tuple(hexadecimal(v) for v in data["action_entry"]["action_data"])
        # BMv2's smallest number wins, P4Runtime's largest
        return tree.ConstEntry(
            tuple(parts),
            (1 << 24) - whole(data.get("priority", 0), 0, (1 << 24) - 1, "priority"),
            action.spec.name,
            params,
        )

    @staticmethod
    def const_key(item: Json, spec: KeySpec) -> tuple[MatchKind, int, int]:
        if spec.kind is MatchKind.RANGE:
            return spec.kind, hexadecimal(item["start"]), hexadecimal(item["end"])
        value = hexadecimal(item["key"])
        if spec.kind is MatchKind.LPM:
            return spec.kind, value, whole(item["prefix_length"], 0, spec.width, "prefix_length")
        if spec.kind in (MatchKind.TERNARY, MatchKind.OPTIONAL):
            return spec.kind, value, hexadecimal(item["mask"])
        return spec.kind, value, 0

    # -- externs ------------------------------------------------------------------------------------

    def register(self, data: Json) -> ArraySpec:
        with self.at(f"register {data['name']}"):
            if data["bitwidth"] > MAX_WIDTH:
                self.refuse(f"width of {data['bitwidth']} bits (at most {MAX_WIDTH})")
            width = whole(data["bitwidth"], 1, MAX_WIDTH, "bitwidth")
            return ArraySpec(data["name"], whole(data["size"], 0, MAX_CELLS, "size"), width)

    @staticmethod
    def counter(data: Json) -> ArraySpec:
        table = data["binding"] if data["is_direct"] else ""
        size = whole(data.get("size", 0), 0, MAX_CELLS, "size of a counter array")
        return ArraySpec(data["name"], size, unit="both", table=table)

    def meter(self, data: Json) -> ArraySpec:
        with self.at(f"meter {data['name']}"):
            if data["rate_count"] != 2:
                self.refuse(f"a meter of {data['rate_count']} rates (two)")
            table = data["binding"] if data["is_direct"] else ""
            target = self.field(data["result_target"]) if data["is_direct"] else None
            size = whole(data["size"], 0, MAX_CELLS, "size")
            return ArraySpec(data["name"], size, unit=data["type"], table=table, target=target)

    def digest(self, data: Json) -> DigestSpec:
        with self.at(f"digest {data['name']}"):
            fields = tuple(self.expression(e) for e in data["elements"])
            return DigestSpec(data["name"], fields, tuple(self.key_width(f) for f in fields))

    def field_list(self, data: Json) -> tuple[FieldRef, ...]:
        with self.at(f"field list {data['name']}"):
            return tuple(self.target(e) for e in data["elements"])

    def calculation(self, data: Json) -> tree.Calculation:
        inputs: list[tuple[Expression, int]] = []
        payload = False
        with self.at(f"calculation {data['name']}"):
            if data["algo"] not in HASHES:
                self.refuse(f"hash algorithm {data['algo']}")
            for item in data["input"]:
                if item["type"] == "payload":
                    payload = True
                elif item["type"] == "hexstr":
                    width = whole(item["bitwidth"], 1, MAX_WIDTH, "bitwidth")
                    inputs.append((tree.Const(hexadecimal(item["value"]) % (1 << width)), width))
                elif item["type"] == "field":
                    ref = self.field(item["value"])
                    inputs.append((ref, ref.field.width))
                else:
                    self.refuse(f"input of type {item['type']}")
        return tree.Calculation(data["name"], data["algo"], tuple(inputs), payload)

    def checksum(self, data: Json) -> tree.Checksum:
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
