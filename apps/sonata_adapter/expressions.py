"""Expressions over the fields of a tuple: pure values, equal when they are written alike.

`Term` is what people write (`tcp.flags == SYN`, `ip.dst.within("10.0.0.0/8")`, `(a > 1) & (b < 2)`);
the nodes beneath it are what the rest of the adapter reads.
"""

from collections.abc import Iterator, Mapping
from ipaddress import ip_address, ip_network
from typing import Any, Final, Literal, TypeAlias

import msgspec

from apps.sonata_adapter.errors import InvalidQuery

Operator = Literal["+", "-", "*", "/", "%", "&", "|", "==", "!=", "<", "<=", ">", ">=", "and", "or"]
Kind = Literal["number", "address", "mac", "name", "condition"]

ARITHMETIC: Final = ("+", "-", "*", "/", "%", "&", "|")
COMPARISONS: Final = ("==", "!=", "<", "<=", ">", ">=")


class Node(msgspec.Struct, frozen=True, tag=True):
    """Base of all nodes; hashable, and fit to be written down (msgspec)."""


class Field(Node, frozen=True):
    """A field of the packet, or of the tuple that an operator before made."""

    name: str


class Number(Node, frozen=True):
    """A constant."""

    value: int


class Binary(Node, frozen=True):
    """Two operands; `/` is integer division and gives 0 where the divisor is 0."""

    operator: Operator
    left: "Expression"
    right: "Expression"


class Not(Node, frozen=True):
    """The condition does not hold."""

    operand: "Expression"


class Within(Node, frozen=True):
    """The address lies in a prefix (canonical text, `10.0.0.0/8`)."""

    field: Field
    prefix: str


class Contains(Node, frozen=True):
    """The packet's TCP or UDP payload, as far as it was copied, contains these bytes."""

    pattern: bytes


Expression: TypeAlias = Field | Number | Binary | Not | Within | Contains

# name -> kind, meaning; in the notation of tshark where it has one
PACKET_FIELDS: Final[dict[str, tuple[Kind, str]]] = {
    "ip.src": ("address", "source address, IPv4 or IPv6"),
    "ip.dst": ("address", "destination address, IPv4 or IPv6"),
    "ip.proto": ("number", "protocol behind IPv6 extension headers, -1 = no IP"),
    "ip.version": ("number", "4, 6, or 0 = no IP"),
    "tcp.sport": ("number", "TCP source port, -1 = not TCP"),
    "tcp.dport": ("number", "TCP destination port, -1 = not TCP"),
    "tcp.flags": ("number", "TCP flags: FIN 1, SYN 2, RST 4, PSH 8, ACK 16, URG 32, ECE 64, CWR 128"),
    "tcp.seq": ("number", "TCP sequence number"),
    "tcp.ack": ("number", "TCP acknowledgement number"),
    "udp.sport": ("number", "UDP source port, -1 = not UDP"),
    "udp.dport": ("number", "UDP destination port, -1 = not UDP"),
    "icmp.type": ("number", "ICMP type, -1 = not ICMP"),
    "icmp.code": ("number", "ICMP code, -1 = not ICMP"),
    "icmp6.type": ("number", "ICMPv6 type, -1 = not ICMPv6"),
    "icmp6.code": ("number", "ICMPv6 code, -1 = not ICMPv6"),
    "arp.op": ("number", "ARP operation, -1 = not ARP"),
    "eth.src": ("mac", "source MAC address"),
    "eth.dst": ("mac", "destination MAC address"),
    "eth.type": ("number", "EtherType behind VLAN tags"),
    "vlan": ("number", "outer VLAN, -1 = untagged"),
    "port": ("number", "port of the switch that the frame came in by"),
    "length": ("number", "bytes on the wire"),
    "dns.response": ("number", "1 = DNS answer over UDP, 0 = question, -1 = no DNS"),
    "dns.qtype": ("number", "record type of the first question, -1 = none"),
    "dns.name": ("name", "name of the first question, in lower case"),
}
"""Fields of a packet.  `dns.*` and `payload` need copies of the frame's bytes."""

PAYLOAD_FIELDS: Final = frozenset({"dns.response", "dns.qtype", "dns.name"})


