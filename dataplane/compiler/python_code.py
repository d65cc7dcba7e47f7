"""Generated Python: a module of straight-line functions over one list per packet.

    parse(p)      p[PACKET] -> headers, returns the parser's error code
    ingress(p), egress(p)
    deparse(p)    checksums, then the frame's bytes

The list `p` holds every kept field, validity bits, the bytes of extracted headers and the engine's
registers; `SLOTS` says where.  Names beginning with T, C, M, R are tables, counters, meters, registers.
"""

from collections.abc import Sequence

from dataplane import tree
from dataplane.compiler.control import Generator, may_exit, state_order
from dataplane.compiler.layout import Layout
from dataplane.compiler.simplify import bounds, field_bounds, simplify
from dataplane.errors import Unsupported
from dataplane.tree import Binary, Const, Expression, FieldRef, Program, Statement

ENGINE = (
    "PACKET", "OFFSET", "LENGTH", "ARRIVED", "TRUNCATE", "CLONE", "CLONE_LIST", "DIGEST", "RESUBMIT",
    "RECIRCULATE", "EXIT", "NOW",
)  # fmt: skip
"""Slots of the engine: frame, bytes parsed, packet_length register, bytes on arrival, …, time in µs."""
NO_TRUNCATION = 1 << 30
_MAX_STATES = 4096


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


