"""Fields of packets and tuples as numpy columns, read on demand and once.

An address column is two uint64 halves.  IPv4 addresses have 0 in the upper half; to keep `::1` apart
from `0.0.0.1`, the upper half of an IPv6 address is stored XOR `_SIX`, whose own value (a reserved
multicast prefix) is no source or destination of real packets.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from ipaddress import ip_network
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.expressions import (
    Binary,
    Contains,
    Expression,
    Field,
    Kind,
    Not,
    Number,
    Operator,
    Within,
    address_text,
)
from apps.sonata_adapter.payload import Frames
from apps.sonata_adapter.tables import Column, Hashes, Part, hashes, is_constant, take, zeros
from due import RecordBatch

_SIX: Final = 0xFFFF_0000_0000_0001
_ALL_ONES: Final = (1 << 64) - 1

# field -> column of `apps.packets.PACKET_COLUMNS`, for those that are read as they stand
_PLAIN: Final = {
    "ip.proto": "ip_proto",
    "ip.version": "ip_version",
    "tcp.flags": "tcp_flags",
    "tcp.seq": "tcp_seq",
    "tcp.ack": "tcp_ack",
    "icmp.type": "icmp_type",
    "icmp.code": "icmp_code",
    "icmp6.type": "icmp6_type",
    "icmp6.code": "icmp6_code",
    "arp.op": "arp_op",
    "eth.src": "eth_src",
    "eth.dst": "eth_dst",
    "eth.type": "eth_type",
    "vlan": "vlan",
    "port": "port",
    "length": "length",
}
# field -> (column, protocol of a packet whose own port it is)
_PORTS: Final = {
    "tcp.sport": ("tcp_sport", 6),
    "tcp.dport": ("tcp_dport", 6),
    "udp.sport": ("udp_sport", 17),
    "udp.dport": ("udp_dport", 17),
}
_ADDRESSES: Final = {"ip.src": ("ip_src_hi", "ip_src_lo"), "ip.dst": ("ip_dst_hi", "ip_dst_lo")}
_DNS: Final = ("dns.response", "dns.qtype", "dns.name")
_DNS_PORT: Final = 53
_FLOW_SLOTS: Final = 1 << 14


class Rows(Protocol):
    """Tuples of one batch."""

    def __len__(self) -> int: ...

    def column(self, name: str) -> Column:
        """A field's values."""

    def contains(self, pattern: bytes) -> NDArray[np.bool_]:
        """Which packets' payloads contain the pattern."""

    def where(self, condition: Expression) -> "Rows":
        """The rows for which the condition holds."""

    @property
    def origin(self) -> NDArray[np.intp]:
        """For each row its packet's row in the batch."""


class Missing:
    """What a batch and its selections could not tell."""

    payloads = 0
    """Packets whose payload a query needed and nobody copied."""


