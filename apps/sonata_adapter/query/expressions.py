"""Expressions over the fields of a tuple: immutable values, equal if they are written alike.

`Term` is the interface for people (`tcp.flags == SYN`, `ip.dst.within("10.0.0.0/8")`, `(a > 1) & (b < 2)`);
the rest of the adapter works on the nodes it contains.
"""

from collections.abc import Iterator, Mapping
from ipaddress import ip_address, ip_network
from typing import Any, Final, Literal, TypeAlias

import msgspec

from apps.sonata_adapter.errors import QueryError

Operator = Literal["+", "-", "*", "/", "%", "&", "|", "==", "!=", "<", "<=", ">", ">=", "and", "or"]
Kind = Literal["number", "address", "mac", "name", "condition"]

COMPARISONS: Final = ("==", "!=", "<", "<=", ">", ">=")


class Node(msgspec.Struct, frozen=True, tag=True):
    """Base of all nodes; hashable, and can be serialised by msgspec."""


class Field(Node, frozen=True):
    """A field of the packet, or of the tuple that the previous operator made."""

    name: str


class Number(Node, frozen=True):
    """A constant."""

    value: int


class BinaryOperation(Node, frozen=True):
    """Two operands; `/` is integer division, and gives 0 for a divisor of 0."""

    operator: Operator
    left: "Expression"
    right: "Expression"


class Not(Node, frozen=True):
    """Negation of a condition."""

    operand: "Expression"


class Within(Node, frozen=True):
    """The address lies in a prefix (canonical text, `10.0.0.0/8`)."""

    field: Field
    prefix: str


class Contains(Node, frozen=True):
    """The packet's TCP or UDP payload, as far as it was copied, contains these bytes."""

    pattern: bytes


Expression: TypeAlias = Field | Number | BinaryOperation | Not | Within | Contains

# name -> kind, meaning; in the notation of tshark where it has one
PACKET_FIELDS: Final[dict[str, tuple[Kind, str]]] = {
    "ip.src": ("address", "source address, IPv4 or IPv6"),
    "ip.dst": ("address", "destination address, IPv4 or IPv6"),
    "ip.proto": ("number", "protocol after IPv6 extension headers, -1 = no IP"),
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
    "arp.src": ("address", "address of the sender of an ARP message, 0.0.0.0 = not ARP"),
    "arp.dst": ("address", "address that an ARP message asks for or answers to, 0.0.0.0 = not ARP"),
    "eth.src": ("mac", "source MAC address"),
    "eth.dst": ("mac", "destination MAC address"),
    "eth.type": ("number", "EtherType after VLAN tags"),
    "vlan": ("number", "outer VLAN, -1 = untagged"),
    "port": ("number", "ingress port at the switch"),
    "length": ("number", "bytes on the wire"),
    "dns.response": ("number", "1 = DNS answer over UDP, 0 = question, -1 = no DNS"),
    "dns.qtype": ("number", "record type of the first question, -1 = none; dns.type is the same"),
    "dns.name": ("name", "name of the first question, in lower case"),
    "len(dns.name)": ("number", "length of that name with its dots, as far as it was copied, -1 = none"),
    "entropy(dns.name)": ("number", "Shannon entropy of that name's bytes, 0 to 8,000, -1 = none"),
    "tcp.payload_len": (
        "number",
        "TCP payload by the headers; -1 = no TCP, or after IPv6 extension headers",
    ),
    "len(payload)": ("number", "the same for TCP and UDP"),
    "entropy(payload)": ("number", "Shannon entropy of the payload, as far as it was copied, -1 = none"),
}
"""Fields of a packet.  `dns.*` and those of payloads need copies of the frame's bytes.

The result of a function of a packet's text is a field too: its name is the call."""
FUNCTIONS: Final = ("len", "entropy")
OTHER_NAMES: Final = {"dns.type": "dns.qtype"}
"""Second names of fields."""

