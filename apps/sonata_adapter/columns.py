"""Fields of packets and tuples as numpy columns, read on demand and once.

An address column is two uint64 halves.  IPv4 addresses have 0 in the upper half; to keep `::1` apart
from `0.0.0.1`, the upper half of an IPv6 address is stored XOR `SIX`, whose own value (a reserved
multicast prefix) is no source or destination of real packets.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.evaluation import SIX, column_of, evaluate
from apps.sonata_adapter.expressions import Expression, Field, Kind, address_text
from apps.sonata_adapter.numbering import Numbered, Numbering
from apps.sonata_adapter.payload import Frames
from apps.sonata_adapter.tables import Column, Hashes, Part, combined, hashes, mixed, take, zeros
from due import RecordBatch

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
_MOST: Final = 4
"""Where more than one in so many of a batch's packets is selected, keys are mixed for all and taken."""
_MANY: Final = 4_096
"""For so many rows shared numbers are worth their making."""
_ALL_PORTS: Final = Field("ports")
_FLOW: Final = (Field("ip.src"), Field("ip.dst"), _ALL_PORTS)


Numberings = dict[tuple[Expression, ...], Numbering]
"""By the values that keys are made of."""


class Missing:
    """What a batch and its selections could not tell."""

    payloads = 0
    """Packets whose payload a query needed and nobody copied."""


class Packets:
    """The packets of a batch: fields, keys and selections are made when first asked for, and once."""

    _rows: NDArray[np.intp] | None = None

    def __init__(self, batch: RecordBatch, numberings: Numberings | None = None) -> None:
        self._numberings: Numberings = {} if numberings is None else numberings
        self._prepare(batch, len(batch), Missing())

    def _prepare(self, batch: RecordBatch, size: int, missing: Missing) -> None:
        self.missing = missing
        self._batch = batch
        self._size = size
        self._columns: dict[str, Column] = {}
        self._terms: dict[Expression, Hashes] = {}
        self._keys: dict[tuple[Expression, ...], Hashes] = {}
        self._numbered: dict[tuple[Expression, ...], Numbered | None] = {}
        self._selections: dict[Expression, Packets] = {}

    def __len__(self) -> int:
        return self._size

    @property
    def batch(self) -> RecordBatch:
        """These packets as a batch."""
        return self._batch if self._rows is None else self._batch.take(self._rows)

    @property
    def origin(self) -> NDArray[np.intp]:
        return np.arange(self._size) if self._rows is None else self._rows

    @property
    def _every(self) -> "Packets":
        """All packets of the batch."""
        return self

    def at(self, kept: NDArray[np.intp]) -> "Packets":
        """Some of these packets, in the order of `kept`."""
        return _Selection(self, kept)

    def between(self, first: int, end: int) -> "Packets":
        """The rows of the batch from `first` on and before `end`; the rows must be in order."""
        return _Stretch(self, slice(first, end))

    def column(self, name: str) -> Column:
        found = self._columns.get(name)
        if found is None:
            found = self._columns[name] = self._read(name)
        return found

    def columns_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> list[Column]:
        some = self.at(rows)
        return [column_of(value, some) for value in values]

    def where(self, condition: Expression) -> "Packets":
        """The packets for which the condition holds."""
        if not self._size:
            return self
        found = self._selections.get(condition)
        if found is None:
            found = self._selections[condition] = self._where(condition)
        return found

    def _where(self, condition: Expression) -> "Packets":
        mask = evaluate(condition, self)
        return self if mask.all() else self.at(np.flatnonzero(mask))

    def keys(self, values: tuple[Expression, ...]) -> Hashes:
        found = self._keys.get(values)
        if found is None:
            found = self._keys[values] = self._made_keys(values)
        return found

    def _made_keys(self, values: tuple[Expression, ...]) -> Hashes:
        return combined([self._term(value) for value in values], self._size)

    def numbered(self, values: tuple[Expression, ...]) -> Numbered | None:
        if self._size < _MANY:
            return None
        if values not in self._numbered:
            self._numbered[values] = self._made_numbers(values)
        return self._numbered[values]

    def _made_numbers(self, values: tuple[Expression, ...]) -> Numbered | None:
        numbering = self._numberings.setdefault(values, Numbering())
        return numbering.number(self.keys(values))

    def keys_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> Hashes:
        known = self._every._keys.get(values)  # noqa: SLF001 - of its own kind
        if known is None:
            return self.keys(values)[rows]
        return known[rows if self._rows is None else self._rows[rows]]

    def flows(self) -> Hashes:
        """64 bits that the packets of a flow (addresses, protocol, ports) share, and no others."""
        return self.keys(_FLOW)

    def _term(self, value: Expression) -> Hashes:
        """The share of a value in keys."""
        found = self._terms.get(value)
        if found is None:
            found = self._terms[value] = self._made_term(value)
        return found

    def _made_term(self, value: Expression) -> Hashes:
        return mixed(self._ports() if value == _ALL_PORTS else column_of(value, self))

    def _ports(self) -> Column:
        """Protocol and ports in one number."""
        packed = np.maximum(self._raw("tcp_sport"), self._raw("udp_sport")).astype(np.int64)
        packed <<= 17
        packed += np.maximum(self._raw("tcp_dport"), self._raw("udp_dport"))
        packed <<= 9
        packed += self._raw("ip_proto")
        return (packed,)

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
        high = np.where(version == 6, self._raw(high_name) ^ np.uint64(SIX), np.uint64(0))
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