class PythonGenerator(Generator):
    hit_test = "h"
    action_test = "a == {}"
    either = " or "

    def __init__(self, program: Program, layout: Layout) -> None:
        super().__init__(program, layout)
        self.slots = Slots(program, layout)
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

    def nothing(self) -> None:
        self.line("pass")

    def leave_on_exit(self) -> None:
        self.line(f"if {self.reg('EXIT')}: return")

    def reg(self, name: str) -> str:
        return f"p[{self.slots.engine(name)}]"

    # -- expressions --------------------------------------------------------------------------------

    def expression(self, e: Expression) -> str:
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
            case tree.Unary(op, operand):
                return f"({'~' if op == '~' else 'not '}{self.expression(operand)})"
            case tree.Conditional(condition, yes, no):
                test = self.expression(condition)
                return f"({self.expression(yes)} if {test} else {self.expression(no)})"
            case Binary(op, left, right):
                return self.binary(op, left, right)
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

    def do_count(self, s: tree.Count) -> None:
        self.line(f"{self.number('C', s.array)}.count({self.value(s.index)}, {self.reg('ARRIVED')})")

    def do_executemeter(self, s: tree.ExecuteMeter) -> None:
        self.line(f"i = {self.value(s.index)}")
        self.branch("if", f"i < {self.program.meters[s.array].size}")
        meter = f"{self.number('M', s.array)}[i].execute({self.reg('ARRIVED')}, {self.reg('NOW')})"
        self.line(f"p[{self.slots.field(s.target)}] = {meter}")
        self.close()

    def do_registerread(self, s: tree.RegisterRead) -> None:
        spec = self.program.registers[s.array]
        self.line(f"i = {self.value(s.index)}")
        self.branch("if", f"i < {spec.size}")
        value = f"{self.number('R', s.array)}[i]"
        if s.target.field.signed:
            value = f"two_comp_mod({value}, {s.target.field.width})"
        elif spec.width > s.target.field.width:
            value += f" & {field_bounds(s.target.field).high}"
        self.line(f"p[{self.slots.field(s.target)}] = {value}")
        self.close()

    def do_registerwrite(self, s: tree.RegisterWrite) -> None:
        spec = self.program.registers[s.array]
        self.line(f"i = {self.value(s.index)}")
        self.branch("if", f"i < {spec.size}")
        stored = self.fitted(s.value, tree.FieldType("", spec.width, 0))
        self.line(f"{self.number('R', s.array)}[i] = {stored}")
        self.close()

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

    # -- functions ----------------------------------------------------------------------------------

    def module(self) -> str:
        """The text of the whole module."""
        with self.block("def parse(p)"):
            self.parser()
        for pipeline in (self.program.ingress, self.program.egress):
            with self.block(f"def {pipeline.name}(p)"):
                self.pipeline(pipeline)
        with self.block("def deparse(p)"):
            self.deparser()
        with self.block("def digest(p)"):
            self.digests()
        return "\n".join(self.lines) + "\n"

    def parser(self) -> None:
        names = state_order(self.program.parser)
        self.states = {name: i for i, name in enumerate(names)}
        self.line(f"k = {self.reg('PACKET')}; z = len(k); o = 0; s = 0; error = 0; turns = 0")
        self.open("while s >= 0")
        self.line("turns += 1")
        self.line(f"if turns > {_MAX_STATES}: error = {self.error('ParserTimeout')}; break")
        for name in names:
            self.state(self.program.parser.states[name])
        self.close()
        self.line(f"{self.reg('OFFSET')} = o")
        ref = self.layout.standard("parser_error")
        if ref is not None:
            self.line(f"p[{self.slots.field(ref)}] = error")
        self.verify_checksums()
        self.line("return error")

    def error(self, name: str) -> int:
        return self.program.errors.get(name, 1)

    def fail(self, condition: str, name: str) -> None:
        self.line(f"if {condition}: error = {self.error(name)}; break")

    def state(self, state: tree.State) -> None:
        self.branch("if", f"s == {self.states[state.name]}")
        for op in state.ops:
            if isinstance(op, tree.Extract):
                self.extract(op)
            elif isinstance(op, tree.Advance):
                self.advance(op)
            elif isinstance(op, tree.Verify):
                test = self.value(op.condition)
                self.line(f"if not {test}: error = {self.value(op.error)}; break")
            else:
                self.run((op,))
        self.select(state)
        self.close()

    def select(self, state: tree.State) -> None:
        for i, key in enumerate(state.keys):
            if isinstance(key, tree.Lookahead):
                self.fail(f"8 * (z - o) < {key.offset + key.width}", "PacketTooShort")
            text = self.expression(key)
            width = state.key_widths[i]
            signed = isinstance(key, FieldRef | tree.StackLast) and key.field.signed
            self.line(f"k{i} = {text} & {(1 << width) - 1}" if signed else f"k{i} = {text}")
        head = "if"
        for case in state.cases:
            tests = [self.case_test(i, case, w) for i, w in enumerate(state.key_widths)]
            self.branch(head, " and ".join(t for t in tests if t) or "True")
            self.line(f"s = {self.goto(case.next)}")
            head = "elif"
        if head == "elif":
            self.branch("else", "")
        self.line(f"s = {self.goto(state.default)}")
        if head == "elif":
            self.close()

    @staticmethod
    def case_test(index: int, case: tree.Case, width: int) -> str:
        value, mask = case.matches[index]
        if mask == (1 << width) - 1:
            return f"k{index} == {value}"
        return f"k{index} & {mask} == {value}" if mask else ""

    def goto(self, name: str | None) -> int:
        return -1 if name is None else self.states[name]

    def advance(self, op: tree.Advance) -> None:
        self.line(f"v = {self.value(op.bits)}")
        self.fail("v & 7", "ParserInvalidArgument")
        self.fail("z - o < v >> 3", "PacketTooShort")
        self.line("o += v >> 3")

    def extract(self, op: tree.Extract) -> None:
        if not op.stack:
            self.extract_into(op.header, op)
            return
        members = self.program.stacks[op.stack].headers
        following = self.slots.next(op.stack)
        self.fail(f"p[{following}] >= {len(members)}", "StackOutOfBounds")
        head = "if"
        for i, header in enumerate(members):
            self.branch(head, f"p[{following}] == {i}")
            self.extract_into(header, op)
            head = "elif"
        self.close()
        self.line(f"p[{following}] += 1")

    def extract_into(self, header: str, op: tree.Extract) -> None:
        kind = self.program.headers[header].type
        size = kind.width // 8
        if op.varbit_bits is not None:
            self.line(f"v = {self.value(op.varbit_bits)}")
            self.fail("v & 7", "ParserInvalidArgument")
            self.line(f"v = (v >> 3) + {size}")
            self.fail("z - o < v", "PacketTooShort")
            self.fail(f"v > {kind.max_bytes}", "HeaderTooShort")
            self.line("r = k[o:o + v]; o += v")
        else:
            self.fail(f"z - o < {size}", "PacketTooShort")
            self.line(f"r = k[o:o + {size}]; o += {size}")
        self.line(f"p[{self.slots.raw(header)}] = r; p[{self.slots.valid(header)}] = 1")
        fields = self.layout.fields[header]
        if fields:
            self.line(f"v = from_bytes(r[:{size}], 'big')")
        for f in fields:
            shift = kind.width - f.offset - f.width
            text = f"(v >> {shift})" if shift else "v"
            if f.offset:
                text = f"{text} & {(1 << f.width) - 1}"
            if f.signed:
                text = f"two_comp_mod({text}, {f.width})"
            self.line(f"p[{self.slots.field(FieldRef(header, f))}] = {text}")

    # -- leaving ------------------------------------------------------------------------------------

    def verify_checksums(self) -> None:
        flag = self.layout.standard("checksum_error")
        for checksum in self.program.checksums:
            if not checksum.verify or flag is None:
                continue
            calculation = self.program.calculations[checksum.calculation]
            test = f"p[{self.slots.valid(checksum.target.header)}]"
            if checksum.condition is not None:
                test += f" and {self.value(checksum.condition)}"
            self.branch("if", test)
            self.digest_input(calculation)
            target = self.slots.field(checksum.target)
            self.line(f"if hash_{calculation.algorithm}(v) != p[{target}]: p[{self.slots.field(flag)}] = 1")
            self.close()

    def deparser(self) -> None:
        for checksum in self.program.checksums:
            if not checksum.update:
                continue
            calculation = self.program.calculations[checksum.calculation]
            self.branch("if", self.value(checksum.condition) if checksum.condition else "True")
            self.digest_input(calculation)
            value = self.wrapped(f"hash_{calculation.algorithm}(v)", checksum.target.field)
            self.line(f"p[{self.slots.field(checksum.target)}] = {value}")
            self.close()
        self.line("out = []")
        for header in self.program.deparser:
            self.branch("if", f"p[{self.slots.valid(header)}]")
            self.emit(header)
            self.close()
        packet = self.reg("PACKET")
        self.line(f"out.append({packet}[{self.reg('OFFSET')}:])")
        self.line(f"return b''.join(out)[:{self.reg('TRUNCATE')}]")

    def emit(self, header: str) -> None:
        kind, raw = self.program.headers[header].type, f"p[{self.slots.raw(header)}]"
        written = self.layout.written[header]
        if not written:
            self.line(f"out.append({raw})")
            return
        keep = (1 << kind.width) - 1
        parts: list[str] = []
        for f in written:
            shift = kind.width - f.offset - f.width
            keep &= ~(((1 << f.width) - 1) << shift)
            text = f"p[{self.slots.field(FieldRef(header, f))}]"
            if f.signed:
                text = f"({text} & {(1 << f.width) - 1})"
            parts.append(f"({text} << {shift})" if shift else text)
        size = kind.width // 8
        if keep:
            parts.insert(0, f"(from_bytes({raw}[:{size}], 'big') & {keep})")
        self.line(f"out.append(({' | '.join(parts)}).to_bytes({size}, 'big'))")
        if kind.max_bytes:
            self.line(f"out.append({raw}[{size}:])")

    def digests(self) -> None:
        head = "if"
        for number, spec in self.program.digests.items():
            self.branch(head, f"{self.reg('DIGEST')} == {number}")
            values = [
                self.key_unsigned(e, w) for e, w in zip(spec.fields, spec.widths, strict=True)
            ]
            self.line(f"return {spec.name!r}, ({', '.join(values)}{',' if len(values) == 1 else ''})")
            head = "elif"
        if head == "elif":
            self.close()
        self.line("return None")

    def key_unsigned(self, e: Expression, width: int) -> str:
        text = self.value(e)
        signed = isinstance(e, FieldRef) and e.field.signed
        return f"{text} & {(1 << width) - 1}" if signed else text


def generate(program: Program, layout: Layout) -> tuple[str, Slots]:
    """The module's text and where the packet's parts are in its list."""
    if not all(h.type.width % 8 == 0 for h in program.headers.values() if not h.metadata):
        raise Unsupported("a header that is no whole number of bytes")
    generator = PythonGenerator(program, layout)
    return generator.module(), generator.slots


__all__ = ["NO_TRUNCATION", "PythonGenerator", "Slots", "generate", "may_exit"]