class Packets:
    """Packets of a batch, all or some: fields are read when first asked for."""

    def __init__(
        self, batch: RecordBatch, rows: NDArray[np.intp] | None = None, missing: "Missing | None" = None
    ) -> None:
        self.missing = missing or Missing()
        self._batch = batch
        self._rows = rows
        self._size = len(batch) if rows is None else len(rows)
        self._columns: dict[str, Column] = {}
        self._selections: dict[Expression, Packets] = {}
        self._once: Packets | None = None

    def __len__(self) -> int:
        return self._size

    @property
    def batch(self) -> RecordBatch:
        """These packets as a batch."""
        return self._batch if self._rows is None else self._batch.take(self._rows)

    @property
    def origin(self) -> NDArray[np.intp]:
        return np.arange(self._size) if self._rows is None else self._rows

    def column(self, name: str) -> Column:
        found = self._columns.get(name)
        if found is None:
            found = self._columns[name] = self._read(name)
        return found

    def where(self, condition: Expression) -> "Packets":
        """The packets for which the condition holds."""
        if not self._size:
            return self
        found = self._selections.get(condition)
        if found is None:
            mask = evaluate(condition, self)
            if mask.all():
                found = self
            else:
                kept = np.flatnonzero(mask)
                found = Packets(self._batch, kept if self._rows is None else self._rows[kept], self.missing)
            self._selections[condition] = found
        return found

    @property
    def once(self) -> "Packets":
        """At least the first packet of each flow (addresses, protocol, ports), few others."""
        if self._once is None:
            keys = self._flow_keys()
            home = (keys & np.uint64(_FLOW_SLOTS - 1)).view(np.int64)
            slots = np.zeros(_FLOW_SLOTS, dtype=np.int64)
            rows = np.arange(self._size)
            slots[home[::-1]] = rows[::-1]
            first = slots[home]
            kept = np.flatnonzero((first == rows) | (keys[first] != keys))
            self._once = Packets(self._batch, self.origin[kept], self.missing)
        return self._once

    def _flow_keys(self) -> Hashes:
        source = np.maximum(self._raw("tcp_sport"), self._raw("udp_sport")).astype(np.int64) + 1
        destination = np.maximum(self._raw("tcp_dport"), self._raw("udp_dport")).astype(np.int64) + 1
        protocol = self._raw("ip_proto").astype(np.int64) + 1
        packed = source << 26 | destination << 9 | protocol
        return hashes([self.column("ip.src"), self.column("ip.dst"), (packed,)], self._size)

    def contains(self, pattern: bytes) -> NDArray[np.bool_]:
        frames = self._frames(None)
        return np.zeros(self._size, dtype=np.bool_) if frames is None else frames.payload_contains(pattern)

    def _raw(self, name: str) -> Part:
        column = self._batch[name]
        return column if self._rows is None else column[self._rows]

    def _read(self, name: str) -> Column:
        if name in _PLAIN:
            return (self._raw(_PLAIN[name]).astype(np.int64),)
        if name in _PORTS:
            return (self._port(*_PORTS[name]),)
        if name in _DNS:
            self._read_dns()
            return self._columns[name]
        return self._address(*_ADDRESSES[name])

    def _port(self, name: str, protocol: int) -> NDArray[np.int64]:
        """The packet's own port: not one that an ICMP error quotes, not one of UDP-Lite."""
        ports = self._raw(name).astype(np.int64)
        ports[self._raw("ip_proto") != protocol] = -1
        return ports

    def _address(self, high_name: str, low_name: str) -> Column:
        low = self._raw(low_name).astype(np.uint64, copy=False)
        version = self._raw("ip_version")
        if not (version == 6).any():
            return zeros(self._size), low
        high = np.where(version == 6, self._raw(high_name) ^ np.uint64(_SIX), np.uint64(0))
        return high, low

    def _frames(self, rows: NDArray[np.intp] | None) -> Frames | None:
        if "frame" not in self._batch:
            self.missing.payloads += self._size if rows is None else len(rows)
            return None
        chosen = self.origin if rows is None else self.origin[rows]
        return Frames(self._batch["frame"][chosen], self._batch["captured"][chosen])

    def _read_dns(self) -> None:
        response = np.full(self._size, -1, dtype=np.int64)
        qtype = response.copy()
        name = np.zeros(self._size, dtype=np.uint64)
        ports = (self.column("udp.sport")[0], self.column("udp.dport")[0])
        rows = np.flatnonzero((ports[0] == _DNS_PORT) | (ports[1] == _DNS_PORT))
        frames = self._frames(rows) if len(rows) else None
        if frames is not None:
            response[rows], qtype[rows], name[rows] = frames.dns()
        self._columns |= {"dns.response": (response,), "dns.qtype": (qtype,), "dns.name": (name,)}


class Tuples:
    """Tuples that an operator made."""

    def __init__(
        self, columns: Mapping[str, Column], size: int, origin: NDArray[np.intp] | None = None
    ) -> None:
        self._columns = columns
        self._size = size
        self._origin = origin

    def __len__(self) -> int:
        return self._size

    @property
    def origin(self) -> NDArray[np.intp]:
        return np.arange(self._size) if self._origin is None else self._origin

    def column(self, name: str) -> Column:
        return self._columns[name]

    def contains(self, pattern: bytes) -> NDArray[np.bool_]:  # noqa: ARG002
        raise AssertionError("payload is a field of packets only; checked when the query was built")

    def where(self, condition: Expression) -> "Tuples":
        """The tuples for which the condition holds."""
        mask = evaluate(condition, self)
        return self if mask.all() else self.take(np.flatnonzero(mask))

    def take(self, rows: NDArray[np.intp]) -> "Tuples":
        """Some of the tuples, in the order of `rows`."""
        made = {name: take(column, rows) for name, column in self._columns.items()}
        return Tuples(made, len(rows), self.origin[rows])


