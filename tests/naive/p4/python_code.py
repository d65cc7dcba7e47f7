"""Generated Python: a module of straight-line functions over one list per packet.

    parse(p)      p[PACKET] -> headers, returns the parser's error code
    ingress(p), egress(p)
    deparse(p)    checksums, then the frame's bytes

The list `p` holds every kept field, validity bits, the bytes of extracted headers and the engine's
registers; `SLOTS` says where.  Names of T, C, M, R and a number are
tables, counters, meters, registers; D and a number is the name of a digest.  Nothing that a program calls its parts
gets into the text.
"""

from dataplane.compiler.control import state_order
from dataplane.compiler.layout import Layout
from dataplane.errors import Unsupported
from dataplane.v1model import tree
from dataplane.v1model.tree import Expression, FieldRef, Program
from tests.naive.p4.python_statements import PythonStatements, Slots

_MAX_STATES = 4096


class PythonGenerator(PythonStatements):
    """The functions of one program."""

    # -- functions ----------------------------------------------------------------------------------

    def module(self) -> str:
        """The text of the whole module."""
        with self.block("def parse(p)"):
            self.parser()
        for name, pipeline in (("ingress", self.program.ingress), ("egress", self.program.egress)):
            with self.block(f"def {name}(p)"):
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

    def state(self, state: tree.ParserState) -> None:
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

    def select(self, state: tree.ParserState) -> None:
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
            values = [self.key_unsigned(e, w) for e, w in zip(spec.fields, spec.widths, strict=True)]
            members = "".join(f"{value}, " for value in values)
            self.line(f"return Digest(D{number}, sample(({members})))")
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
        raise Unsupported("a header that is not a whole number of bytes")
    generator = PythonGenerator(program, layout)
    return generator.module(), generator.slots