_MILLIBITS: Final = "mbit/byte"
UNITS: Final = {
    "length": "bytes", "len(dns.name)": "bytes", "tcp.payload_len": "bytes", "len(payload)": "bytes",
    "entropy(dns.name)": _MILLIBITS, "entropy(payload)": _MILLIBITS,
}  # fmt: skip
"""Units of those that have one."""
PAYLOAD_FIELDS: Final = frozenset(
    name for name in PACKET_FIELDS if name.startswith("dns.") or "payload" in name or "(" in name
)


def fields_of(expression: Expression) -> Iterator[str]:
    """All fields that an expression uses.

    Args:
        expression: any expression.

    Yields:
        Names of fields; `payload` for `Contains`.
    """
    match expression:
        case Field(name):
            yield name
        case BinaryOperation(_, left, right):
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


def size_of(expression: Expression, sizes: Mapping[str, int]) -> int:
    """Count the parts of an expression after substitution.

    Args:
        expression: any expression.
        sizes: name of a field to the number of parts that it stands for; other fields count as one.

    Returns:
        Number of fields, constants and operators.
    """
    match expression:
        case Field(name):
            return sizes.get(name, 1)
        case BinaryOperation(_, left, right):
            return 1 + size_of(left, sizes) + size_of(right, sizes)
        case Not(operand):
            return 1 + size_of(operand, sizes)
        case _:
            return 1


def substitute(expression: Expression, names: Mapping[str, Expression]) -> Expression:
    """Replace fields by expressions.

    Args:
        expression: any expression.
        names: name of a field to its replacement; other fields stay.

    Returns:
        The new expression.

    Raises:
        QueryError: the field of an `in` is replaced by something other than a field.
    """
    match expression:
        case Field(name):
            return names.get(name, expression)
        case BinaryOperation(operator, left, right):
            return BinaryOperation(operator, substitute(left, names), substitute(right, names))
        case Not(operand):
            return Not(substitute(operand, names))
        case Within(field, prefix):
            found = names.get(field.name, field)
            if not isinstance(found, Field):
                raise QueryError(f"{field.name} is not an address; 'in {prefix}' needs one")
            return Within(found, prefix)
        case _:
            return expression


def kind_of(expression: Expression, kinds: Mapping[str, Kind]) -> Kind:
    """The kind of an expression's value.

    Args:
        expression: any expression.
        kinds: the kinds of the fields that exist.

    Returns:
        number, address, mac, name or condition.

    Raises:
        QueryError: a field does not exist, or operands do not fit.
    """
    match expression:
        case Field(name):
            if name not in kinds:
                raise QueryError(_unknown(name, kinds))
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
                raise QueryError("payload is a field of packets only: filter before map, distinct and reduce")
            return "condition"
        case BinaryOperation(operator, left, right):
            return _binary_kind(operator, kind_of(left, kinds), kind_of(right, kinds))


def _binary_kind(operator: Operator, left: Kind, right: Kind) -> Kind:
    if operator in ("and", "or"):
        _expect(left, "condition", operator)
        _expect(right, "condition", operator)
        return "condition"
    if operator in ("==", "!="):
        number = {"number", "mac"}
        if left != right and not {left, right} <= number:
            raise QueryError(f"{left} {operator} {right}: only equal kinds can be compared")
        return "condition"
    for kind in (left, right):
        if kind not in ("number", "mac"):
            raise QueryError(f"{operator} needs numbers, not {kind}")
    return "condition" if operator in COMPARISONS else "number"


def _expect(found: Kind, wanted: Kind, where: str) -> None:
    if found != wanted:
        raise QueryError(f"{where!r} needs {wanted}, not {found}")


def _unknown(name: str, kinds: Mapping[str, Kind]) -> str:
    from difflib import get_close_matches

    if name in PACKET_FIELDS and "(" in name:
        return f"{name} is a field of packets only: use it before a map, or name it in the map"
    near = get_close_matches(name, kinds, 1)
    hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(sorted(kinds))}"
    return f"unknown field {name}; {hint}"


