"""Fields of packets and tuples as numpy columns, read on demand and once.

An address column is two uint64 halves.  IPv4 addresses have 0 in the upper half; to keep `::1` apart
from `0.0.0.1`, the upper half of an IPv6 address is stored XOR `SIX`, whose own value (a reserved
multicast prefix) is no source or destination of real packets.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.host.evaluation import FUNCTIONS, SIX, column_of, evaluate
from apps.sonata_adapter.host.key_dictionary import KeyDictionary, NumberedKeys
from apps.sonata_adapter.host.key_tables import Column, Hashes, Part, combined, hashes, mixed, take, zeros
from apps.sonata_adapter.host.payload import FrameBytes
from apps.sonata_adapter.query.expressions import (
    Expression,
    Field,
    Kind,
    Operator,
    address_text,
    kind_of,
    substitute,
)
from apps.sonata_adapter.query.language import PACKET_KINDS
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
_ARP_ADDRESSES: Final = {"arp.src": "arp_src_ip", "arp.dst": "arp_dst_ip"}
_DNS: Final = ("dns.response", "dns.qtype", "dns.name")
_NAMES: Final = ("len(dns.name)", "entropy(dns.name)")
_PAYLOADS: Final = ("tcp.payload_len", "len(payload)", "entropy(payload)")
_TRANSPORTS: Final = (6, 17)
_DNS_PORT: Final = 53
_NO_PORT: Final = -1
_NO_PORTS: Final = np.array(_NO_PORT)
_MOST: Final = 4
"""If more than one in this many packets is selected, keys are computed for the whole batch."""
_ALL_PORTS: Final = Field("ports")
_FLOW: Final = (Field("ip.src"), Field("ip.dst"), _ALL_PORTS)


Numberings = dict[Expression, KeyDictionary]
"""Key dictionaries by the expression of the key."""


class MissingFields:
    """Fields that were missing in a batch and its selections."""

    payloads = 0
    """Packets whose payload a query needed but was not copied."""


class PacketColumns:
    """The packets of a batch; fields, keys and selections are computed once, on first use."""

    _rows: NDArray[np.intp] | None = None
    _whole: "PacketColumns | None" = None

    def __init__(self, batch: RecordBatch, numberings: Numberings | None = None) -> None:
        self._prepare(batch, len(batch), MissingFields(), {} if numberings is None else numberings)

    def _prepare(self, batch: RecordBatch, size: int, missing: MissingFields, numberings: Numberings) -> None:
        self.missing = missing
        self._numberings = numberings
        self._batch = batch
        self._size = size
        self._columns: dict[str, Column] = {}
        self._terms: dict[Expression, Hashes] = {}
        self._keys: dict[tuple[Expression, ...], Hashes] = {}
        self._numbered: dict[Expression, NumberedKeys | None] = {}
        self._selections: dict[Expression, PacketColumns] = {}

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
    def _every(self) -> "PacketColumns":
        """All packets of the batch."""
        return self if self._whole is None else self._whole

    def forget(self) -> None:
        """Drop selections; the reference cycle would keep them and the packets in memory."""
        made, self._selections = self._selections, {}
        for packets in made.values():
            if packets is not self:
                packets.forget()

    def at(self, kept: NDArray[np.intp]) -> "PacketColumns":
        """Some of these packets, in the order of `kept`."""
        return _Selection(self, kept)

    def between(self, first: int, end: int) -> "PacketColumns":
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

    def where(self, condition: Expression) -> "PacketColumns":
        """The packets for which the condition holds."""
        if not self._size:
            return self
        found = self._selections.get(condition)
        if found is None:
            found = self._selections[condition] = self._where(condition)
        return found

    def _where(self, condition: Expression) -> "PacketColumns":
        (kept,) = evaluate(condition, self).nonzero()
        return self if len(kept) == self._size else self.at(kept)

    def keys(self, values: tuple[Expression, ...]) -> Hashes:
        found = self._keys.get(values)
        if found is None:
            found = self._keys[values] = self._made_keys(values)
        return found

    def _made_keys(self, values: tuple[Expression, ...]) -> Hashes:
        return combined([self._term(value) for value in values], self._size)

    def numbered(self, value: Expression) -> NumberedKeys | None:
        if value not in self._numbered:
            self._numbered[value] = self._made_numbers(value)
        return self._numbered[value]

    def _made_numbers(self, value: Expression) -> NumberedKeys | None:
        numbering = self._numberings.get(value)
        if numbering is None:
            numbering = self._numberings[value] = KeyDictionary(kind_of(value, PACKET_KINDS))
        numbering.often |= self is self._every
        return numbering.number(self.keys((value,)), lambda rows: self.columns_at((value,), rows)[0])

    def _often(self, value: Expression) -> bool:
        """Whether numbers for all packets are likely to be needed."""
        numbering = self._numberings.get(value)
        return numbering is not None and numbering.often

    def keys_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> Hashes:
        known = self._every._keys.get(values)  # noqa: SLF001 - of its own kind
        if known is None:
            return self.keys(values)[rows]
        return known[rows if self._rows is None else self._rows[rows]]

    def tuples(self, names: Mapping[str, Expression], rows: NDArray[np.intp]) -> "PacketTuples":
        return PacketTuples(self.at(rows), names)

    def flows(self) -> Hashes:
        """64 bits that the packets of a flow (addresses, protocol, ports) share, and no others."""
        return self.keys(_FLOW)

    def _term(self, value: Expression) -> Hashes:
        """The hash of a value, as a part of keys."""
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

    def compared(self, name: str, operator: Operator, number: int, mask: int) -> NDArray[np.bool_] | None:
        if name in _PLAIN:
            values = self._raw(_PLAIN[name])
            if mask < 0:
                return np.asarray(FUNCTIONS[operator](values, number))
            return np.asarray(FUNCTIONS[operator](values & mask, number)) if _fits(mask, values) else None
        if name not in _PORTS or mask >= 0 or FUNCTIONS[operator](_NO_PORTS, number):
            return None
        column, protocol = _PORTS[name]
        found: NDArray[np.bool_] = FUNCTIONS[operator](self._raw(column), number)
        found &= self._raw("ip_proto") == protocol
        return found

    def contains(self, pattern: bytes) -> NDArray[np.bool_]:
        frames = self._frames(None)
        return np.zeros(self._size, dtype=np.bool_) if frames is None else frames.payload_contains(pattern)

    def marks(self, name: str) -> NDArray[np.bool_] | None:
        """A column of the batch that says yes or no of each packet; None: the batch has none of this name."""
        return self._raw(name) if name in self._batch else None

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
        if name in _NAMES:
            self._read_names()
            return self._columns[name]
        if name in _PAYLOADS:
            self._read_payloads()
            return self._columns[name]
        if name in _ARP_ADDRESSES:
            return zeros(self._size), self._raw(_ARP_ADDRESSES[name]).astype(np.uint64)
        return self._address(*_ADDRESSES[name])

    def _port(self, name: str, protocol: int) -> NDArray[np.int64]:
        """The packet's own port: not one that an ICMP error quotes, not one of UDP-Lite."""
        ports = self._raw(name).astype(np.int64)
        ports[self._raw("ip_proto") != protocol] = _NO_PORT
        return ports

    def _address(self, high_name: str, low_name: str) -> Column:
        low = self._raw(low_name).astype(np.uint64, copy=False)
        version = self._raw("ip_version")
        if not (version == 6).any():
            return zeros(self._size), low
        high = np.where(version == 6, self._raw(high_name) ^ np.uint64(SIX), np.uint64(0))
        return high, low

    def _frames(self, rows: NDArray[np.intp] | None) -> FrameBytes | None:
        if "frame" not in self._batch:
            self.missing.payloads += self._size if rows is None else len(rows)
            return None
        chosen = self.origin if rows is None else self.origin[rows]
        return FrameBytes(self._batch["frame"][chosen], self._batch["captured"][chosen])

    def _dns_frames(self) -> tuple[NDArray[np.intp], FrameBytes | None]:
        """Rows of UDP port 53, and their bytes if they were copied."""
        ports = (self.column("udp.sport")[0], self.column("udp.dport")[0])
        rows = np.flatnonzero((ports[0] == _DNS_PORT) | (ports[1] == _DNS_PORT))
        return rows, self._frames(rows) if len(rows) else None

    def _read_names(self) -> None:
        size = np.full(self._size, -1, dtype=np.int64)
        entropy = size.copy()
        rows, frames = self._dns_frames()
        if frames is not None:
            size[rows], entropy[rows] = frames.names()
        self._columns |= dict(zip(_NAMES, ((size,), (entropy,)), strict=True))

    def _read_payloads(self) -> None:
        size = np.full(self._size, -1, dtype=np.int64)
        entropy = size.copy()
        protocol = self._raw("ip_proto")
        rows = np.flatnonzero(np.isin(protocol, _TRANSPORTS))
        frames = self._frames(rows) if len(rows) else None
        if frames is not None:
            size[rows], entropy[rows] = frames.payloads(self._raw("length")[rows])
        of_tcp = np.where(protocol == _TRANSPORTS[0], size, -1)
        self._columns |= dict(zip(_PAYLOADS, ((of_tcp,), (size,), (entropy,)), strict=True))

    def _read_dns(self) -> None:
        response = np.full(self._size, -1, dtype=np.int64)
        qtype = response.copy()
        name = np.zeros(self._size, dtype=np.uint64)
        rows, frames = self._dns_frames()
        if frames is not None:
            response[rows], qtype[rows], name[rows] = frames.dns()
        self._columns |= {"dns.response": (response,), "dns.qtype": (qtype,), "dns.name": (name,)}