class _Part(Packets):
    """Some packets of a batch, and what they were taken from."""

    _rows: NDArray[np.intp]

    def __init__(self, source: Packets, rows: NDArray[np.intp]) -> None:
        self._prepare(source._batch, len(rows), source.missing)  # noqa: SLF001 - of its own kind
        self._source = source
        self._rows = rows

    @property
    def _every(self) -> Packets:
        return self._source._every  # noqa: SLF001

    def between(self, first: int, end: int) -> Packets:
        return _Stretch(self, slice(*np.searchsorted(self._rows, (first, end)).tolist()))


class _Selection(_Part):
    """Packets from here and there: what the ones they were taken from know already is taken from there."""

    def __init__(self, source: Packets, kept: NDArray[np.intp]) -> None:
        super().__init__(source, kept if source._rows is None else source._rows[kept])  # noqa: SLF001
        self._kept = kept

    def _read(self, name: str) -> Column:
        for known, rows in ((self._source, self._kept), (self._every, self._rows)):
            if name in known._columns or (isinstance(known, _Stretch) and name in known._source._columns):  # noqa: SLF001
                return take(known.column(name), rows)
        return super()._read(name)

    def _made_term(self, value: Expression) -> Hashes:
        every = self._every
        if isinstance(value, Field) and (value in every._terms or _MOST * self._size > len(every)):  # noqa: SLF001
            return every._term(value)[self._rows]  # noqa: SLF001
        return super()._made_term(value)

    def _made_numbers(self, values: tuple[Expression, ...]) -> Numbered | None:
        every = self._every.numbered(values)
        return every and Numbered(every.table, every.numbers[self._rows])


class _Stretch(_Part):
    """Packets that follow each other, of a batch or a selection: a window's.

    What is asked for is made for all of them and cut, so that the next window finds it made, and windows of
    other lengths too.
    """

    def __init__(self, source: Packets, part: slice) -> None:
        super().__init__(source, source.origin[part])
        self._part = part

    def _where(self, condition: Expression) -> Packets:
        return self._source.where(condition).between(int(self._rows[0]), int(self._rows[-1]) + 1)

    def _made_keys(self, values: tuple[Expression, ...]) -> Hashes:
        return self._source.keys(values)[self._part]

    def _read(self, name: str) -> Column:
        return tuple(part[self._part] for part in self._source.column(name))

    def _made_numbers(self, values: tuple[Expression, ...]) -> Numbered | None:
        whole = self._source.numbered(values)
        return whole and Numbered(whole.table, whole.numbers[self._part])

    def _made_term(self, value: Expression) -> Hashes:
        return self._source._term(value)[self._part]  # noqa: SLF001


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
        if not self._size:
            return self
        mask = evaluate(condition, self)
        return self if mask.all() else self.take(np.flatnonzero(mask))

    def keys(self, values: tuple[Expression, ...]) -> Hashes:
        return hashes([column_of(value, self) for value in values], self._size)

    def columns_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> list[Column]:
        return [take(column_of(value, self), rows) for value in values]

    def keys_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> Hashes:
        return self.keys(values)[rows]

    def numbered(self, values: tuple[Expression, ...]) -> None:  # noqa: ARG002
        return None

    def take(self, rows: NDArray[np.intp]) -> "Tuples":
        """Some of the tuples, in the order of `rows`."""
        made = {name: take(column, rows) for name, column in self._columns.items()}
        return Tuples(made, len(rows), self.origin[rows])


NO_TUPLES: Final = Tuples({}, 0)


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
    return low if high == 0 else (high ^ SIX) << 64 | low
