"""A query's filters as conditions of the switch's classifier.

A filter becomes a list of alternatives, each a map of match field to value as telemetry requests
write it; a packet is wanted when it meets all conditions of at least one.  What the classifier cannot
express is left out and `exact` is False: good enough for copies, which the host filters again, but not
for counting.
"""

from collections.abc import Mapping
from ipaddress import ip_network
from typing import Any, Final

import msgspec

from apps.sonata_adapter.query.dataflow import conjuncts
from apps.sonata_adapter.query.expressions import BinaryOperation, Expression, Field, Not, Number, Within

Match = dict[str, Any]
"""Field to int (exact), [value, mask], [low, high] for ports, or prefix text."""

_IPV4, _IPV6, _ARP = 0x0800, 0x86DD, 0x0806
_TCP, _UDP = 6, 17
_PORT_MAX: Final = 65_535
_MOST: Final = 8
_OWN_PORTS: Final = {
    "tcp.sport": (_TCP, "sport"),
    "tcp.dport": (_TCP, "dport"),
    "udp.sport": (_UDP, "sport"),
    "udp.dport": (_UDP, "dport"),
}
_NUMBERS: Final = {"ip.proto": "protocol", "eth.type": "ethertype", "vlan": "vid", "port": "ingress_port"}


class Conditions(msgspec.Struct, frozen=True):
    """Alternatives; none at all means that no packet can meet the filter."""

    alternatives: tuple[Match, ...]
    exact: bool


def conditions_of(filters: tuple[Expression, ...]) -> Conditions:
    """The classifier's conditions for packets that meet all filters."""
    found: list[Match] = [{}]
    exact = True
    for condition in (part for each in filters for part in conjuncts(each)):
        one = _alternatives(condition)
        if one is None:
            exact = False
            continue
        merged = [each for left in found for right in one if (each := narrowed(left, right)) is not None]
        if len(merged) > _MOST:
            exact = False
            continue
        found = merged
    return Conditions(tuple(found), exact)


def disjoint(left: Mapping[str, Any], right: Mapping[str, Any]) -> bool:
    """Whether no packet can meet both."""
    return narrowed(left, right) is None


def _alternatives(condition: Expression) -> list[Match] | None:
    """None: the classifier cannot express it."""
    match condition:
        case BinaryOperation("or", left, right):
            first, second = conditions_of(conjuncts(left)), conditions_of(conjuncts(right))
            return [*first.alternatives, *second.alternatives] if first.exact and second.exact else None
        case BinaryOperation("==", BinaryOperation("&", Field("tcp.flags"), Number(mask)), Number(value)):
            return [{"protocol": _TCP, "l4_valid": 1, "tcp_flags": [value & mask, mask]}]
        case BinaryOperation(operator, Field(name), Number(value)):
            return _comparison(operator, name, value)
        case Within(Field(name), prefix):
            return _prefix(name, prefix)
        case Not(BinaryOperation("==", Field(name), Number(value))):
            return _comparison("!=", name, value)
        case _:
            return None


def _comparison(operator: str, name: str, value: int) -> list[Match] | None:
    if name in _OWN_PORTS:
        return _ports(operator, *_OWN_PORTS[name], value)
    if name == "ip.version" and operator in ("==", "!="):
        wanted = [(4, _IPV4), (6, _IPV6)]
        if operator == "!=":
            return (
                [{"ethertype": kind} for version, kind in wanted if version != value] if value == 0 else None
            )
        return [{"ethertype": kind} for version, kind in wanted if version == value] or None
    # a vid of 0 means untagged, protocol 0 means no IP: neither is told apart from a real 0
    if name in _NUMBERS and operator == "==" and value > 0:
        return [{_NUMBERS[name]: value}]
    return None


def _ports(operator: str, protocol: int, field: str, value: int) -> list[Match] | None:
    spans = {
        "==": [(value, value)],
        "!=": [(0, value - 1), (value + 1, _PORT_MAX)],
        "<": [(0, value - 1)],
        "<=": [(0, value)],
        ">": [(value + 1, _PORT_MAX)],
        ">=": [(value, _PORT_MAX)],
    }
    if operator not in spans or (value < 0 and operator in ("<", "<=", "!=", "==")):
        return None
    base = {"protocol": protocol, "l4_valid": 1}
    found: list[Match] = []
    for low, high in spans[operator]:
        first, last = max(low, 0), min(high, _PORT_MAX)
        if first <= last:
            found.append(base if (first, last) == (0, _PORT_MAX) else {**base, field: [first, last]})
    return found


def _prefix(name: str, prefix: str) -> list[Match] | None:
    kind = _IPV6 if ":" in prefix else _IPV4
    field = {"ip.src": "src", "ip.dst": "dst"}.get(name)
    return None if field is None else [{"ethertype": kind, field: prefix}]


def narrowed(left: Mapping[str, Any], right: Mapping[str, Any]) -> Match | None:
    """Conditions for packets that meet both; None where there are none."""
    found = dict(left)
    for field, value in right.items():
        met = _meet(field, found[field], value) if field in found else value
        if met is None:
            return None
        found[field] = met
    return found


def _meet(field: str, left: Any, right: Any) -> Any:
    if field in ("sport", "dport"):
        low, high = max(left[0], right[0]), min(left[1], right[1])
        return [low, high] if low <= high else None
    if field in ("src", "dst"):
        return _meet_prefixes(left, right)
    if field == "tcp_flags":
        if (left[0] ^ right[0]) & left[1] & right[1]:
            return None
        return [left[0] | right[0], left[1] | right[1]]
    return left if left == right else None


def _meet_prefixes(left: str, right: str) -> str | None:
    first, second = ip_network(left), ip_network(right)
    if first.version != second.version or not first.overlaps(second):
        return None
    return left if first.prefixlen >= second.prefixlen else right
