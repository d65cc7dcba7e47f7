"""The packet record: packet headers as columns of a record batch, one row per frame.

A `RecordBatch` with the columns of `PACKET_COLUMNS` is the value of every item under
`network.packets.p4runtime_ctrl.<switch>.<port>`.  Field semantics are those of tshark with
`occurrence=f` (first occurrence): an ICMP error carries the *quoted* TCP/UDP ports beside the outer
addresses.  Absent is -1 for signed columns and 0 where the text says so.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from apps.messages import LATEST_NS, MessageError
from due import RecordBatch

PACKET_COLUMNS: Final[dict[str, str]] = {
    # where and when
    "sequence": "u8",  # number of this packet-in among all that the switch sent; gaps are losses
    "arrival": "u8",  # number of the frame among all that reached the switch, from 0
    "time_us": "i8",  # capture time, absolute us since the epoch, UTC
    "port": "u2",  # ingress port of the switch
    "length": "u4",  # bytes on the wire
    # Ethernet; MAC addresses as integers
    "eth_src": "u8",
    "eth_dst": "u8",
    "eth_type": "u2",  # after VLAN tags; 0 for 802.3 length fields
    "vlan": "i4",  # outer VLAN id, -1 = untagged
    # ARP (IPv4 over Ethernet only); arp_op -1 = not ARP
    "arp_op": "i4",
    "arp_src_mac": "u8",
    "arp_src_ip": "u4",
    "arp_dst_mac": "u8",
    "arp_dst_ip": "u4",
    # outermost IP header; ip_version 0 = none. 128-bit addresses as two halves, IPv4 in the low one
    "ip_version": "u1",
    "ip_src_hi": "u8",
    "ip_src_lo": "u8",
    "ip_dst_hi": "u8",
    "ip_dst_lo": "u8",
    "ip_proto": "i4",  # after IPv6 extension headers, -1 = no IP
    # ports: first occurrence, so those quoted by an ICMP error count; -1 = absent
    "tcp_sport": "i4",
    "tcp_dport": "i4",
    "udp_sport": "i4",
    "udp_dport": "i4",
    "quoted": "u1",  # 1 = the ports above come from a packet quoted in an ICMP error
    # TCP of the packet itself (0 where there is none or it is only quoted)
    "tcp_flags": "u1",
    "tcp_seq": "u4",
    "tcp_ack": "u4",
    # ICMPv4 / ICMPv6 of the packet itself, -1 = absent
    "icmp_type": "i4",
    "icmp_code": "i4",
    "icmp6_type": "i4",
    "icmp6_code": "i4",
}
"""Column name to numpy dtype. All columns of a batch have the same length."""

MOST_ROWS: Final = 1 << 20
"""Most rows in one received batch."""
_LATEST_US: Final = LATEST_NS // 1000
_PORTS: Final = (-1, 65_535)
_BOUNDS: Final[dict[str, tuple[int, int]]] = {
    "time_us": (0, _LATEST_US),
    **dict.fromkeys(("eth_src", "eth_dst", "arp_src_mac", "arp_dst_mac"), (0, (1 << 48) - 1)),
    **dict.fromkeys(("tcp_sport", "tcp_dport", "udp_sport", "udp_dport"), _PORTS),
    **dict.fromkeys(("arp_op", "vlan", "icmp_type", "icmp_code", "icmp6_type", "icmp6_code"), _PORTS),
    "ip_proto": (-1, 255),
}
"""Smallest and largest value of columns whose type allows more."""

_VLAN_TAGS: Final = np.array([0x8100, 0x88A8, 0x9100], np.uint16)
_EXTENSIONS: Final = np.array([0, 43, 44, 51, 60], np.uint8)
_MAX_VLAN_TAGS: Final = 2
_MAX_EXTENSIONS: Final = 3
_SNAP: Final = 0xAAAA03000000
_TCP, _UDP, _UDP_LITE, _ICMP, _ICMP6, _FRAGMENT, _AUTHENTICATION = 6, 17, 136, 1, 58, 44, 51
_ICMP_ERRORS: Final = np.array([3, 4, 5, 11, 12], np.int32)
_ICMP6_ERRORS: Final = np.array([1, 2, 3, 4], np.int32)

_Array = npt.NDArray[Any]
_Numbers = Sequence[int] | npt.NDArray[Any]


def read_columns(value: object, kinds: Mapping[str, str], what: str) -> RecordBatch:
    """Check a received record batch: columns of these names and types, within the bounds of packet columns.

    Args:
        value: a decoded value.
        kinds: column name to numpy's dtype as text; other columns are left out.
        what: what the batch should be, for the error message.

    Returns:
        The columns of `kinds`, each of shape (n,); those of another type are converted.

    Raises:
        MessageError: no record batch, too many rows, a missing column, or a value that does not fit.
    """
    if not isinstance(value, RecordBatch):
        raise MessageError("shape", f"{what}: a record batch is expected, not {type(value).__name__}")
    if len(value) > MOST_ROWS:
        raise MessageError("size", f"{what}: {len(value):,} rows; {MOST_ROWS:,} at most")
    missing = [name for name in kinds if name not in value]
    if missing:
        raise MessageError("columns", f"{what}: no column {', '.join(missing)}")
    columns = {name: as_column(value[name], kind, f"{what}: {name}") for name, kind in kinds.items()}
    if len(value):
        _check_bounds(columns, what)
    return RecordBatch(columns)


def as_column(column: object, kind: str, what: str) -> _Array:
    """Check a received array of whole numbers, and convert it to a type.

    Args:
        column: a decoded value.
        kind: numpy's dtype as text, such as `u2`.
        what: what the array should be, for the error message.

    Returns:
        The array of that type, shape (n,); the same object if it has the type already.

    Raises:
        MessageError: no one-dimensional array of whole numbers, or a value that does not fit into the type.
    """
    dtype = np.dtype(kind)
    if not isinstance(column, np.ndarray) or column.ndim != 1 or column.dtype.kind not in "iu":
        found = (
            f"{column.dtype} of {column.ndim}" if isinstance(column, np.ndarray) else type(column).__name__
        )
        raise MessageError("columns", f"{what}: a row of whole numbers is expected, not {found} dimensions")
    if column.dtype == dtype:
        return column
    limits = np.iinfo(dtype)
    if len(column) and not limits.min <= int(column.min()) <= int(column.max()) <= limits.max:
        raise MessageError("range", f"{what}: a value does not fit into {dtype}")
    return column.astype(dtype)


def _check_bounds(columns: Mapping[str, _Array], what: str) -> None:
    for name, column in columns.items():
        low, high = _BOUNDS.get(name, (0, 0))
        if high and not low <= int(column.min()) <= int(column.max()) <= high:
            raise MessageError("range", f"{what}: {name} is not within {low} to {high}")
    if "ip_version" not in columns:
        return
    for name in ("ip_src_lo", "ip_dst_lo"):
        if name in columns and (columns[name][columns["ip_version"] == 4] >> np.uint64(32)).any():
            raise MessageError("range", f"{what}: {name} is over 32 bits where ip_version is 4")


class SteadyTime:
    """Capture time that is robust against single wrong time stamps.

    A time further than `most` from the newest accepted one is rejected until a few in a row agree: a long
    silence and a clock change look like that, a forged or damaged packet does not.

    Args:
        most: the largest step that is accepted at once, in units of the times.
    """

    def __init__(self, most: int) -> None:
        self.now: int | None = None
        """The newest accepted time."""
        self.doubted = 0
        """Number of rejected times."""
        self._most = most
        self._doubt: int | None = None
        self._agreed = 0

    def hear(self, time: int) -> bool:
        """Take note of the time of one item.

        Args:
            time: in the unit of `most`; it may be older than others.

        Returns:
            Whether it is accepted.
        """
        now = self.now
        if now is None or -self._most <= time - now <= self._most:
            self.now = time if now is None else max(now, time)
            self._agreed = 0
            return True
        agrees = self._agreed and self._doubt is not None and abs(time - self._doubt) <= self._most
        self._doubt, self._agreed = time, self._agreed + 1 if agrees else 1
        if self._agreed >= (_AGREE_AHEAD if time > now else _AGREE_BEHIND):
            self.now, self._agreed = time, 0
            return True
        self.doubted += 1
        return False

    def fit(self, time: int) -> int:
        """Replace a time that is too far ahead.

        Args:
            time: in the unit of `most`.

        Returns:
            The same time, also if it is in the past; or the newest accepted one if it is too far ahead of that.
        """
        if self.now is not None and time < self.now - self._most:
            return time
        return time if self.hear(time) or self.now is None else self.now

    def believed(self, times: _Array) -> npt.NDArray[np.bool_] | None:
        """Take note of the times of a batch, in order.

        Args:
            times: integers in the unit of `most`, shape (n,).

        Returns:
            Mask of the accepted ones, shape (n,); None: all of them are.
        """
        if not len(times):
            return None
        low, high, now = int(times.min()), int(times.max()), self.now
        if high - low <= self._most and (
            now is None or (now - self._most <= low and high <= now + self._most)
        ):
            self.now, self._agreed = high if now is None else max(now, high), 0
            return None
        found = np.fromiter((self.hear(time) for time in times.tolist()), np.bool_, len(times))
        return None if found.all() else found


_AGREE_AHEAD: Final = 5
_AGREE_BEHIND: Final = 20
"""More than for times ahead: late packets are common, and several switches may disagree."""


def read_frames(
    frames: Sequence[bytes],
    *,
    lengths: _Numbers,
    times_us: _Numbers,
    ports: _Numbers,
    sequence: _Numbers,
    arrival: _Numbers,
) -> RecordBatch:
    """Read Ethernet frames, whole, cut or zero-padded, as a record batch with all `PACKET_COLUMNS`.

    No frame is refused: missing or malformed headers are absent in its row.

    Differences from tshark: ports of a fragmented datagram stand in its first fragment (tshark
    reassembles and shows them in the last); the inside of tunnels (IP in IP, GRE, VXLAN, PPPoE,
    MPLS, IPsec over IPv4), of more than two VLAN tags and of more than three IPv6 extension headers
    is not read; ARP other than IPv4 over Ethernet counts as not ARP.

    Args:
        frames: n frames.
        lengths: bytes of each on the wire, shape (n,).
        times_us: capture time of each, µs since the epoch, shape (n,).
        ports: ingress port of each, shape (n,).
        sequence: number of each packet-in, shape (n,).
        arrival: arrival number of each at the switch, shape (n,).

    Returns:
        One row per frame, in the same order.

    Raises:
        ValueError: a column of numbers has another shape; the text names it.
    """
    given = {
        "sequence": sequence,
        "arrival": arrival,
        "time_us": times_us,
        "port": ports,
        "length": lengths,
    }
    columns: dict[str, _Array] = {}
    for name, kind in PACKET_COLUMNS.items():
        if name in given:
            columns[name] = np.asarray(given[name], dtype=kind)
            if columns[name].shape != (len(frames),):
                raise ValueError(
                    f"read_frames: {len(frames)} frames, but {name} has shape {columns[name].shape}"
                )
        else:
            columns[name] = np.full(len(frames), -1 if kind[0] == "i" else 0, dtype=kind)
    _Reading(frames, columns).ethernet()
    return RecordBatch(columns)


class _Span(NamedTuple):
    """Rows still being read, where their next header begins, and where their bytes end."""

    rows: _Array
    at: _Array
    end: _Array

    def only(self, keep: _Array) -> "_Span":
        return _Span(self.rows[keep], self.at[keep], self.end[keep])


class _Reading:
    """One pass over a batch: every header is read for all rows that have it at once."""

    def __init__(self, frames: Sequence[bytes], columns: dict[str, _Array]) -> None:
        self._columns = columns
        # frames end to end, and views that read a big-endian number at any byte
        joined = b"".join(frames) + bytes(8)
        self._views = {
            width: np.ndarray((len(joined) - width + 1,), f">u{width}", joined, strides=(1,))
            for width in (1, 2, 4, 8)
        }
        captured = np.fromiter(map(len, frames), np.int64, len(frames))
        ends = np.cumsum(captured)
        self._whole = _Span(np.arange(len(frames)), ends - captured, ends)

    def _number(self, width: int, at: _Array) -> _Array:
        return self._views[width][at].astype(f"u{width}")

    def _mac(self, at: _Array) -> _Array:
        return (self._number(2, at).astype(np.uint64) << np.uint64(32)) | self._number(4, at + 2)

    def ethernet(self) -> None:
        for name, offset in (("eth_dst", 0), ("eth_src", 6)):
            whole = self._whole.only(self._whole.at + offset + 6 <= self._whole.end)
            self._columns[name][whole.rows] = self._mac(whole.at + offset)
        span = self._whole.only(self._whole.at + 14 <= self._whole.end)
        kind = self._number(2, span.at + 12)
        span = span._replace(at=span.at + 14)
        span, kind = self._vlan_tags(span, kind)
        self._columns["eth_type"][span.rows] = np.where(kind <= 1500, 0, kind)
        span, kind = self._snap(span, kind)
        self._arp(span.only(kind == 0x0806))
        self._outer(span.only(kind == 0x0800), self._ipv4)
        self._outer(span.only(kind == 0x86DD), self._ipv6)

    def _vlan_tags(self, span: _Span, kind: _Array) -> tuple[_Span, _Array]:
        for depth in range(_MAX_VLAN_TAGS):
            is_tag = np.logical_or.reduce([kind == tag for tag in _VLAN_TAGS])
            tagged = np.flatnonzero(is_tag & (span.at + 4 <= span.end))
            if not len(tagged):
                break
            at = span.at[tagged]
            if depth == 0:
                self._columns["vlan"][span.rows[tagged]] = self._number(2, at) & 0xFFF
            kind[tagged] = self._number(2, at + 2)
            span.at[tagged] += 4
        return span, kind

    def _snap(self, span: _Span, kind: _Array) -> tuple[_Span, _Array]:
        """802.3 frames whose LLC header names an EtherType."""
        short = np.flatnonzero((kind <= 1500) & (span.at + 8 <= span.end))
        short = short[self._mac(span.at[short]) == _SNAP]
        if len(short):
            at = span.at[short]
            span.end[short] = np.minimum(span.end[short], at + kind[short])
            kind[short] = self._number(2, at + 6)
            span.at[short] += 8
        return span, kind

    def _arp(self, span: _Span) -> None:
        if not len(span.rows):
            return
        span = span.only(span.at + 28 <= span.end)
        hardware = self._number(2, span.at)
        span = span.only(((hardware == 1) | (hardware == 6)) & (self._number(4, span.at + 2) == 0x08000604))
        columns = self._columns
        columns["arp_op"][span.rows] = self._number(2, span.at + 6)
        columns["arp_src_mac"][span.rows] = self._mac(span.at + 8)
        columns["arp_src_ip"][span.rows] = self._number(4, span.at + 14)
        columns["arp_dst_mac"][span.rows] = self._mac(span.at + 18)
        columns["arp_dst_ip"][span.rows] = self._number(4, span.at + 24)

    def _outer(self, span: _Span, header: Callable[[_Span, bool], tuple[_Span, _Array]]) -> None:
        if not len(span.rows):
            return
        span, protocol = header(span, True)
        self._columns["ip_proto"][span.rows] = protocol
        self._ports(span, protocol)
        self._tcp(span.only(protocol == _TCP))
        icmp = self._icmp(span.only(protocol == _ICMP), "icmp", _ICMP_ERRORS)
        self._quoted(icmp, self._ipv4)
        icmp6 = self._icmp(span.only(protocol == _ICMP6), "icmp6", _ICMP6_ERRORS)
        self._quoted(icmp6, self._ipv6)

    def _ipv4(self, span: _Span, outer: bool) -> tuple[_Span, _Array]:
        span = span.only(span.at + 20 <= span.end)
        first = self._number(1, span.at)
        header = (first & 0xF).astype(np.int64) * 4
        total = self._number(2, span.at + 2).astype(np.int64)
        # total length 0 is what segmentation offload leaves in captures
        sane = (first >> 4 == 4) & (header >= 20) & ((total >= header) | (total == 0))
        span, header, total = span.only(sane), header[sane], total[sane]
        if outer:
            self._columns["ip_version"][span.rows] = 4
            self._columns["ip_src_lo"][span.rows] = self._number(4, span.at + 12)
            self._columns["ip_dst_lo"][span.rows] = self._number(4, span.at + 16)
        protocol = self._number(1, span.at + 9)
        later_fragment = self._number(2, span.at + 6) & 0x1FFF != 0
        end = np.where(total > 0, np.minimum(span.end, span.at + total), span.end)
        end = np.where(later_fragment, span.at, end)
        return span._replace(at=span.at + header, end=end), protocol

    def _ipv6(self, span: _Span, outer: bool) -> tuple[_Span, _Array]:
        span = span.only(span.at + 40 <= span.end)
        span = span.only(self._number(1, span.at) >> 4 == 6)
        if outer:
            self._columns["ip_version"][span.rows] = 6
            for name, offset in (("ip_src_hi", 8), ("ip_src_lo", 16), ("ip_dst_hi", 24), ("ip_dst_lo", 32)):
                self._columns[name][span.rows] = self._number(8, span.at + offset)
        payload = self._number(2, span.at + 4).astype(np.int64)
        protocol = self._number(1, span.at + 6)
        end = np.where(payload > 0, np.minimum(span.end, span.at + 40 + payload), span.end)
        span = span._replace(at=span.at + 40, end=end)
        for _ in range(_MAX_EXTENSIONS):
            more = np.flatnonzero(np.isin(protocol, _EXTENSIONS) & (span.at + 8 <= span.end))
            if not len(more):
                break
            self._extension(span, protocol, more)
        return span, protocol

    def _extension(self, span: _Span, protocol: _Array, more: _Array) -> None:
        """Steps over one extension header of the rows `more`, in place."""
        at, kind = span.at[more], protocol[more]
        units = self._number(1, at + 1).astype(np.int64)
        length = np.where(kind == _AUTHENTICATION, (units + 2) * 4, (units + 1) * 8)
        fragment = kind == _FRAGMENT
        later = fragment & (self._number(2, at + 2) >> 3 != 0)
        protocol[more] = self._number(1, at)
        span.at[more] = at + np.where(fragment, 8, length)
        span.end[more] = np.where(later, at, span.end[more])

    def _ports(self, span: _Span, protocol: _Array) -> _Array:
        """Writes source and destination port; returns the rows that have them."""
        there = span.at + 4 <= span.end
        for name, wanted in (
            ("tcp", protocol == _TCP),
            ("udp", (protocol == _UDP) | (protocol == _UDP_LITE)),
        ):
            found = span.only(there & wanted)
            self._columns[f"{name}_sport"][found.rows] = self._number(2, found.at)
            self._columns[f"{name}_dport"][found.rows] = self._number(2, found.at + 2)
        either: npt.NDArray[np.bool_] = (protocol == _TCP) | (protocol == _UDP) | (protocol == _UDP_LITE)
        return span.rows[there & either]

    def _tcp(self, span: _Span) -> None:
        span = span.only(span.at + 14 <= span.end)
        self._columns["tcp_seq"][span.rows] = self._number(4, span.at + 4)
        self._columns["tcp_ack"][span.rows] = self._number(4, span.at + 8)
        self._columns["tcp_flags"][span.rows] = self._number(1, span.at + 13)

    def _icmp(self, span: _Span, name: str, errors: _Array) -> _Span:
        """Writes type and code; returns where errors quote the packet they answer."""
        if not len(span.rows):
            return span
        span = span.only(span.at + 2 <= span.end)
        kind = self._number(1, span.at)
        self._columns[f"{name}_type"][span.rows] = kind
        self._columns[f"{name}_code"][span.rows] = self._number(1, span.at + 1)
        error = span.only(np.isin(kind, errors))
        return error._replace(at=error.at + 8)

    def _quoted(self, span: _Span, header: Callable[[_Span, bool], tuple[_Span, _Array]]) -> None:
        if len(span.rows):
            span, protocol = header(span, False)
            self._columns["quoted"][self._ports(span, protocol)] = 1
