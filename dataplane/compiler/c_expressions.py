"""Expressions in C: values of 64, 128, 256 or 512 bits in two's complement.

`at(e, kind)` is the value modulo 2^kind.  Sums, products and bit operations may be computed modulo 2^kind
whatever their true size; comparisons, right shifts, divisions and clamps need the true value, so their
operands are computed at a kind that holds their bounds.
"""

from collections.abc import Callable

from dataplane.compiler.simplify import Bounds, bounds, simplify, union
from dataplane.errors import Unsupported
from dataplane.v1model import tree
from dataplane.v1model.tree import Binary, Conditional, Const, Expression, FieldRef, Unary

KINDS = (64, 128, 256, 512)
CTYPE = {64: "u64", 128: "u128", 256: "W4", 512: "W8"}
_WIDE = {256: "W4", 512: "W8"}
_SYMBOL = {"+": "add", "-": "sub", "*": "mul", "&": "and", "|": "or", "^": "xor"}
_COMPARE = frozenset({"==", "!=", "<", "<=", ">", ">="})


def kind_of(bits: int, what: object = "an expression") -> int:
    """Smallest kind of at least `bits` bits.  Raises Unsupported beyond 512."""
    for kind in KINDS:
        if bits <= kind:
            return kind
    raise Unsupported(f"{what} needs {bits} bits; the embedded switch computes with at most 512")


def literal(value: int, kind: int) -> str:
    """A constant modulo 2^kind."""
    value &= (1 << kind) - 1
    limbs = [f"0x{(value >> s) & (2**64 - 1):x}ull" for s in range(0, kind, 64)]
    if kind == 64:
        return limbs[0]
    if kind == 128:
        return f"((u128){limbs[1]} << 64 | {limbs[0]})"
    return f"(({CTYPE[kind]}){{{{{', '.join(limbs)}}}}})"


def convert(text: str, kind: int, to: int, *, signed: bool) -> str:
    """A value of one kind as another: extended by sign or zero, or cut."""
    if kind == to:
        return text
    if kind > to:
        return _narrow(text, kind, to)
    if kind == 64:
        if to == 128:
            return f"(u128)(i128)(i64){text}" if signed else f"(u128){text}"
        return f"{CTYPE[to]}_{'s64' if signed else 'u64'}({text})"
    if kind == 128:
        return f"{CTYPE[to]}_{'s128' if signed else 'u128'}({text})"
    return f"{'W8_sW4' if signed else 'W8_W4'}({text})"


def _narrow(text: str, kind: int, to: int) -> str:
    if kind == 128:
        return f"(u64)({text})"
    if to == 256:
        return f"W4_W8({text})"
    return f"{CTYPE[kind]}_to128({text})" if to == 128 else f"({text}).w[0]"