def fields_of(expression: Expression) -> Iterator[str]:
    """Names of all fields in an expression; `payload` for `Contains`."""
    match expression:
        case Field(name):
            yield name
        case Binary(_, left, right):
            yield from fields_of(left)
            yield from fields_of(right)
        case Not(operand):
            yield from fields_of(operand)
        case Within(field, _):
            yield field.name
        case Contains():
            yield "payload"
        case Number():
            pass


def substitute(expression: Expression, names: Mapping[str, Expression]) -> Expression:
    """The expression with each field replaced by what `names` says it is."""
    match expression:
        case Field(name):
            return names.get(name, expression)
        case Binary(operator, left, right):
            return Binary(operator, substitute(left, names), substitute(right, names))
        case Not(operand):
            return Not(substitute(operand, names))
        case Within(field, prefix):
            found = names.get(field.name, field)
            if not isinstance(found, Field):
                raise InvalidQuery(f"{field.name} is no address; 'in {prefix}' needs one")
            return Within(found, prefix)
        case _:
            return expression


def kind_of(expression: Expression, kinds: Mapping[str, Kind]) -> Kind:
    """Kind of the expression's value; raises `InvalidQuery` where operands do not fit."""
    match expression:
        case Field(name):
            if name not in kinds:
                raise InvalidQuery(_unknown(name, kinds))
            return kinds[name]
        case Number():
            return "number"
        case Not(operand):
            _expect(kind_of(operand, kinds), "condition", "not")
            return "condition"
        case Within(field, prefix):
            _expect(kind_of(field, kinds), "address", f"in {prefix}")
            return "condition"
        case Contains():
            if not kinds.keys() >= PACKET_FIELDS.keys():
                raise InvalidQuery(
                    "payload is a field of packets only: filter before map, distinct and reduce"
                )
            return "condition"
        case Binary(operator, left, right):
            return _binary_kind(operator, kind_of(left, kinds), kind_of(right, kinds))


def _binary_kind(operator: Operator, left: Kind, right: Kind) -> Kind:
    if operator in ("and", "or"):
        _expect(left, "condition", operator)
        _expect(right, "condition", operator)
        return "condition"
    if operator in ("==", "!="):
        number = {"number", "mac"}
        if left != right and not {left, right} <= number:
            raise InvalidQuery(f"{left} {operator} {right}: only equal kinds can be compared")
        return "condition"
    for kind in (left, right):
        if kind not in ("number", "mac"):
            raise InvalidQuery(f"{operator} needs numbers, not {kind}")
    return "condition" if operator in COMPARISONS else "number"


def _expect(found: Kind, wanted: Kind, where: str) -> None:
    if found != wanted:
        raise InvalidQuery(f"{where!r} needs {wanted}, not {found}")


def _unknown(name: str, kinds: Mapping[str, Kind]) -> str:
    from difflib import get_close_matches

    near = get_close_matches(name, kinds, 1)
    hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(sorted(kinds))}"
    return f"unknown field {name}; {hint}"


_PRECEDENCE: Final = {"or": 1, "and": 2, "|": 4, "&": 5, "+": 6, "-": 6, "*": 7, "/": 7, "%": 7}
_COMPARISON_LEVEL: Final = 3


def text_of(expression: Expression, above: int = 0) -> str:
    """The expression in the text form of queries, with no more brackets than needed."""
    match expression:
        case Field(name):
            return name
        case Number(value):
            return str(value)
        case Not(operand):
            return f"not {text_of(operand, 8)}"
        case Within(field, prefix):
            network = ip_network(prefix)
            whole = network.prefixlen == network.max_prefixlen
            return f"{field.name} == {network.network_address}" if whole else f"{field.name} in {prefix}"
        case Contains(pattern):
            return f"payload contains {_quoted(pattern)}"
        case Binary(operator, left, right):
            level = _PRECEDENCE.get(operator, _COMPARISON_LEVEL)
            text = f"{text_of(left, level)} {operator} {text_of(right, level + 1)}"
            return f"({text})" if level < above else text


def _quoted(data: bytes) -> str:
    inner = "".join(chr(b) if 32 <= b < 127 and b not in (34, 92) else f"\\x{b:02x}" for b in data)
    return f'"{inner}"'


class Flags(msgspec.Struct, frozen=True):
    """A pattern of TCP flags: `tcp.flags == SYN` holds when `tcp.flags & mask == value`.

    FIN, SYN, RST and ACK are looked at (mask 0x17): PSH, URG and the ECN bits, which real floods set,
    do not matter.
    """

    name: str
    value: int
    mask: int = 0x17