class _Part(PacketColumns):
    """Some packets of a batch, with a reference to their origin."""

    _rows: NDArray[np.intp]

    def __init__(self, source: PacketColumns, rows: NDArray[np.intp]) -> None:
        self._prepare(source._batch, len(rows), source.missing, source._numberings)  # noqa: SLF001 - of its own kind
        self._source = source
        self._whole = source._every  # noqa: SLF001
        self._rows = rows

    def between(self, first: int, end: int) -> PacketColumns:
        return _Stretch(self, slice(*np.searchsorted(self._rows, (first, end)).tolist()))


class _Selection(_Part):
    """Scattered packets; values that their origin has computed already are reused."""

    def __init__(self, source: PacketColumns, kept: NDArray[np.intp]) -> None:
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

    def _made_keys(self, values: tuple[Expression, ...]) -> Hashes:
        known = self._every._keys.get(values)  # noqa: SLF001
        return super()._made_keys(values) if known is None else known[self._rows]

    def _made_numbers(self, value: Expression) -> NumberedKeys | None:
        every, source = self._every, self._source
        if value in every._numbered or every._often(value):  # noqa: SLF001
            numbered = every.numbered(value)
            return numbered and numbered.at(self._rows)
        if _MOST * self._size > len(source):
            numbered = source.numbered(value)
            return numbered and numbered.at(self._kept)
        return super()._made_numbers(value)


