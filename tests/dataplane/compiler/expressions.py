"""Programs that do nothing but compute: fields in, expressions, fields out."""

from collections.abc import Sequence
from random import Random

from dataplane.v1model import tree
from dataplane.v1model.tree import Binary, Conditional, Const, Expression, FieldRef, FieldType, Unary

WIDTHS = (1, 3, 8, 9, 16, 31, 32, 48, 63, 64, 65, 100, 127, 128, 129, 200, 256, 300, 448, 512)
SIGNED = (8, 16, 33, 64, 100, 128)
_OPS = (
    "+",
    "-",
    "*",
    "&",
    "|",
    "^",
    "<<",
    ">>",
    "==",
    "<",
    ">=",
    "?",
    "~",
    "mask",
    "cast",
    "and",
    "not",
    "%",
)


def layout(sizes: list[tuple[int, bool, bool]], prefix: str) -> tuple[FieldType, ...]:
    """Fields of (width, signed, saturating), packed, with a pad to whole bytes at the end."""
    fields: list[FieldType] = []
    offset = 0
    for n, (width, signed, saturating) in enumerate(sizes):
        fields.append(FieldType(f"{prefix}{n}", width, offset, signed, saturating))
        offset += width
    if offset % 8:
        fields.append(FieldType(f"{prefix}pad", 8 - offset % 8, offset))
    return tuple(fields)


INPUTS = layout([(w, False, False) for w in WIDTHS] + [(w, True, False) for w in SIGNED], "i")


def random_field(random: Random) -> Expression:
    return FieldRef("given", random.choice([f for f in INPUTS if not f.name.endswith("pad")]))


def random_constant(random: Random) -> Const:
    bits = random.choice([1, 4, 8, 16, 32, 64, 65, 128, 200])
    return Const(random.choice([0, 1, (1 << bits) - 1, random.getrandbits(bits)]))


def random_expression(random: Random, depth: int) -> Expression:
    if depth == 0 or random.random() < 0.15:
        return random_field(random) if random.random() < 0.8 else random_constant(random)
    op = random.choice(_OPS)
    left = random_expression(random, depth - 1)
    if op in ("<<", ">>"):
        return Binary(op, left, random_distance(random))
    if op in ("~", "not", "mask", "cast"):
        return one_operand(random, op, left)
    if op == "%":
        divisor = FieldRef("given", random.choice(INPUTS[:13]))
        return Binary(random.choice("/%"), Binary("&", left, Const((1 << 100) - 1)), divisor)
    right = random_expression(random, depth - 1)
    if op == "and":
        joined = Binary(random.choice(["and", "or"]), Unary("d2b", left), Unary("d2b", right))
        return Unary("b2d", joined)
    if op == "?":
        return Conditional(Unary("d2b", left), right, random_expression(random, depth - 1))
    return Binary(op, left, right)


def random_distance(random: Random) -> Expression:
    if random.random() < 0.7:
        return Const(random.choice([0, 1, 7, 8, 31, 32, 63, 64, 65, 127, 128, 200]))
    return FieldRef("given", INPUTS[random.randrange(4)])


def one_operand(random: Random, op: str, operand: Expression) -> Expression:
    if op == "~":
        return Unary("~", operand)
    if op == "not":
        return Unary("b2d", Unary("not", Unary("d2b", operand)))
    if op == "mask":
        return Binary("&", operand, Const((1 << random.choice(WIDTHS)) - 1))
    name = random.choice(["two_comp_mod", "usat_cast", "sat_cast"])
    return Binary(name, operand, Const(random.choice([2, 8, 16, 32, 64, 100])))


def program(targets: Sequence[tuple[FieldType, Expression | None]]) -> tree.Program:
    """Extracts `given`, computes every target into `result`, sends the frame to port 1."""
    standard = (("ingress_port", 9), ("egress_spec", 9), ("egress_port", 9), ("instance_type", 32))
    meta = layout([(w, False, False) for _, w in standard] + [(32, False, False)], "m")
    names = [n for n, _ in standard] + ["packet_length"]
    renamed = tuple(
        FieldType(names[i] if i < len(names) else f.name, f.width, f.offset) for i, f in enumerate(meta)
    )
    outputs = tuple(f for f, _ in targets)
    headers = {
        "standard_metadata": _header("standard_metadata", renamed, metadata=True),
        "given": _header("given", INPUTS),
        "result": _header("result", outputs),
    }
    egress_spec = FieldRef("standard_metadata", renamed[1])
    body: list[tree.Statement] = [tree.Assign(egress_spec, Const(1)), tree.AddHeader("result")]
    body += [tree.Assign(FieldRef("result", f), e) for f, e in targets if e is not None]
    node = tree.TableNode("tbl_run", (), (), (0,), {0: None}, False, None, None, hidden_action=0)
    parse = tree.ParserState("start", (tree.Extract("given"),), (), (), (), None)
    return tree.Program(
        name="expressions",
        headers=headers,
        stacks={},
        errors={"PacketTooShort": 1},
        parser=tree.Parser("start", {"start": parse}),
        ingress=tree.Pipeline("ingress", "tbl_run", {"tbl_run": node}),
        egress=tree.Pipeline("egress", None, {}),
        actions=(tree.Action(0, tree.ActionSpec("run", ()), tuple(body)),),
        tables={},
        calculations={},
        checksums=(),
        deparser=("result",),
        field_lists={},
        digests={},
        counters={},
        meters={},
        registers={},
    )


def _header(name: str, fields: tuple[FieldType, ...], *, metadata: bool = False) -> tree.Header:
    return tree.Header(name, tree.HeaderType(name, fields, sum(f.width for f in fields)), metadata)


def pack(fields: tuple[FieldType, ...], values: dict[str, int]) -> bytes:
    bits = 0
    for f in fields:
        bits = bits << f.width | values.get(f.name, 0) % (1 << f.width)
    return bits.to_bytes(sum(f.width for f in fields) // 8, "big")
