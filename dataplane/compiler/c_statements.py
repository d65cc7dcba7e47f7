"""Statements, tables and hash inputs as C; the functions around them are c_code's."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from dataplane.compiler.c_expressions import CTYPE, CExpressions, convert, kind_of, literal
from dataplane.compiler.control import Generator
from dataplane.compiler.layout import Layout
from dataplane.compiler.machine import array_names
from dataplane.compiler.simplify import bounds, simplify
from dataplane.errors import Unsupported
from dataplane.v1model import tree
from dataplane.v1model.tree import Const, Expression, FieldRef, MatchKind, Program, Statement

ALIGNED = {8: "be1", 16: "be2", 32: "be4", 48: "be6", 64: "be8", 128: "be16"}
"""Loads of whole bytes, by width in bits."""
_PUT = {16: "put2", 32: "put4", 48: "put6", 64: "put8", 128: "put16"}


OTHER_HEADERS = 63
"""Bit of `changed`: headers were added, removed or moved."""


def words(width: int) -> int:
    """64-bit words that hold `width` bits."""
    return (width + 63) // 64


def storage(field: tree.FieldType) -> str:
    """C type of a field in the packet state."""
    for bits in (8, 16, 32, 64):
        if field.width <= bits:
            return f"{'int' if field.signed else 'uint'}{bits}_t"
    if field.width <= 128:
        return "i128" if field.signed else "u128"
    return CTYPE[kind_of(field.width)]


def key_places(spec: tree.TableSpec) -> tuple[int, tuple[int, ...]]:
    """Words of a table's key and the bit of each field: fields do not straddle words, wide ones begin one."""
    places: list[int] = [0] * len(spec.keys)
    wide = [i for i, k in enumerate(spec.keys) if k.width > 64]
    narrow = sorted((i for i, k in enumerate(spec.keys) if k.width <= 64), key=lambda i: -spec.keys[i].width)
    bit = 0
    for i in wide:
        if spec.keys[i].kind is MatchKind.RANGE:
            raise Unsupported(
                f"a range over more than 64 bits is not supported by the embedded switch (in table {spec.name})"
            )
        places[i] = bit
        bit += 64 * words(spec.keys[i].width)
    rooms: list[tuple[int, int]] = []
    for i in narrow:
        width = spec.keys[i].width
        for n, (start, used) in enumerate(rooms):
            if used + width <= 64:
                places[i] = start + used
                rooms[n] = (start, used + width)
                break
        else:
            places[i] = bit
            rooms.append((bit, width))
            bit += 64
    return bit // 64, tuple(places)


def table_words(program: Program, spec: tree.TableSpec) -> int:
    """Words of the longest parameter list of a table's actions."""
    del program
    return max((sum(words(p.width) for p in a.params) for a in spec.actions), default=0)