class _Stretch(_Part):
    """Packets that follow each other, of a batch or a selection: a window's.

    Values are computed for the whole origin and sliced, so that the next window can reuse them, and windows of
    other lengths, too.
    """

    def __init__(self, source: PacketColumns, part: slice) -> None:
        super().__init__(source, source.origin[part])
        self._part = part

    def _where(self, condition: Expression) -> PacketColumns:
        return self._source.where(condition).between(int(self._rows[0]), int(self._rows[-1]) + 1)

    def _made_keys(self, values: tuple[Expression, ...]) -> Hashes:
        return self._source.keys(values)[self._part]

    def _read(self, name: str) -> Column:
        return tuple(part[self._part] for part in self._source.column(name))

    def _made_numbers(self, value: Expression) -> NumberedKeys | None:
        whole = self._source.numbered(value)
        return whole and whole.at(self._part)

    def _made_term(self, value: Expression) -> Hashes:
        return self._source._term(value)[self._part]  # noqa: SLF001


class PacketTuples:
    """Tuples that an operator made from packets; values are read on demand, keys and numbers are shared."""

    def __init__(self, packets: PacketColumns, names: Mapping[str, Expression]) -> None:
        self._packets = packets
        self._names = names

    def __len__(self) -> int:
        return len(self._packets)

    @property
    def origin(self) -> NDArray[np.intp]:
        return self._packets.origin

    def column(self, name: str) -> Column:
        return column_of(self._names[name], self._packets)

    def compared(self, name: str, operator: Operator, number: int, mask: int) -> None:  # noqa: ARG002
        return None

    def contains(self, pattern: bytes) -> NDArray[np.bool_]:  # noqa: ARG002
        raise AssertionError("payload is a field of packets only; checked when the query was built")

    def where(self, condition: Expression) -> "PacketTuples":
        """The tuples for which the condition holds."""
        return PacketTuples(self._packets.where(substitute(condition, self._names)), self._names)

    def keys(self, values: tuple[Expression, ...]) -> Hashes:
        return self._packets.keys(self._of_packets(values))

    def columns_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> list[Column]:
        return self._packets.columns_at(self._of_packets(values), rows)

    def keys_at(self, values: tuple[Expression, ...], rows: NDArray[np.intp]) -> Hashes:
        return self._packets.keys_at(self._of_packets(values), rows)

    def tuples(self, names: Mapping[str, Expression], rows: NDArray[np.intp]) -> "PacketTuples":
        meant = dict(zip(names, self._of_packets(tuple(names.values())), strict=True))
        return PacketTuples(self._packets.at(rows), meant)

    def numbered(self, value: Expression) -> NumberedKeys | None:
        return self._packets.numbered(substitute(value, self._names))

    def _of_packets(self, values: tuple[Expression, ...]) -> tuple[Expression, ...]:
        return tuple(substitute(value, self._names) for value in values)


def _fits(mask: int, values: Part) -> bool:
    return mask <= np.iinfo(values.dtype).max


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

    def compared(self, name: str, operator: Operator, number: int, mask: int) -> None:  # noqa: ARG002
        return None

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

    def tuples(self, names: Mapping[str, Expression], rows: NDArray[np.intp]) -> "Tuples":
        columns = self.columns_at(tuple(names.values()), rows)
        return Tuples(dict(zip(names, columns, strict=True)), len(rows), self.origin[rows])

    def numbered(self, value: Expression) -> None:  # noqa: ARG002
        return None

    def take(self, rows: NDArray[np.intp]) -> "Tuples":
        """Some of the tuples, in the order of `rows`."""
        made = {name: take(column, rows) for name, column in self._columns.items()}
        return Tuples(made, len(rows), self.origin[rows])


NO_TUPLES: Final = Tuples({}, 0)


def plain_value(kind: Kind, column: Column, row: int) -> int | str:
    """One value in readable form."""
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