SYN: Final = Flags("SYN", 0x02)
SYN_ACK: Final = Flags("SYN_ACK", 0x12)
ACK: Final = Flags("ACK", 0x10)
FIN: Final = Flags("FIN", 0x01, 0x07)
RST: Final = Flags("RST", 0x04, 0x04)
FLAG_PATTERNS: Final = {pattern.name: pattern for pattern in (SYN, SYN_ACK, ACK, FIN, RST)}

_Operand: TypeAlias = "Term | int | str | Flags"


class Term:
    """An expression as people write it in Python.

    >>> from apps.sonata_adapter.query import tcp
    >>> str((tcp.flags == SYN) & (tcp.dport < 1024))
    'tcp.flags & 23 == 2 and tcp.dport < 1024'
    """

    __slots__ = ("node",)

    node: Expression

    def __init__(self, node: Expression) -> None:
        self.node = node

    def within(self, prefix: str) -> "Term":
        """The address lies in the prefix; raises `InvalidQuery`."""
        if not isinstance(self.node, Field):
            raise InvalidQuery(f"{self}: only a field can be within a prefix")
        return Term(Within(self.node, canonical_prefix(prefix)))

    def __eq__(self, other: object) -> "Term":  # type: ignore[override]
        if isinstance(other, Flags):
            masked = Binary("&", self.node, Number(other.mask))
            return Term(Binary("==", masked, Number(other.value)))
        if isinstance(other, str):
            return self.within(other)
        return self._with("==", other)

    def __ne__(self, other: object) -> "Term":  # type: ignore[override]
        return ~(self == other) if isinstance(other, str | Flags) else self._with("!=", other)

    __hash__ = None  # type: ignore[assignment]

    def __lt__(self, other: _Operand) -> "Term":
        return self._with("<", other)

    def __le__(self, other: _Operand) -> "Term":
        return self._with("<=", other)

    def __gt__(self, other: _Operand) -> "Term":
        return self._with(">", other)

    def __ge__(self, other: _Operand) -> "Term":
        return self._with(">=", other)

    def __add__(self, other: _Operand) -> "Term":
        return self._with("+", other)

    def __sub__(self, other: _Operand) -> "Term":
        return self._with("-", other)

    def __mul__(self, other: _Operand) -> "Term":
        return self._with("*", other)

    def __floordiv__(self, other: _Operand) -> "Term":
        return self._with("/", other)

    def __mod__(self, other: _Operand) -> "Term":
        return self._with("%", other)

    def __and__(self, other: _Operand) -> "Term":
        return self._with("and" if self._is_condition else "&", other)

    def __or__(self, other: _Operand) -> "Term":
        return self._with("or" if self._is_condition else "|", other)

    def __invert__(self) -> "Term":
        return Term(Not(self.node))

    def __str__(self) -> str:
        return text_of(self.node)

    def __repr__(self) -> str:
        return f"Term({self})"

    @property
    def _is_condition(self) -> bool:
        node = self.node
        if isinstance(node, Binary):
            return node.operator in (*COMPARISONS, "and", "or")
        return isinstance(node, Not | Within | Contains)

    def _with(self, operator: Operator, other: object) -> "Term":
        return Term(Binary(operator, self.node, as_node(other)))


def as_node(value: object) -> Expression:
    """A term, number or node as a node; raises `InvalidQuery` for anything else."""
    if isinstance(value, Term):
        return value.node
    if isinstance(value, int):
        return Number(int(value))
    if isinstance(value, Node):
        node: Any = value
        return node  # type: ignore[no-any-return]
    raise InvalidQuery(f"{value!r} is no field, number or condition")


def canonical_prefix(text: str) -> str:
    """`10.1.2.3/8` → `10.0.0.0/8`, `10.1.2.3` → `10.1.2.3/32`; raises `InvalidQuery`."""
    try:
        return str(ip_network(text, strict=False))
    except ValueError:
        raise InvalidQuery(
            f"{text!r} is no address or prefix; write it as 10.0.0.1, 10.0.0.0/8 or 2001:db8::/32"
        ) from None


def address_text(version: int, number: int) -> str:
    """An address as people write it."""
    return str(ip_address(number.to_bytes(4 if version == 4 else 16, "big")))