class CStatements(Generator):
    """Names of one program's parts in C, and what is done with them."""

    hit_test = "h"
    action_test = "a == {}"
    either = " || "

    def __init__(self, program: Program, layout: Layout) -> None:
        super().__init__(program, layout)
        self.names: dict[tuple[str, str], str] = {}
        for header, fields in layout.fields.items():
            place = "m." if header in layout.metadata else ""
            for f in fields:
                # the program's own names never get into the source: they may be any text
                self.names[header, f.name] = f"{place}f{len(self.names)}"
        self.locals = {
            (ref.header, ref.field.name): self.names[ref.header, ref.field.name].removeprefix("m.")
            for refs in layout.private.values()
            for ref in refs
        }
        """Fields that are local variables of the function of their pipeline."""
        self.numbers = {h: i for i, h in enumerate(layout.packet_headers)}
        self.index = {
            kind: {name: i for i, name in enumerate(names)}
            for kind, names in (
                ("t", program.tables),
                ("c", program.counters),
                ("mt", program.meters),
                ("reg", program.registers),
                ("s", program.stacks),
            )
        }
        self.arrays = {name: i for i, name in enumerate(array_names(program))}
        self.e = CExpressions(self.leaf)
        self.places: tuple[tuple[int, int], ...] = ()
        """(word, words) of each parameter of the action in sight."""

    # -- blocks -------------------------------------------------------------------------------------

    def open(self, head: str) -> None:
        self.line(head + " {")
        self.depth += 1

    def close(self) -> None:
        self.depth -= 1
        self.line("}")

    def branch(self, head: str, condition: str) -> None:
        spelled = {"if": f"if ({condition})", "elif": f"}} else if ({condition})", "else": "} else"}[head]
        if head != "if":
            self.depth -= 1
        self.open(spelled)

    def nothing(self) -> None:
        pass

    def leave_on_exit(self) -> None:
        self.line("if (p->exit) return;")

    def begin_action(self, number: int) -> None:
        offset = 0
        places = []
        for param in self.program.actions[number].spec.params:
            places.append((offset, words(param.width)))
            offset += words(param.width)
        self.places = tuple(places)

    # -- leaves -------------------------------------------------------------------------------------

    def field(self, ref: FieldRef) -> str:
        key = ref.header, ref.field.name
        return self.locals.get(key) or "p->" + self.names[key]

    def valid(self, header: str) -> str:
        return f"p->v{self.numbers[header]}"

    def raw(self, header: str) -> str:
        return f"p->r{self.numbers[header]}"

    def size(self, header: str) -> str:
        """Bytes of a header as it was extracted."""
        kind = self.program.headers[header].type
        return f"p->l{self.numbers[header]}" if kind.max_bytes else str(kind.width // 8)

    def next(self, stack: str) -> str:
        return f"p->n{self.index['s'][stack]}"

    def leaf(self, e: Expression) -> tuple[str, int]:
        match e:
            case FieldRef(_, field):
                return self.loaded(self.field(e), field)
            case tree.Valid(header):
                always = self.program.headers[header].metadata
                return ("1ull" if always else f"(u64){self.valid(header)}"), 64
            case tree.Param(index, width):
                return self.param(index, width)
            case tree.StackLast(stack, field):
                return self.stack_last(stack, field)
            case tree.StackCount(stack, offset):
                return f"(u64)((i64){self.next(stack)} + {offset})", 64
            case tree.Lookahead(offset, width):
                kind = kind_of(width)
                return f"bits_get{kind}(k + o, {offset}, {width})", kind
        raise AssertionError(e)

    @staticmethod
    def loaded(text: str, field: tree.FieldType) -> tuple[str, int]:
        kind = kind_of(max(field.width, 1))
        if kind == 64:
            return (f"(u64)(i64){text}" if field.signed else f"(u64){text}"), 64
        return (f"(u128){text}" if kind == 128 else text), kind

    def param(self, index: int, width: int) -> tuple[str, int]:
        word, count = self.places[index]
        if count == 1:
            return f"d[{word}]", 64
        kind = kind_of(width)
        if kind == 128:
            return f"((u128)d[{word + 1}] << 64 | d[{word}])", 128
        return f"{CTYPE[kind]}_load(d + {word}, {count})", kind

    def stack_last(self, stack: str, field: tree.FieldType) -> tuple[str, int]:
        members = self.program.stacks[stack].headers
        texts = [self.loaded(self.field(FieldRef(h, field)), field) for h in members]
        text = texts[-1][0]
        for i in range(len(members) - 1, 0, -1):
            text = f"({self.next(stack)} == {i} ? {texts[i - 1][0]} : {text})"
        return text, texts[0][1]

    def expression(self, e: Expression) -> str:
        return self.e.test(e)

    def value64(self, e: Expression) -> str:
        """The true value where it fits 64 bits, else all ones (beyond every array)."""
        e = simplify(e)
        limit = bounds(e)
        if limit.low >= 0 and limit.bits <= 64:
            return self.e.at(e, 64)
        text, kind = self.e.exact(e)
        if kind == 128:
            return f"((u128){text} >> 64 ? ~0ull : (u64){text})"
        if kind == 64:
            return text
        raise Unsupported("an index of more than 128 bits is not supported by the embedded switch")

    def store(self, target: FieldRef, value: Expression) -> None:
        text, _ = self.e.stored(value, target.field)
        self.assign(target, text)

    def assign(self, target: FieldRef, text: str) -> None:
        self.load(target, text)
        self.changed(target.header)

    def load(self, target: FieldRef, text: str) -> None:
        """Into the field's slot, as it stands in the header's bytes."""
        kind = storage(target.field)
        cast = "" if kind.startswith("W") else f"({kind})"
        self.line(f"{self.field(target)} = {cast}{text};")

    def changed(self, header: str) -> None:
        """The header's bytes are no longer what its fields say."""
        if header in self.numbers:
            self.line(f"p->changed |= {self.change(header)};")

    def change(self, header: str) -> str:
        """The bit of a header in `changed`: headers beyond the 62nd share one."""
        return f"1ull << {min(self.numbers[header], OTHER_HEADERS - 1)}"

    def moved(self) -> None:
        """The frame has other headers than those that came."""
        self.line(f"p->changed |= 1ull << {OTHER_HEADERS};")

    def assign64(self, target: FieldRef, text: str) -> None:
        """A u64 cut to the target's width."""
        kind = kind_of(max(target.field.width, 1))
        cut = convert(text, 64, kind, signed=False)
        if target.field.signed:
            cut = self.e.wrapped(cut, kind, target.field.width)
        elif target.field.width < 64:
            cut = self.e.cut(cut, kind, target.field.width)
        self.assign(target, cut)

    # -- statements ---------------------------------------------------------------------------------

    def statement(self, s: Statement) -> None:
        getattr(self, "do_" + type(s).__name__.lower())(s)

    def do_assign(self, s: tree.Assign) -> None:
        self.store(s.target, s.value)

    def copied(self, target: str, source: str) -> None:
        for f in self.layout.fields[target]:
            self.line(f"{self.field(FieldRef(target, f))} = {self.field(FieldRef(source, f))};")
        self.line(f"{self.raw(target)} = {self.raw(source)};")
        if self.program.headers[target].type.max_bytes:
            self.line(f"{self.size(target)} = {self.size(source)};")
        self.changed(target)

    def do_copyheader(self, s: tree.CopyHeader) -> None:
        self.line(f"{self.valid(s.target)} = {self.valid(s.source)};")
        self.moved()
        with self.block(f"if ({self.valid(s.source)})"):
            self.copied(s.target, s.source)

    def do_addheader(self, s: tree.AddHeader) -> None:
        kind = self.program.headers[s.header].type
        with self.block(f"if (!{self.valid(s.header)})"):
            self.line(f"{self.valid(s.header)} = 1;")
            for f in self.layout.fields[s.header]:
                place = self.field(FieldRef(s.header, f))
                self.line(f"memset(&{place}, 0, sizeof {place});")
            self.line(f"{self.raw(s.header)} = zeros;")
            if kind.max_bytes:
                self.line(f"{self.size(s.header)} = {kind.width // 8};")
            self.line(f"p->length += {kind.width // 8};")
            self.moved()

    def do_removeheader(self, s: tree.RemoveHeader) -> None:
        with self.block(f"if ({self.valid(s.header)})"):
            self.line(f"{self.valid(s.header)} = 0;")
            self.line(f"p->length -= {self.size(s.header)};")
            self.moved()

    def do_shiftstack(self, s: tree.ShiftStack) -> None:
        members = self.program.stacks[s.stack].headers
        size, by = len(members), s.by
        self.moved()
        for i in range(size) if by < 0 else range(size - 1, -1, -1):
            if 0 <= i - by < size:
                self.copied(members[i], members[i - by])
                self.line(f"{self.valid(members[i])} = {self.valid(members[i - by])};")
            else:
                self.line(f"{self.valid(members[i])} = 0;")
        count = self.next(s.stack)
        moved = f"(int){count} + {by}"
        self.line(f"{count} = {moved} < 0 ? 0 : {moved} > {size} ? {size} : {moved};")

    def do_marktodrop(self, _: tree.MarkToDrop) -> None:
        for name, value in (("egress_spec", 511), ("mcast_grp", 0)):
            ref = self.layout.standard(name)
            if ref is not None:
                self.line(f"{self.field(ref)} = {value};")

    @contextmanager
    def cell(self, array: tree.ArraySpec, index: Expression) -> Iterator[None]:
        """A block for cell `i` of the array; an index beyond the array is counted instead."""
        with self.block(f"if ((i = {self.value64(index)}) < {array.size})"):
            yield
        self.line(f"else m->out_of_range[{self.arrays[array.name]}]++;")

    def do_count(self, s: tree.Count) -> None:
        spec = self.program.counters[s.array]
        cells = f"m->c[{self.index['c'][s.array]}]"
        with self.cell(spec, s.index):
            self.line(f"{cells}[2 * i]++; {cells}[2 * i + 1] += p->arrived;")

    def do_executemeter(self, s: tree.ExecuteMeter) -> None:
        spec = self.program.meters[s.array]
        cost = "p->arrived" if spec.unit == "bytes" else "1"
        with self.cell(spec, s.index):
            self.assign64(s.target, f"meter_run(&m->mt[{self.index['mt'][s.array]}][i], {cost}, p->now)")

    def do_registerread(self, s: tree.RegisterRead) -> None:
        spec = self.program.registers[s.array]
        cells, count = f"m->reg[{self.index['reg'][s.array]}]", words(spec.width)
        own = kind_of(spec.width)
        if own == 64:
            text = f"{cells}[i]"
        elif own == 128:
            text = f"((u128){cells}[2 * i + 1] << 64 | {cells}[2 * i])"
        else:
            text = f"{CTYPE[own]}_load({cells} + {count} * i, {count})"
        kind = kind_of(s.target.field.width)
        text = convert(text, own, kind, signed=False)
        if s.target.field.signed:
            text = self.e.wrapped(text, kind, s.target.field.width)
        elif spec.width > s.target.field.width:
            text = self.e.cut(text, kind, s.target.field.width)
        with self.cell(spec, s.index):
            self.assign(s.target, text)

    def do_registerwrite(self, s: tree.RegisterWrite) -> None:
        spec = self.program.registers[s.array]
        cells, count = f"m->reg[{self.index['reg'][s.array]}]", words(spec.width)
        text, kind = self.e.stored(s.value, tree.FieldType("", spec.width, 0))
        with self.cell(spec, s.index):
            if kind == 64:
                self.line(f"{cells}[i] = {text};")
            elif kind == 128:
                self.line(f"u128 x = {text};")
                self.line(f"{cells}[2 * i] = (u64)x; {cells}[2 * i + 1] = (u64)(x >> 64);")
            else:
                self.line(f"{CTYPE[kind]}_save({cells} + {count} * i, {text}, {count});")

    def do_hash(self, s: tree.Hash) -> None:
        calculation = self.program.calculations[s.calculation]
        size = simplify(s.size)
        base = self.e.at(simplify(s.base), 64)
        with self.block(""):
            self.digest_input(calculation)
            value = f"hash_{calculation.algorithm}(b, n)"
            if isinstance(size, Const):
                modulus = size.value & (2**64 - 1) or 1
                text = f"{value} % {literal(modulus, 64)}"
            else:
                self.line(f"u64 size = {self.e.at(size, 64)};")
                text = f"{value} % (size ? size : 1)"
            self.assign_sum(s.target, text, base)

    def assign_sum(self, target: FieldRef, text: str, base: str) -> None:
        """(text + base) modulo 2^64, as BMv2 adds them."""
        self.line(f"u64 x = {text} + {base};")
        self.assign64(target, "x")

    def do_random(self, s: tree.Random) -> None:
        with self.block(""):
            self.line(f"u64 low = {self.value64(s.low)}, high = {self.value64(s.high)};")
            with self.block("if (low <= high)"):
                self.line("m->seed ^= m->seed << 13; m->seed ^= m->seed >> 7; m->seed ^= m->seed << 17;")
                self.line("u64 x = high - low + 1 ? low + m->seed % (high - low + 1) : m->seed;")
                self.assign64(s.target, "x")

    def do_clone(self, s: tree.Clone) -> None:
        self.line(f"p->clone = (u32)({self.e.at(simplify(s.session), 64)} & 0x7fff) | 0x8000;")
        self.line(f"p->clone_list = {s.field_list};")

    def do_senddigest(self, s: tree.SendDigest) -> None:
        self.line(f"p->digest = {s.digest};")

    def do_resubmit(self, s: tree.Resubmit) -> None:
        self.line(f"p->resubmit = {s.field_list};")

    def do_recirculate(self, s: tree.Recirculate) -> None:
        self.line(f"p->recirculate = {s.field_list};")

    def do_truncate(self, s: tree.Truncate) -> None:
        self.line(f"i = {self.value64(s.length)};")
        self.line("if (i < p->truncate) p->truncate = (u32)i;")

    def do_exit(self, _: tree.Exit) -> None:
        self.line("p->exit = 1;")

    # -- tables -------------------------------------------------------------------------------------

    def lookup(self, node: tree.TableNode) -> None:
        table = f"m->t[{self.index['t'][node.name]}]"
        spec = self.program.tables[node.name]
        self.line(f"a = {table}.default_action; d = {table}.default_params; h = 0;")
        if not spec.keys:
            return
        size, places = key_places(spec)
        with self.block(f"if ({table}.count)"):
            parts: list[list[str]] = [[] for _ in range(size)]
            for key, target, mask, place in zip(spec.keys, node.keys, node.key_masks, places, strict=True):
                self.key_field(parts, target, key.width, mask, place)
            self.line(f"u64 k[{size}] = {{{', '.join(' | '.join(p) or '0' for p in parts)}}};")
            self.line(f"entry *e = table_find(&{table}, k);")
            with self.block("if (e)"):
                self.line("e->packets++; e->bytes += p->arrived; e->hit = p->now; h = 1; a = e->action;")
                self.line(f"d = {table}.params + (u64)(e - {table}.entries) * {table}.stride;")
                self.direct_meter(node)

    def direct_meter(self, node: tree.TableNode) -> None:
        meter = self.program.meters.get(node.meter)
        if meter is not None and meter.target is not None:
            cost = "p->arrived" if meter.unit == "bytes" else "1"
            self.assign64(meter.target, f"meter_run(e->meter, {cost}, p->now)")

    def key_field(
        self, parts: list[list[str]], target: Expression, width: int, mask: int, place: int
    ) -> None:
        kind = kind_of(width)
        text, own = self.leaf(target)
        text = convert(text, own, kind, signed=False)
        if (isinstance(target, FieldRef) and target.field.signed) or mask != (1 << width) - 1:
            cut = literal(mask, kind)
            text = f"{CTYPE[kind]}_and({text}, {cut})" if kind > 128 else f"({text} & {cut})"
        guard = ""
        if isinstance(target, FieldRef) and not self.program.headers[target.header].metadata:
            # BMv2 matches fields of an invalid header as zero
            guard = f"-(u64){self.valid(target.header)} & "
        if kind == 64:
            shift = f" << {place % 64}" if place % 64 else ""
            parts[place // 64].append(f"({guard}({text}){shift})")
            return
        for i in range(words(width)):
            piece = f"(u64)({text} >> {64 * i})" if kind == 128 else f"({text}).w[{i}]"
            parts[place // 64 + i].append(f"({guard}{piece})")

    # -- hash input ---------------------------------------------------------------------------------

    def digest_input(self, calculation: tree.Calculation) -> None:
        """Leave the input's bytes in `b` and their number in `n`."""
        most = sum(w for _, w in calculation.inputs)
        for e, width in calculation.inputs:
            if not width and isinstance(e, FieldRef):
                most += 8 * self.program.headers[e.header].type.max_bytes
        room = str(most // 8 + 8)
        if calculation.with_payload:
            room += " + p->size"
        self.line(f"u8 b[{room}];")
        owners = [e.header for e, _ in calculation.inputs if isinstance(e, FieldRef)]
        if all(owner in self.layout.metadata for owner in owners):
            self.fixed_input(calculation.inputs)
        else:
            self.running_input(calculation.inputs, room)
        if calculation.with_payload:
            self.line("{ u32 z = p->size < p->truncate ? p->size : p->truncate;")
            self.line("if (z > p->offset) { memcpy(b + n, p->pkt + p->offset, z - p->offset);")
            self.line("n += z - p->offset; } }")

    def fixed_input(self, inputs: Sequence[tuple[Expression, int]]) -> None:
        bit = 0
        total = sum(w for _, w in inputs)
        if total % 8 or any(w % 8 for _, w in inputs):
            self.line(f"memset(b, 0, {total // 8 + 1});")
        for e, width in inputs:
            kind = kind_of(width)
            text = self.e.at(simplify(e), kind)
            if bit % 8 == 0 and width in ALIGNED:
                self.line(self.put(f"b + {bit // 8}", width, text))
            else:
                self.line(f"bits_put{kind}(b, {bit}, {width}, {text});")
            bit += width
        self.line(f"u64 n = {(bit + 7) // 8};")

    @staticmethod
    def put(place: str, width: int, text: str) -> str:
        return f"*({place}) = (u8)({text});" if width == 8 else f"{_PUT[width]}({place}, {text});"

    def running_input(self, inputs: Sequence[tuple[Expression, int]], room: str) -> None:
        self.line(f"memset(b, 0, {room}); u64 n = 0;")
        for e, width in inputs:
            owner = e.header if isinstance(e, FieldRef) else ""
            guarded = owner and owner not in self.layout.metadata
            with self.block(f"if ({self.valid(owner)})" if guarded else ""):
                if width:
                    kind = kind_of(width)
                    text = self.e.at(simplify(e), kind)
                    self.line(f"bits_put{kind}(b, n, {width}, {text}); n += {width};")
                else:
                    self.varbit_input(owner)
        self.line("n = (n + 7) / 8;")

    def varbit_input(self, header: str) -> None:
        fixed = self.program.headers[header].type.width // 8
        with self.block(f"for (u32 j = {fixed}; j < {self.size(header)}; j++)"):
            self.line(f"bits_put64(b, n, 8, {self.raw(header)}[j]); n += 8;")
