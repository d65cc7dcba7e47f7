"""Statements, tables and hash inputs as Python; the functions around them are python_code's."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from dataplane.compiler.control import Generator
from dataplane.compiler.layout import Layout
from dataplane.compiler.machine import array_names
from dataplane.compiler.simplify import bounds, field_bounds, simplify
from dataplane.v1model import tree
from dataplane.v1model.tree import Binary, Const, Expression, FieldRef, Program, Statement

ENGINE = (
    "PACKET", "OFFSET", "LENGTH", "ARRIVED", "TRUNCATE", "CLONE", "CLONE_LIST", "DIGEST", "RESUBMIT",
    "RECIRCULATE", "EXIT", "NOW",
)  # fmt: skip
"""Slots of the engine: frame, bytes parsed, packet_length register, bytes on arrival, …, time in µs."""
NO_TRUNCATION = 1 << 30


class Slots:
    """Slot numbers of one layout."""

    def __init__(self, program: Program, layout: Layout) -> None:
        names: list[object] = list(ENGINE)
        for header, fields in layout.fields.items():
            names += [(header, f.name) for f in fields]
        for header in layout.packet_headers:
            names += [("valid", header), ("raw", header)]
        names += [("next", stack) for stack in program.stacks]
        self.index = {name: i for i, name in enumerate(names)}
        self.initial: list[object] = [0] * len(names)
        self.initial[self.index["PACKET"]] = b""
        self.initial[self.index["TRUNCATE"]] = NO_TRUNCATION
        for header in layout.packet_headers:
            self.initial[self.raw(header)] = bytes(program.headers[header].type.width // 8)
        self.metadata = [self.index[(h, f.name)] for h in layout.metadata for f in layout.fields[h]]

    def field(self, ref: FieldRef) -> int:
        return self.index[(ref.header, ref.field.name)]

    def valid(self, header: str) -> int:
        return self.index[("valid", header)]

    def raw(self, header: str) -> int:
        return self.index[("raw", header)]

    def next(self, stack: str) -> int:
        return self.index[("next", stack)]

    def engine(self, name: str) -> int:
        return self.index[name]


class PythonStatements(Generator):
    """Names of one program's parts in Python, and what is done with them."""

    hit_test = "h"
    action_test = "a == {}"
    either = " or "

    def __init__(self, program: Program, layout: Layout) -> None:
        super().__init__(program, layout)
        self.slots = Slots(program, layout)
        self.arrays = {name: i for i, name in enumerate(array_names(program))}
        self.numbers = {
            kind: {name: i for i, name in enumerate(names)}
            for kind, names in (
                ("T", program.tables),
                ("C", program.counters),
                ("M", program.meters),
                ("R", program.registers),
            )
        }

    # -- blocks -------------------------------------------------------------------------------------

    def open(self, head: str) -> None:
        self.line(head + ":")
        self.depth += 1

    def close(self) -> None:
        self.depth -= 1

    def branch(self, head: str, condition: str) -> None:
        if head != "if":
            self.close()
        self.open(f"{head} {condition}".rstrip())

    def begin_action(self, number: int) -> None:
        """Nothing to prepare: parameters are d[0], d[1], …"""

    def nothing(self) -> None:
        self.line("pass")

    def leave_on_exit(self) -> None:
        self.line(f"if {self.reg('EXIT')}: return")

    def reg(self, name: str) -> str:
        return f"p[{self.slots.engine(name)}]"

    # -- expressions --------------------------------------------------------------------------------

    def expression(self, e: Expression) -> str:
        match e:
            case tree.Unary(op, operand):
                return f"({'~' if op == '~' else 'not '}{self.expression(operand)})"
            case tree.Conditional(condition, yes, no):
                test = self.expression(condition)
                return f"({self.expression(yes)} if {test} else {self.expression(no)})"
            case Binary(op, left, right):
                return self.binary(op, left, right)
        return self.leaf(e)

    def leaf(self, e: Expression) -> str:
        match e:
            case Const(value):
                return str(value)
            case FieldRef():
                return f"p[{self.slots.field(e)}]"
            case tree.Valid(header):
                return "1" if self.program.headers[header].metadata else f"p[{self.slots.valid(header)}]"
            case tree.Param(index):
                return f"d[{index}]"
            case tree.StackLast(stack, field):
                return self.stack_last(stack, field)
            case tree.StackCount(stack, offset):
                return f"(p[{self.slots.next(stack)}] + {offset})"
            case tree.Lookahead(offset, width):
                return f"look(k, o, {offset}, {width})"
        raise AssertionError(e)

    def binary(self, op: str, left: Expression, right: Expression) -> str:
        a, b = self.expression(left), self.expression(right)
        if op in ("two_comp_mod", "usat_cast", "sat_cast"):
            return f"{op}({a}, {b})"
        if op in ("/", "%"):
            return f"({a} {'//' if op == '/' else op} {b} if {b} else 0)"
        if op == "<<" and bounds(right).high > 512:
            return f"({a} << {b} if {b} < 512 else 0)"
        return f"({a} {op} {b})"

    def stack_last(self, stack: str, field: tree.FieldType) -> str:
        members = self.program.stacks[stack].headers
        slots = [self.slots.field(FieldRef(h, field)) for h in members]
        return f"p[{tuple(slots)}[p[{self.slots.next(stack)}] - 1]]"

    def fitted(self, e: Expression, field: tree.FieldType) -> str:
        """The value as `field` stores it: wrapped, or clamped where the field saturates."""
        e = simplify(e)
        limit, want = bounds(e), field_bounds(field)
        text = self.expression(e)
        if want.low <= limit.low and limit.high <= want.high:
            truth = isinstance(e, Binary | tree.Unary) and limit.high == 1
            return f"+{text}" if truth else text
        if field.saturating:
            return f"{'sat_cast' if field.signed else 'usat_cast'}({text}, {field.width})"
        if field.signed:
            return f"two_comp_mod({text}, {field.width})"
        return f"{text} & {want.high}"

    def store(self, target: FieldRef, value: Expression) -> None:
        self.line(f"p[{self.slots.field(target)}] = {self.fitted(value, target.field)}")

    # -- statements ---------------------------------------------------------------------------------

    def statement(self, s: Statement) -> None:
        getattr(self, "do_" + type(s).__name__.lower())(s)

    def value(self, e: Expression) -> str:
        return self.expression(simplify(e))

    def do_assign(self, s: tree.Assign) -> None:
        self.store(s.target, s.value)

    def do_copyheader(self, s: tree.CopyHeader) -> None:
        source, target = self.slots.valid(s.source), self.slots.valid(s.target)
        self.line(f"p[{target}] = p[{source}]")
        self.branch("if", f"p[{source}]")
        for a, b in zip(self.contents(s.target), self.contents(s.source), strict=True):
            self.line(f"p[{a}] = p[{b}]")
        self.close()

    def contents(self, header: str) -> list[int]:
        fields = [self.slots.field(FieldRef(header, f)) for f in self.layout.fields[header]]
        return [*fields, self.slots.raw(header)]

    def do_addheader(self, s: tree.AddHeader) -> None:
        kind = self.program.headers[s.header].type
        self.branch("if", f"not p[{self.slots.valid(s.header)}]")
        self.line(f"p[{self.slots.valid(s.header)}] = 1")
        for f in self.layout.fields[s.header]:
            self.line(f"p[{self.slots.field(FieldRef(s.header, f))}] = 0")
        self.line(f"p[{self.slots.raw(s.header)}] = {bytes(kind.width // 8)!r}")
        self.line(f"{self.reg('LENGTH')} += {kind.width // 8}")
        self.close()

    def do_removeheader(self, s: tree.RemoveHeader) -> None:
        self.branch("if", f"p[{self.slots.valid(s.header)}]")
        self.line(f"p[{self.slots.valid(s.header)}] = 0")
        self.line(f"{self.reg('LENGTH')} -= len(p[{self.slots.raw(s.header)}])")
        self.close()

    def do_shiftstack(self, s: tree.ShiftStack) -> None:
        members = self.program.stacks[s.stack].headers
        size, by = len(members), s.by
        steps = range(size) if by < 0 else range(size - 1, -1, -1)
        for i in steps:
            if 0 <= i - by < size:
                for a, b in zip(self.contents(members[i]), self.contents(members[i - by]), strict=True):
                    self.line(f"p[{a}] = p[{b}]")
                self.line(f"p[{self.slots.valid(members[i])}] = p[{self.slots.valid(members[i - by])}]")
            else:
                self.line(f"p[{self.slots.valid(members[i])}] = 0")
        following = self.slots.next(s.stack)
        self.line(f"p[{following}] = min(max(p[{following}] + {by}, 0), {size})")

    def do_marktodrop(self, _: tree.MarkToDrop) -> None:
        for name, value in (("egress_spec", 511), ("mcast_grp", 0)):
            ref = self.layout.standard(name)
            if ref is not None:
                self.line(f"p[{self.slots.field(ref)}] = {value}")

    def number(self, kind: str, name: str) -> str:
        return f"{kind}{self.numbers[kind][name]}"

    @contextmanager
    def cell(self, array: tree.ArraySpec, index: Expression) -> Iterator[None]:
        """A block for cell `i` of the array; an index outside the array is counted instead."""
        self.line(f"i = {self.value(index)}")
        self.branch("if", f"0 <= i < {array.size}")
        yield
        self.branch("else", "")
        self.line(f"OUT_OF_RANGE[{self.arrays[array.name]}] += 1")
        self.close()

    def do_count(self, s: tree.Count) -> None:
        with self.cell(self.program.counters[s.array], s.index):
            self.line(f"{self.number('C', s.array)}.count(i, {self.reg('ARRIVED')})")

    def do_executemeter(self, s: tree.ExecuteMeter) -> None:
        with self.cell(self.program.meters[s.array], s.index):
            meter = f"{self.number('M', s.array)}[i].execute({self.reg('ARRIVED')}, {self.reg('NOW')})"
            self.line(f"p[{self.slots.field(s.target)}] = {meter}")

    def do_registerread(self, s: tree.RegisterRead) -> None:
        spec = self.program.registers[s.array]
        value = f"{self.number('R', s.array)}[i]"
        if s.target.field.signed:
            value = f"two_comp_mod({value}, {s.target.field.width})"
        elif spec.width > s.target.field.width:
            value += f" & {field_bounds(s.target.field).high}"
        with self.cell(spec, s.index):
            self.line(f"p[{self.slots.field(s.target)}] = {value}")

    def do_registerwrite(self, s: tree.RegisterWrite) -> None:
        spec = self.program.registers[s.array]
        stored = self.fitted(s.value, tree.FieldType("", spec.width, 0))
        with self.cell(spec, s.index):
            self.line(f"{self.number('R', s.array)}[i] = {stored}")

    def do_hash(self, s: tree.Hash) -> None:
        self.digest_input(self.program.calculations[s.calculation])
        algorithm = self.program.calculations[s.calculation].algorithm
        size, base = simplify(s.size), self.value(s.base)
        modulus = f"({self.expression(size)} or 1)"
        if isinstance(size, Const):
            modulus = str(size.value or 1)
        self.line(f"v = hash_{algorithm}(v) % {modulus} + ({base} & {2**64 - 1})")
        self.line(f"p[{self.slots.field(s.target)}] = {self.wrapped('v', s.target.field)}")

    @staticmethod
    def wrapped(text: str, field: tree.FieldType) -> str:
        if field.signed:
            return f"two_comp_mod({text}, {field.width})"
        return f"{text} & {field_bounds(field).high}"

    def do_random(self, s: tree.Random) -> None:
        low, high = self.value(s.low), self.value(s.high)
        self.branch("if", f"{low} <= {high}")
        self.line(f"v = randint({low}, {high})")
        self.line(f"p[{self.slots.field(s.target)}] = {self.wrapped('v', s.target.field)}")
        self.close()

    def do_clone(self, s: tree.Clone) -> None:
        self.line(f"{self.reg('CLONE')} = ({self.value(s.session)} & 0x7fff) | 0x8000")
        self.line(f"{self.reg('CLONE_LIST')} = {s.field_list}")

    def do_senddigest(self, s: tree.SendDigest) -> None:
        self.line(f"{self.reg('DIGEST')} = {s.digest}")

    def do_resubmit(self, s: tree.Resubmit) -> None:
        self.line(f"{self.reg('RESUBMIT')} = {s.field_list}")

    def do_recirculate(self, s: tree.Recirculate) -> None:
        self.line(f"{self.reg('RECIRCULATE')} = {s.field_list}")

    def do_truncate(self, s: tree.Truncate) -> None:
        self.line(f"{self.reg('TRUNCATE')} = min({self.reg('TRUNCATE')}, {self.value(s.length)})")

    def do_exit(self, _: tree.Exit) -> None:
        self.line(f"{self.reg('EXIT')} = 1")

    # -- tables -------------------------------------------------------------------------------------

    def lookup(self, node: tree.TableNode) -> None:
        table = self.number("T", node.name)
        spec = self.program.tables[node.name]
        if spec.keys:
            self.line(f"e = {table}.find({self.key(node)})")
            self.line("h = e is not None")
            self.branch("if", "h")
            self.line(f"e.packets += 1; e.bytes += {self.reg('ARRIVED')}; e.hit = {self.reg('NOW')}")
            self.direct_meter(node)
            self.branch("else", "")
            self.line(f"e = {table}.default")
            self.close()
        else:
            self.line(f"e = {table}.default; h = False")
        self.line("a = e.action; d = e.params")

    def direct_meter(self, node: tree.TableNode) -> None:
        meter = self.program.meters.get(node.meter)
        if meter is not None and meter.target is not None:
            colour = f"e.meter.execute({self.reg('ARRIVED')}, {self.reg('NOW')})"
            self.line(f"p[{self.slots.field(meter.target)}] = {colour}")

    def key(self, node: tree.TableNode) -> str:
        """All key fields as one integer, the first in the highest bits."""
        parts: list[str] = []
        shift = 0
        specs = self.program.tables[node.name].keys
        for spec, target, mask in reversed(list(zip(specs, node.keys, node.key_masks, strict=True))):
            text = self.key_field(target, spec.width)
            if mask != (1 << spec.width) - 1:
                text = f"({text} & {mask})"
            parts.append(f"({text} << {shift})" if shift else text)
            shift += spec.width
        return " | ".join(reversed(parts))

    def key_field(self, target: Expression, width: int) -> str:
        text = self.expression(target)
        if isinstance(target, FieldRef):
            if target.field.signed:
                text = f"({text} & {(1 << width) - 1})"
            if not self.program.headers[target.header].metadata:
                # BMv2 matches fields of an invalid header as zero
                text = f"({text} if p[{self.slots.valid(target.header)}] else 0)"
        return text

    # -- hash input ---------------------------------------------------------------------------------

    def digest_input(self, calculation: tree.Calculation) -> None:
        """Leave the input's bytes in `v`: bits in order, invalid headers skipped, padded at the end."""
        runs: list[tuple[str, list[tuple[Expression, int]]]] = []
        for item in calculation.inputs:
            owner = item[0].header if isinstance(item[0], FieldRef) else ""
            owner = "" if owner in self.layout.metadata else owner
            if not runs or runs[-1][0] != owner:
                runs.append((owner, []))
            runs[-1][1].append(item)
        if len(runs) == 1 and not runs[0][0]:
            self.line(f"v = {self.concatenated('0', runs[0][1])}; n = {sum(w for _, w in runs[0][1])}")
        else:
            self.line("v = 0; n = 0")
            for owner, items in runs:
                self.digest_run(owner, items)
        self.line("v = (v << (-n % 8)).to_bytes((n + 7) // 8, 'big')")
        if calculation.with_payload:
            self.line(f"v += {self.reg('PACKET')}[{self.reg('OFFSET')}:{self.reg('TRUNCATE')}]")

    def digest_run(self, owner: str, items: Sequence[tuple[Expression, int]]) -> None:
        if owner:
            self.branch("if", f"p[{self.slots.valid(owner)}]")
        fixed = [(e, w) for e, w in items if w]
        if fixed:
            self.line(f"v = {self.concatenated('v', fixed)}; n += {sum(w for _, w in fixed)}")
        if len(fixed) < len(items):
            width = self.program.headers[owner].type.width
            self.line(f"r = p[{self.slots.raw(owner)}][{width // 8}:]; n += 8 * len(r)")
            self.line("v = (v << 8 * len(r)) | int.from_bytes(r, 'big')")
        if owner:
            self.close()

    def concatenated(self, start: str, items: Sequence[tuple[Expression, int]]) -> str:
        total = sum(w for _, w in items)
        parts = [] if start == "0" else [f"({start} << {total})"]
        for e, width in items:
            total -= width
            text = self.value(e)
            if isinstance(e, FieldRef) and e.field.signed:
                text = f"({text} & {(1 << width) - 1})"
            parts.append(f"({text} << {total})" if total else text)
        return " | ".join(parts) or "0"