_PRECEDENCE: Final = {"or": 1, "and": 2, "|": 4, "&": 5, "+": 6, "-": 6, "*": 7, "/": 7, "%": 7}
_COMPARISON_LEVEL: Final = 3


def text_of(expression: Expression, above: int = 0) -> str:
    """The expression in the text form of queries, with no more brackets than needed.

    Args:
        expression: any expression.
        above: precedence of the operator around it; 0 for none.

    Returns:
        Text that `text.parse_queries` reads back.
    """
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
        case BinaryOperation(operator, left, right):
            level = _PRECEDENCE.get(operator, _COMPARISON_LEVEL)
            text = f"{text_of(left, level)} {operator} {text_of(right, level + 1)}"
            return f"({text})" if level < above else text


def _quoted(data: bytes) -> str:
    inner = "".join(chr(b) if 32 <= b < 127 and b not in (34, 92) else f"\\x{b:02x}" for b in data)
    return f'"{inner}"'


class Flags(msgspec.Struct, frozen=True):
    """A pattern of TCP flags: `tcp.flags == SYN` holds if `tcp.flags & mask == value`.

    The default mask 0x17 compares FIN, SYN, RST and ACK and ignores PSH, URG and the ECN bits, which real
    floods set."""

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

    >>> from apps.sonata_adapter.query.language import tcp
    >>> str((tcp.flags == SYN) & (tcp.dport < 1024))
    'tcp.flags & 23 == 2 and tcp.dport < 1024'

    Args:
        node: the expression.
    """

    __slots__ = ("node",)

    node: Expression

    def __init__(self, node: Expression) -> None:
        self.node = node

    def within(self, prefix: str) -> "Term":
        """Condition: the address lies in a prefix.

        Args:
            prefix: such as 10.0.0.0/8; host bits are ignored.

        Returns:
            A term for conditions.

        Raises:
            QueryError: not a prefix, or this term is not a field.
        """
        if not isinstance(self.node, Field):
            raise QueryError(f"{self}: only a field can be within a prefix")
        return Term(Within(self.node, canonical_prefix(prefix)))

    def __eq__(self, other: object) -> "Term":  # type: ignore[override]
        if isinstance(other, Flags):
            masked = BinaryOperation("&", self.node, Number(other.mask))
            return Term(BinaryOperation("==", masked, Number(other.value)))
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
        if isinstance(node, BinaryOperation):
            return node.operator in (*COMPARISONS, "and", "or")
        return isinstance(node, Not | Within | Contains)

    def _with(self, operator: Operator, other: object) -> "Term":
        return Term(BinaryOperation(operator, self.node, as_node(other)))


def as_node(value: object) -> Expression:
    """Convert an operand.

    Args:
        value: a term, a node or a whole number.

    Returns:
        The node.

    Raises:
        QueryError: the value is anything else.
    """
    if isinstance(value, Term):
        return value.node
    if isinstance(value, int):
        return Number(int(value))
    if isinstance(value, Node):
        node: Any = value
        return node  # type: ignore[no-any-return]
    raise QueryError(f"{value!r} is not a field, number or condition")


def canonical_prefix(text: str) -> str:
    """The canonical spelling of a prefix: `10.1.2.3/8` → `10.0.0.0/8`, `10.1.2.3` → `10.1.2.3/32`.

    Args:
        text: an address or prefix, IPv4 or IPv6.

    Returns:
        The prefix without host bits.

    Raises:
        QueryError: not an address or prefix.
    """
    try:
        return str(ip_network(text, strict=False))
    except ValueError:
        raise QueryError(
            f"{text!r} is not an address or prefix; write it as 10.0.0.1, 10.0.0.0/8 or 2001:db8::/32"
        ) from None


def address_text(version: int, number: int) -> str:
    """An address as text.

    Args:
        version: 4 or 6.
        number: the address, 32 or 128 bits.

    Returns:
        Dotted or compressed text.
    """
    return str(ip_address(number.to_bytes(4 if version == 4 else 16, "big")))