def column_of(expression: Expression, rows: Rows) -> Column:
    """Values of an expression: a field's column, or numbers."""
    if isinstance(expression, Field):
        return rows.column(expression.name)
    return (np.ascontiguousarray(evaluate(expression, rows), dtype=np.int64),)


def evaluate(expression: Expression, rows: Rows) -> NDArray[Any]:
    """Numbers or truth values, one for each row."""
    match expression:
        case Number(value):
            return np.full(len(rows), value, dtype=np.int64)
        case Field(name):
            return rows.column(name)[0]
        case Not(operand):
            return ~evaluate(operand, rows)
        case Within(field, prefix):
            return _within(rows.column(field.name), prefix)
        case Contains(pattern):
            return rows.contains(pattern)
        case Binary(operator, left, right):
            return _binary(operator, left, right, rows)


def _binary(operator: Operator, left: Expression, right: Expression, rows: Rows) -> NDArray[Any]:
    if operator in ("==", "!=") and isinstance(left, Field) and isinstance(right, Field):
        pairs = zip(rows.column(left.name), rows.column(right.name), strict=True)
        same = np.logical_and.reduce([a == b for a, b in pairs])
        return np.asarray(same if operator == "==" else ~same)
    first = evaluate(left, rows)
    second: Any = right.value if isinstance(right, Number) else evaluate(right, rows)
    return _FUNCTIONS[operator](first, second)


def _divide(left: NDArray[Any], right: Any) -> NDArray[Any]:
    divisor = np.asarray(right)
    return np.where(divisor == 0, 0, left // np.where(divisor == 0, 1, divisor))


def _modulo(left: NDArray[Any], right: Any) -> NDArray[Any]:
    divisor = np.asarray(right)
    return np.where(divisor == 0, 0, left % np.where(divisor == 0, 1, divisor))


_FUNCTIONS: Final[dict[Operator, Callable[[NDArray[Any], Any], NDArray[Any]]]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": _divide,
    "%": _modulo,
    "&": lambda a, b: a & b,
    "|": lambda a, b: a | b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "and": lambda a, b: a & b,
    "or": lambda a, b: a | b,
}


def _within(address: Column, prefix: str) -> NDArray[np.bool_]:
    high, low = address
    version, first, mask = _prefix(prefix)
    if is_constant(high) and version == 6:
        return np.zeros(len(low), dtype=np.bool_)
    upper = np.asarray(high, dtype=np.uint64)
    if version == 4:
        found: NDArray[np.bool_] = low & np.uint64(mask) == np.uint64(first)
        if not is_constant(high):
            found &= upper == 0
        return found
    upper = upper ^ np.uint64(_SIX)
    same: NDArray[np.bool_] = upper & np.uint64(mask >> 64) == np.uint64(first >> 64)
    same &= low & np.uint64(mask & _ALL_ONES) == np.uint64(first & _ALL_ONES)
    same &= high != 0
    return same


@lru_cache(maxsize=1024)
def _prefix(text: str) -> tuple[int, int, int]:
    network = ip_network(text)
    return network.version, int(network.network_address), int(network.netmask)


def plain_value(kind: Kind, column: Column, row: int) -> int | str:
    """One value as people read it."""
    if kind == "address":
        parts = (int(column[0][row]), int(column[1][row]))
        return address_text(6 if parts[0] else 4, address_number(parts))
    number = int(column[0][row])
    if kind == "mac":
        return ":".join(f"{byte:02x}" for byte in number.to_bytes(6, "big"))
    return f"{number:016x}" if kind == "name" else number


def address_number(parts: Sequence[int]) -> int:
    """The address that the two halves of a column stand for, as a number."""
    high, low = parts
    return low if high == 0 else (high ^ _SIX) << 64 | low