class CExpressions:
    """Expressions of one program; `leaf` spells fields, parameters and the like at their own kind."""

    def __init__(self, leaf: Callable[[Expression], tuple[str, int]]) -> None:
        self.leaf = leaf

    def at(self, e: Expression, kind: int) -> str:
        """C text of the value modulo 2^kind."""
        limit = bounds(e)
        natural = kind_of(limit.bits) if limit.bits <= KINDS[-1] else KINDS[-1] + 1
        if isinstance(e, Const):
            return literal(e.value, kind)
        if natural < kind:
            return convert(self.at(e, natural), natural, kind, signed=limit.signed)
        match e:
            case Unary(op, operand):
                return self._unary(op, operand, kind)
            case Binary(op, left, right):
                return self._binary(op, left, right, kind)
            case Conditional(condition, yes, no):
                return f"({self.test(condition)} ? {self.at(yes, kind)} : {self.at(no, kind)})"
        text, own = self.leaf(e)
        return convert(text, own, kind, signed=limit.signed)

    def exact(self, e: Expression) -> tuple[str, int]:
        """The true value and its kind."""
        kind = kind_of(bounds(e).bits)
        return self.at(e, kind), kind

    def test(self, e: Expression) -> str:
        """C text that is true where the value is not zero."""
        if isinstance(e, Binary) and e.op in _COMPARE:
            return self._compare(e.op, e.left, e.right)
        if isinstance(e, Binary) and e.op in ("and", "or"):
            return f"({self.test(e.left)} {'&&' if e.op == 'and' else '||'} {self.test(e.right)})"
        if isinstance(e, Unary) and e.op == "not":
            return f"(!{self.test(e.operand)})"
        text, kind = self.exact(e)
        return f"{_WIDE[kind]}_nz({text})" if kind in _WIDE else f"({text} != 0)"

    def _unary(self, op: str, operand: Expression, kind: int) -> str:
        if op == "~":
            inner = self.at(operand, kind)
            return f"{_WIDE[kind]}_not({inner})" if kind in _WIDE else f"(~{inner})"
        return convert(f"(u64){self.test(Unary(op, operand))}", 64, kind, signed=False)

    def _binary(self, op: str, left: Expression, right: Expression, kind: int) -> str:
        if op in _COMPARE or op in ("and", "or"):
            return convert(f"(u64){self.test(Binary(op, left, right))}", 64, kind, signed=False)
        if op in _SYMBOL:
            return self._ring(op, left, right, kind)
        if op in ("<<", ">>"):
            return self._left(left, right, kind) if op == "<<" else self._right(left, right, kind)
        if op in ("/", "%"):
            return self._divide(op, left, right, kind)
        return self._cast(op, left, right, kind)

    def _ring(self, op: str, left: Expression, right: Expression, kind: int) -> str:
        a, b = self.at(left, kind), self.at(right, kind)
        if kind in _WIDE:
            return f"{_WIDE[kind]}_{_SYMBOL[op]}({a}, {b})"
        return f"({a} {op} {b})"

    def _compare(self, op: str, left: Expression, right: Expression) -> str:
        both = union(bounds(left), bounds(right))
        kind = kind_of(both.bits)
        a, b = self.at(left, kind), self.at(right, kind)
        if kind not in _WIDE:
            cast = {64: "(i64)", 128: "(i128)"}[kind] if both.signed and op not in ("==", "!=") else ""
            return f"({cast}{a} {op} {cast}{b})"
        name = _WIDE[kind]
        if op in ("==", "!="):
            return f"({'!' if op == '!=' else ''}{name}_eq({a}, {b}))"
        less = f"{name}_{'slt' if both.signed else 'lt'}"
        if op in (">", "<="):
            a, b = b, a
        return f"({'!' if op in ('<=', '>=') else ''}{less}({a}, {b}))"

    def _amount(self, e: Expression) -> str:
        """A shift's distance; what does not fit 64 bits is far beyond any width."""
        text, kind = self.exact(e)
        if kind == 64:
            return text
        raise Unsupported(
            "a shift by a distance of more than 64 bits is not supported by the embedded switch"
        )

    def _left(self, left: Expression, right: Expression, kind: int) -> str:
        value = self.at(left, kind)
        if isinstance(right, Const) and kind not in _WIDE:
            return f"({value} << {right.value})" if right.value < kind else literal(0, kind)
        name = _WIDE.get(kind, "")
        return f"{name + '_shl' if name else f'shl{kind}'}({value}, {self._amount(right)})"

    def _right(self, left: Expression, right: Expression, kind: int) -> str:
        value, own = self.exact(left)
        signed = bounds(left).signed
        if own in _WIDE:
            return self._right_wide(left, value, own, self._amount(right), kind)
        if isinstance(right, Const) and not signed:
            text = f"({value} >> {right.value})" if right.value < own else literal(0, own)
        else:
            text = f"{'sar' if signed else 'shr'}{own}({value}, {self._amount(right)})"
        return convert(text, own, kind, signed=signed)

    def _right_wide(self, left: Expression, value: str, own: int, amount: str, kind: int) -> str:
        name, signed = _WIDE[own], bounds(left).signed
        # a few bits out of a field: no need to shift all of it
        if kind in (64, 128) and isinstance(left, FieldRef) and not signed:
            return f"{name}_bits{kind}(&{value}, {amount}, 0)"
        text = f"{name}_{'sar' if signed else 'shr'}({value}, {amount})"
        return convert(text, own, kind, signed=signed)

    def _divide(self, op: str, left: Expression, right: Expression, kind: int) -> str:
        own = kind_of(union(bounds(left), bounds(right)).bits)
        if own in _WIDE or bounds(left).signed or bounds(right).signed:
            raise Unsupported(
                f"{op} of signed values or of more than 128 bits is not supported by the embedded switch"
            )
        a, b = self.at(left, own), self.at(right, own)
        return convert(f"({b} ? {a} {op} {b} : 0)", own, kind, signed=False)

    def _cast(self, op: str, left: Expression, right: Expression, kind: int) -> str:
        if not isinstance(right, Const):
            raise Unsupported(
                f"{op} to a width that is not a constant is not supported by the embedded switch"
            )
        width = right.value
        if op == "two_comp_mod":
            own = kind_of(width)
            return convert(self.wrapped(self.at(left, own), own, width), own, kind, signed=True)
        return self.clamped(op, left, width, kind)

    @staticmethod
    def wrapped(text: str, kind: int, width: int) -> str:
        """Sign extension from `width` bits."""
        if width == kind:
            return text
        return f"{_WIDE[kind]}_sx({text}, {width})" if kind in _WIDE else f"sx{kind}({text}, {width})"

    def clamped(self, op: str, e: Expression, width: int, kind: int) -> str:
        """`e` brought within the range of `width` bits, unsigned or (sat_cast) signed."""
        limit = bounds(e)
        half = 1 << (width - 1)
        want = Bounds(0, 2 * half - 1) if op == "usat_cast" else Bounds(-half, half - 1)
        signed = limit.signed or want.signed
        own = kind_of(max(limit.bits + (not limit.signed and signed), width + 1))
        if own in _WIDE:
            raise Unsupported(
                "saturating arithmetic on more than 127 bits is not supported by the embedded switch"
            )
        value = self.at(e, own)
        if not signed:
            return convert(f"usat{own}({value}, {literal(want.high, own)})", own, kind, signed=False)
        cast = {64: "(i64)", 128: "(i128)"}[own]
        low, high = literal(want.low, own), literal(want.high, own)
        return convert(f"ssat{own}({value}, {cast}{low}, {cast}{high})", own, kind, signed=True)

    def stored(self, e: Expression, field: tree.FieldType) -> tuple[str, int]:
        """The value as `field` keeps it, and its kind."""
        e = simplify(e)
        limit = bounds(e)
        kind = kind_of(max(field.width, 1))
        half = 1 << max(field.width - 1, 0)
        want = Bounds(-half, half - 1) if field.signed else Bounds(0, (1 << field.width) - 1)
        if want.low <= limit.low and limit.high <= want.high:
            return self.at(e, kind), kind
        if field.saturating:
            op = "sat_cast" if field.signed else "usat_cast"
            return self.clamped(op, e, field.width, kind), kind
        text = self.at(e, kind)
        if field.signed:
            return self.wrapped(text, kind, field.width), kind
        return self.cut(text, kind, field.width), kind

    @staticmethod
    def cut(text: str, kind: int, width: int) -> str:
        """The low `width` bits."""
        if width == kind:
            return text
        mask = literal((1 << width) - 1, kind)
        return f"{_WIDE[kind]}_and({text}, {mask})" if kind in _WIDE else f"({text} & {mask})"
