"""Generated C: one unit of runtime_types.h, runtime_tables.h, the program's state and functions, runtime_engine.h.

    parse(m, p)    p->pkt -> headers, returns the parser's error code
    ingress(m, p), egress(m, p)
    deparse(m, p, out)    checksums, then the frame's bytes

`phv` is one packet: the kept fields, validity, pointers to the bytes of extracted headers, which headers the
program may have changed, and the engine's registers.  Metadata of ingress or egress alone are variables of its
function.  `machine` is the switch: tables, counters, meters, registers.
"""

from importlib.resources import files

from dataplane.compiler.c_expressions import CTYPE, convert, kind_of, literal
from dataplane.compiler.c_statements import ALIGNED, CStatements, key_places, storage, table_words, words
from dataplane.compiler.control import state_order
from dataplane.compiler.layout import ENGINE_FIELDS, STANDARD, Layout
from dataplane.compiler.simplify import simplify
from dataplane.errors import Unsupported
from dataplane.v1model import tree
from dataplane.v1model.tree import Expression, FieldRef, Program

_MAX_STATES = 4096
_MEMBER_HEAD = 4
"""Bytes in front of each member of a digest."""


class CGenerator(CStatements):
    """The functions of one program."""

    # -- parser -------------------------------------------------------------------------------------

    def parser(self) -> None:
        names = state_order(self.program.parser)
        self.labels = {name: f"S{i}" for i, name in enumerate(names)}
        self.line("const u8 *k = p->pkt; u32 z = p->size, o = 0, turns = 0; int error = 0; u64 i; (void)i;")
        self.line(f"goto {self.labels[self.program.parser.start]};")
        for name in names:
            self.state(self.program.parser.states[name])
        self.line("done:")
        self.line("p->offset = o;")
        ref = self.layout.standard("parser_error")
        if ref is not None:
            self.line(f"{self.field(ref)} = ({storage(ref.field)})error;")
        self.verify_checksums()
        self.line("return error;")

    def fail(self, condition: str, name: str) -> None:
        code = self.program.errors.get(name, 1)
        self.line(f"if ({condition}) {{ error = {code}; goto done; }}")

    def state(self, state: tree.ParserState) -> None:
        self.line(f"{self.labels[state.name]}: ;")
        self.fail(f"++turns > {_MAX_STATES}", "ParserTimeout")
        with self.block(""):
            for op in state.ops:
                if isinstance(op, tree.Extract):
                    self.extract(op)
                elif isinstance(op, tree.Advance):
                    self.advance(op)
                elif isinstance(op, tree.Verify):
                    code = self.e.at(simplify(op.error), 64)
                    test = self.e.test(simplify(op.condition))
                    self.line(f"if (!{test}) {{ error = (int){code}; goto done; }}")
                elif isinstance(op, tree.Assign) and isinstance(op.value, tree.Lookahead):
                    self.lookahead(op.value)
                    self.statement(op)
                else:
                    self.run((op,))
            self.select(state)

    def lookahead(self, e: tree.Lookahead) -> None:
        self.fail(f"8ull * (z - o) < {e.offset + e.width}", "PacketTooShort")

    def select(self, state: tree.ParserState) -> None:
        for n, key in enumerate(state.keys):
            if isinstance(key, tree.Lookahead):
                self.lookahead(key)
            width = state.key_widths[n]
            kind = kind_of(width)
            if kind > 128:
                raise Unsupported(
                    f"a select on {width} bits is not supported by the embedded switch (at most 128; "
                    f"in parser state {state.name})"
                )
            text, own = self.leaf(key)
            cut = self.e.cut(convert(text, own, kind, signed=False), kind, width)
            self.line(f"{CTYPE[kind]} k{n} = {cut};")
        for case in state.cases:
            tests = [
                f"(k{n} & {literal(mask, kind_of(w))}) == {literal(value, kind_of(w))}"
                for n, ((value, mask), w) in enumerate(zip(case.matches, state.key_widths, strict=True))
                if mask
            ]
            self.line(f"if ({' && '.join(tests) or '1'}) goto {self.goto(case.next)};")
        self.line(f"goto {self.goto(state.default)};")

    def goto(self, name: str | None) -> str:
        return "done" if name is None else self.labels[name]

    def advance(self, op: tree.Advance) -> None:
        self.line(f"i = {self.value64(op.bits)};")
        self.fail("i & 7", "ParserInvalidArgument")
        self.fail("z - o < i >> 3", "PacketTooShort")
        self.line("o += (u32)(i >> 3);")
        self.moved()

    def extract(self, op: tree.Extract) -> None:
        if op in self.layout.out_of_order:
            self.moved()
        if not op.stack:
            self.extract_into(op.header, op)
            return
        members = self.program.stacks[op.stack].headers
        count = self.next(op.stack)
        self.fail(f"{count} >= {len(members)}", "StackOutOfBounds")
        head = "if"
        for n, header in enumerate(members):
            self.branch(head, f"{count} == {n}")
            self.extract_into(header, op)
            head = "elif"
        self.close()
        self.line(f"{count}++;")

    def extract_into(self, header: str, op: tree.Extract) -> None:
        kind = self.program.headers[header].type
        size = str(kind.width // 8)
        if op.varbit_bits is not None:
            self.line(f"i = {self.value64(op.varbit_bits)};")
            self.fail("i & 7", "ParserInvalidArgument")
            self.line(f"i = (i >> 3) + {size};")
            self.fail("z - o < i", "PacketTooShort")
            self.fail(f"i > {kind.max_bytes}", "HeaderTooShort")
            self.line(f"{self.size(header)} = (u32)i;")
            size = self.size(header)
        else:
            self.fail(f"z - o < {size}", "PacketTooShort")
        self.line(f"{self.raw(header)} = k + o; {self.valid(header)} = 1; o += {size};")
        for f in self.layout.fields[header]:
            self.extract_field(header, f)

    def extract_field(self, header: str, f: tree.FieldType) -> None:
        raw, kind = self.raw(header), kind_of(f.width)
        first, last = f.offset // 8, (f.offset + f.width + 7) // 8
        span = last - first
        shift = 8 * last - f.offset - f.width
        if span <= 8 or (span == 16 and f.width == 128):
            text = f"be{span}({raw} + {first})"
            if shift:
                text = f"({text} >> {shift})"
            if span * 8 - shift > f.width:
                text = f"({text} & {literal((1 << f.width) - 1, kind)})"
        else:
            text = f"bits_get{kind}({raw}, {f.offset}, {f.width})"
        if f.signed:
            text = self.e.wrapped(text, kind, f.width)
        self.load(FieldRef(header, f), text)

    # -- leaving ------------------------------------------------------------------------------------

    def verify_checksums(self) -> None:
        flag = self.layout.standard("checksum_error")
        for checksum in self.program.checksums:
            if not checksum.verify or flag is None:
                continue
            calculation = self.program.calculations[checksum.calculation]
            test = self.valid(checksum.target.header)
            if checksum.condition is not None:
                test += f" && {self.e.test(simplify(checksum.condition))}"
            with self.block(f"if ({test})"):
                self.digest_input(calculation)
                value = self.e.at(checksum.target, 64)
                self.line(f"if (hash_{calculation.algorithm}(b, n) != {value}) {self.field(flag)} = 1;")

    def deparser(self) -> None:
        for checksum in self.program.checksums:
            if not checksum.update:
                continue
            calculation = self.program.calculations[checksum.calculation]
            test = self.e.test(simplify(checksum.condition)) if checksum.condition else "1"
            with self.block(f"if ({test})"):
                self.digest_input(calculation)
                self.assign64(checksum.target, f"hash_{calculation.algorithm}(b, n)")
        with self.block("if (!p->changed)"):
            self.line("memcpy(out, p->pkt, p->size);")
            self.line("return p->size < p->truncate ? p->size : p->truncate;")
        self.line("u8 *o = out;")
        for header in self.program.deparser:
            with self.block(f"if ({self.valid(header)})"):
                self.emit(header)
        self.line("memcpy(o, p->pkt + p->offset, p->size - p->offset);")
        self.line("u32 size = (u32)(o - out) + p->size - p->offset;")
        self.line("return size < p->truncate ? size : p->truncate;")

    def emit(self, header: str) -> None:
        size = self.size(header)
        self.line(f"memcpy(o, {self.raw(header)}, {size});")
        if self.layout.written[header]:
            with self.block(f"if (p->changed & {self.change(header)})"):
                self.lay_over(header)
        self.line(f"o += {size};")

    def lay_over(self, header: str) -> None:
        """The fields that may have changed over the header's bytes, neighbours together where they fill bytes."""
        run: list[tree.FieldType] = []
        for f in self.layout.written[header]:
            if run and (
                run[-1].offset + run[-1].width != f.offset or f.offset + f.width - run[0].offset > 64
            ):
                self.lay_run(header, run)
                run = []
            run.append(f)
            if (f.offset + f.width) % 8 == 0:
                self.lay_run(header, run)
                run = []
        self.lay_run(header, run)

    def lay_run(self, header: str, run: list[tree.FieldType]) -> None:
        width = sum(f.width for f in run)
        if len(run) > 1 and run[0].offset % 8 == 0 and width in ALIGNED:
            shifts = [width - (f.offset - run[0].offset) - f.width for f in run]
            parts = [f"({self.bits(header, f)} << {shift})" for f, shift in zip(run, shifts, strict=True)]
            self.line(self.put(f"o + {run[0].offset // 8}", width, " | ".join(parts)))
            return
        for f in run:
            self.lay_field(header, f)

    def bits(self, header: str, f: tree.FieldType) -> str:
        """A field of at most 64 bits, without its sign."""
        text, own = self.leaf(FieldRef(header, f))
        return self.e.cut(convert(text, own, 64, signed=False), 64, f.width)

    def lay_field(self, header: str, f: tree.FieldType) -> None:
        kind = kind_of(f.width)
        text, own = self.leaf(FieldRef(header, f))
        text = convert(text, own, kind, signed=False)
        if f.offset % 8 == 0 and f.width in ALIGNED:
            self.line(self.put(f"o + {f.offset // 8}", f.width, text))
        elif f.offset % 8 == 0 and f.width % 64 == 0 and kind > 128:
            for n in range(f.width // 64):
                self.line(f"put8(o + {(f.offset + f.width) // 8 - 8 * (n + 1)}, ({text}).w[{n}]);")
        else:
            self.line(f"bits_put{kind}(o, {f.offset}, {f.width}, {text});")

    def digests(self) -> None:
        for number, spec in self.program.digests.items():
            most = sum(_MEMBER_HEAD + max(1, (width + 7) // 8) for width in spec.widths)
            head = sample_head(most)
            with self.block(f"if (p->digest == {number})"):
                self.line(f"u8 *o = sample_begin(m, {most}, {head}), *to = o;")
                for e, width in zip(spec.fields, spec.widths, strict=True):
                    self.member(e, width)
                self.line(f"sample_end(m, {number}, o, to, {head});")

    def member(self, e: Expression, width: int) -> None:
        kind = kind_of(width)
        text = self.e.at(simplify(e), kind)
        if isinstance(e, FieldRef) and e.field.signed:
            text = self.e.cut(text, kind, width)
        if kind == 64:
            self.line(f"to = member64(to, {text});")
        elif kind == 128:
            self.line(
                f"{{ u128 x = {text}; u64 w[] = {{(u64)x, (u64)(x >> 64)}}; to = member_wide(to, w, 2); }}"
            )
        else:
            self.line(f"{{ {CTYPE[kind]} x = {text}; to = member_wide(to, x.w, {words(width)}); }}")


def sample_head(most: int) -> int:
    """Bytes in front of the members of a digest, which have at most `most` bytes: two tags, each with a length."""
    inner = _varint_bytes(most)
    return 1 + _varint_bytes(1 + inner + most) + 1 + inner


def _varint_bytes(value: int) -> int:
    return max(1, (value.bit_length() + 6) // 7)


def _structures(g: CGenerator) -> list[str]:
    program, layout = g.program, g.layout
    deparsed = [program.headers[h].type for h in program.deparser]
    widest = max((program.headers[h].type.width // 8 for h in layout.packet_headers), default=0)
    lines = [
        f"#define N_TABLES {len(program.tables)}",
        f"#define N_COUNTERS {len(program.counters)}",
        f"#define N_METERS {len(program.meters)}",
        f"#define N_REGISTERS {len(program.registers)}",
        f"#define DEPARSED_MOST {sum(t.max_bytes or t.width // 8 for t in deparsed)}",
        f"static const u8 zeros[{widest + 8}];",
        *_packet(g),
        "typedef struct job job;",
        "typedef struct { u32 port, instance; } replica;",
        "typedef struct { u32 count, length; replica to[]; } replicas;",
        "typedef struct {",
        "table t[N_TABLES + 1]; u64 *c[N_COUNTERS + 1]; meter *mt[N_METERS + 1];",
        "u64 *reg[N_REGISTERS + 1], cells[N_REGISTERS + 1]; replicas **sessions, **groups; u8 ports[512]; u32 cpu_port;",
        "u64 stats[6], out_used, out_room, marks_used, marks_room, seed, *marks; u8 *out; u8 verdict; int budget; job *head, **tail;",
        "u64 out_of_range[N_COUNTERS + N_METERS + N_REGISTERS + 1];",
        "} machine;",
        "PLAIN u8 *sample_begin(machine *m, u32 most, u32 head);",
        "PLAIN void sample_end(machine *m, u32 id, u8 *members, u8 *end, u32 head);",
        "#define STD(p, name) (p)->STD_##name",
    ]
    for name in ENGINE_FIELDS:
        ref = layout.standard(name)
        if ref is not None:
            lines += [f"#define HAS_{name} 1", f"#define STD_{name} {g.names[STANDARD, name]}"]
    return lines


def _packet(g: CGenerator) -> list[str]:
    """The type of one packet's state; metadata stand together so that they can be zeroed."""
    layout = g.layout
    lines = [
        "typedef struct {",
        "const u8 *pkt; u64 now, changed;",
        "u32 size, offset, length, arrived, truncate;",
    ]
    lines += ["u32 clone, clone_list, digest, resubmit, recirculate, exit;", "struct {"]
    for header in layout.metadata:
        for f in layout.fields[header]:
            if (header, f.name) not in g.locals:
                lines.append(f"{storage(f)} {g.names[header, f.name].removeprefix('m.')};")
    lines.append("} m;")
    for header in layout.packet_headers:
        number = g.numbers[header]
        lines.append(f"const u8 *r{number}; u32 l{number}; u8 v{number};")
        lines += [f"{storage(f)} {g.names[header, f.name]};" for f in layout.fields[header]]
    return [*lines, *[f"u32 n{i};" for i in g.index["s"].values()], "} phv;"]


def _start(g: CGenerator) -> None:
    """The function that allocates the program's state."""
    program = g.program
    with g.block("static void machine_start(machine *m)"):
        for name, spec in program.tables.items():
            table = f"m->t[{g.index['t'][name]}]"
            stride = table_words(program, spec)
            g.line(f"{table}.words = {key_places(spec)[0] if spec.keys else 0}; {table}.stride = {stride};")
            g.line(f"{table}.default_action = -1; {table}.metered = {int(spec.has_meter)};")
            g.line(f"{table}.default_params = calloc({stride + 1}, 8);")
        for name, array in program.counters.items():
            g.line(f"m->c[{g.index['c'][name]}] = calloc({2 * max(array.size, 1)}, 8);")
        for name, array in program.meters.items():
            size = 1 if array.table else max(array.size, 1)
            g.line(f"m->mt[{g.index['mt'][name]}] = calloc({size}, sizeof(meter));")
        for name, array in program.registers.items():
            number, count = g.index["reg"][name], array.size * words(array.width) + 1
            g.line(f"m->reg[{number}] = cells_new({count}); m->cells[{number}] = {count};")


def _keep_list(g: CGenerator) -> None:
    with g.block("static void keep_list(phv *to, const phv *from, u32 list)"):
        g.line("(void)to; (void)from;")
        with g.block("switch (list)"):
            for number, refs in g.program.field_lists.items():
                g.line(f"case {number}:")
                for ref in refs:
                    name = g.names[ref.header, ref.field.name]
                    g.line(f"to->{name} = from->{name};")
                    if ref.header in g.numbers:
                        g.line(f"to->changed |= {g.change(ref.header)};")
                g.line("break;")


def generate(program: Program, layout: Layout) -> str:
    """The whole unit."""
    if not all(h.type.width % 8 == 0 for h in program.headers.values() if not h.metadata):
        raise Unsupported(
            "a header that is not a whole number of bytes is not supported by the embedded switch"
        )
    g = CGenerator(program, layout)
    g.lines += _structures(g)
    with g.block("static int parse(machine *m, phv *p)"):
        g.line("(void)m;")
        g.parser()
    for name, pipeline in (("ingress", program.ingress), ("egress", program.egress)):
        with g.block(f"static void {name}(machine *m, phv *p)"):
            g.line("i64 a; const u64 *d; int h; u64 i; (void)m; (void)p; (void)a; (void)d; (void)h; (void)i;")
            for ref in layout.private[name]:
                g.line(f"{storage(ref.field)} {g.field(ref)} = {'{{0}}' if ref.field.width > 128 else '0'};")
            g.pipeline(pipeline)
    with g.block("static u32 deparse(machine *m, phv *p, u8 *out)"):
        g.line("(void)m;")
        g.deparser()
    with g.block("static void digest(machine *m, phv *p)"):
        g.line("(void)m; (void)p;")
        g.digests()
    _keep_list(g)
    _start(g)
    runtime = files("dataplane.compiler")
    types, tables, engine = (
        runtime.joinpath(f"runtime_{part}.h").read_text() for part in ("types", "tables", "engine")
    )
    most = max((key_places(s)[0] for s in program.tables.values() if s.keys), default=1)
    return "\n".join([f"#define KEY_WORDS {most}", types, tables, *g.lines, engine])
