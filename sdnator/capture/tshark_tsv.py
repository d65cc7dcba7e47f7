"""tshark's table of a capture, 19 columns, as the packet record that everything else reads.

    frame.time_epoch frame.len eth.src eth.dst ip.src ip.dst tcp.srcport … ipv6.src ipv6.dst
        ──► TsharkRow (numbers, -1 where a column is empty) ──► columns of `apps.packets.PACKET_COLUMNS`

It is what `tshark -T fields -E header=y -E occurrence=f` writes with the fields of `COLUMNS`; the
public Mirai data set comes in this form too.  The table has no TCP flags, no VLAN and no ICMPv6
columns: those of the record stay 0 or -1.

    TsvError (BadInput, ValueError)
    ├── MissingTsv      no such file or not readable
    └── MalformedTsv    names line and column
"""

import functools
import gzip
import ipaddress
import itertools
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from apps.packets import PACKET_COLUMNS
from due import RecordBatch
from sdnator.capture.pcap_records import MAX_FRAME
from sdnator.capture.table_file import open_table
from sdnator.errors import BadInput

COLUMNS: Final = (
    *("frame.time_epoch", "frame.len", "eth.src", "eth.dst", "ip.src", "ip.dst"),
    *("tcp.srcport", "tcp.dstport", "udp.srcport", "udp.dstport", "icmp.type", "icmp.code"),
    *("arp.opcode", "arp.src.hw_mac", "arp.src.proto_ipv4", "arp.dst.hw_mac", "arp.dst.proto_ipv4"),
    *("ipv6.src", "ipv6.dst"),
)
MAX_LINE: Final = 4_096
"""Characters of the longest line that is read; tshark's are below 400."""
_MAC: Final = re.compile(r"[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}")
PORT: Final = 1
"""Ingress port given to the packets of a table."""
PROTO_ICMP, PROTO_IGMP, PROTO_TCP, PROTO_UDP, PROTO_ICMP6, PROTO_UNKNOWN = 1, 2, 6, 17, 58, 253
TYPE_IPV4, TYPE_ARP, TYPE_IPV6, TYPE_LOOPBACK = 0x0800, 0x0806, 0x86DD, 0x9000


class TsvError(BadInput, ValueError):
    """A table that cannot be used; the text says what, where and what to do."""


class MissingTsv(TsvError):
    """No such file or not readable."""


class MalformedTsv(TsvError):
    """A line or a column that is not as tshark writes it."""


class TsharkRow(NamedTuple):
    """One packet; addresses as integers, -1 = the column is empty."""

    line: int
    time_ns: int
    length: int
    eth_src: int
    eth_dst: int
    ip_version: int
    ip_src: int
    ip_dst: int
    tcp_sport: int
    tcp_dport: int
    udp_sport: int
    udp_dport: int
    icmp_type: int
    icmp_code: int
    arp_op: int
    arp_src_mac: int
    arp_src_ip: int
    arp_dst_mac: int
    arp_dst_ip: int

    @property
    def quoted(self) -> bool:
        """The ports are those of a packet that an ICMP error quotes."""
        return self.icmp_type >= 0 and (self.tcp_sport >= 0 or self.udp_sport >= 0)

    @property
    def ip_proto(self) -> int:
        """The protocol as far as the table shows it; -1 = no IP, 253 (for experiments) = it does not show it."""
        if self.ip_version == 0:
            return -1
        if self.icmp_type >= 0:
            return PROTO_ICMP
        if self.tcp_sport >= 0:
            return PROTO_TCP
        if self.udp_sport >= 0:
            return PROTO_UDP
        if self.ip_version == 6:
            return PROTO_ICMP6
        return PROTO_IGMP if self.ip_dst >> 28 == 0xE else PROTO_UNKNOWN

    @property
    def eth_type(self) -> int:
        """The EtherType that these columns imply; 0 = a length field."""
        if self.arp_op >= 0:
            return TYPE_ARP
        if self.ip_version:
            return TYPE_IPV4 if self.ip_version == 4 else TYPE_IPV6
        return TYPE_LOOPBACK if self.eth_src == self.eth_dst else 0


def read_rows(path: str | os.PathLike[str]) -> Iterator[TsharkRow]:
    """Rows of a table, plain or gzipped.

    Raises:
        MissingTsv, MalformedTsv
    """
    path = Path(path)
    with open_table(path, MissingTsv, "table", "a tshark table") as file:
        numbered = enumerate(_lines(path, file), 1)
        try:
            header = next(numbered, (1, ""))[1].rstrip("\r\n").split("\t")
            if tuple(header) != COLUMNS:
                raise MalformedTsv(
                    f"{path}: line 1 does not name the 19 columns of the data set ({' '.join(COLUMNS)}); "
                    "write the table with tshark -T fields and these fields"
                )
            for number, line in numbered:
                yield _row(path, number, line.rstrip("\r\n").split("\t"))
        except (UnicodeDecodeError, EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise MalformedTsv(f"{path}: an incomplete table ({error}); copy or write it again") from None
        except OSError as error:
            raise MissingTsv(f"{path}: cannot be read ({error.strerror}); copy it again") from None


def read_batches(path: str | os.PathLike[str], rows: int = 4_096) -> Iterator[RecordBatch]:
    """Columns of `PACKET_COLUMNS` for up to `rows` packets at a time, in the order of the table.

    `sequence` counts from 1 and `arrival` from 0 over the whole table, as on a switch that lost nothing.
    """
    table = read_rows(path)
    start = 0
    while chunk := list(itertools.islice(table, rows)):
        yield as_columns(chunk, start)
        start += len(chunk)


def as_columns(rows: Iterable[TsharkRow], start: int = 0) -> RecordBatch:
    """The packet record of rows of which the first is number `start` of its table."""
    rows = list(rows)
    columns: dict[str, NDArray[np.generic]] = {
        name: np.zeros(len(rows), dtype) for name, dtype in PACKET_COLUMNS.items()
    }
    columns["arrival"] = np.arange(start, start + len(rows), dtype=np.uint64)
    columns["sequence"] = np.arange(start + 1, start + len(rows) + 1, dtype=np.uint64)
    columns["port"][:] = PORT
    for name in ("vlan", "icmp6_type", "icmp6_code"):
        columns[name][:] = -1
    for name, values in _derived(rows):
        columns[name][:] = values
    return RecordBatch(columns)


def _derived(rows: list[TsharkRow]) -> Iterator[tuple[str, list[int]]]:
    for name in _PLAIN:
        yield name, [getattr(row, name) for row in rows]
    for name in _ZERO_IF_ABSENT:
        yield name, [max(getattr(row, name), 0) for row in rows]
    yield "time_us", [row.time_ns // 1000 for row in rows]
    for name in ("ip_src", "ip_dst"):
        values = [max(getattr(row, name), 0) for row in rows]
        yield f"{name}_hi", [value >> 64 for value in values]
        yield f"{name}_lo", [value & 0xFFFF_FFFF_FFFF_FFFF for value in values]


_PLAIN = (
    *("length", "eth_src", "eth_dst", "eth_type", "ip_version", "ip_proto", "arp_op", "quoted"),
    *("tcp_sport", "tcp_dport", "udp_sport", "udp_dport", "icmp_type", "icmp_code"),
)
_ZERO_IF_ABSENT = ("arp_src_mac", "arp_src_ip", "arp_dst_mac", "arp_dst_ip")


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise MalformedTsv(
                f"{path}: line {number:,} is longer than {MAX_LINE:,} characters; this is not a tshark table"
            )
        yield line


def _row(path: Path, line: int, cells: list[str]) -> TsharkRow:
    if len(cells) != len(COLUMNS):
        raise MalformedTsv(
            f"{path}: line {line:,} has {len(cells)} columns, not {len(COLUMNS)}; "
            "the table may be cut off: copy or write it again"
        )
    column = 0
    try:
        time_ns = _time_ns(cells[0])
        values = [time_ns]
        for column in range(1, 19):
            values.append(_PARSERS[column](cells[column]) if cells[column] else -1)
    except ValueError:
        raise MalformedTsv(
            f"{path}: line {line:,}, column {COLUMNS[column]}: {cells[column]!r} is not what tshark writes there "
            "(one value, times as seconds since the epoch)"
        ) from None
    return _with_one_ip(line, values)


def _with_one_ip(line: int, values: list[int]) -> TsharkRow:
    """IPv4 wins over IPv6, as in the detector's own reader."""
    if values[4] >= 0:
        ip = (4, values[4], values[5])
    elif values[17] >= 0:
        ip = (6, values[17], values[18])
    else:
        ip = (0, -1, -1)
    return TsharkRow._make((line, *values[:4], *ip, *values[6:17]))


def _time_ns(text: str) -> int:
    seconds, _, fraction = text.partition(".")
    if not seconds.isdecimal() or len(seconds) > 10 or len(fraction) > 9 or not f"{fraction}0".isdecimal():
        raise ValueError(text)
    return int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))


@functools.lru_cache(4_096)
def _mac(text: str) -> int:
    if not _MAC.fullmatch(text):
        raise ValueError(text)
    return int(text.replace(":", ""), 16)


@functools.lru_cache(65_536)
def _ipv4(text: str) -> int:
    return int(ipaddress.IPv4Address(text))


@functools.lru_cache(65_536)
def _ipv6(text: str) -> int:
    return int(ipaddress.IPv6Address(text))


def _natural(text: str) -> int:
    if not text.isdecimal() or len(text) > 6 or int(text) > MAX_FRAME:
        raise ValueError(text)
    return int(text)


_PARSERS: Final[tuple[Callable[[str], int], ...]] = (
    *(_time_ns, _natural, _mac, _mac, _ipv4, _ipv4),
    *([_natural] * 7),
    *(_mac, _ipv4, _mac, _ipv4, _ipv6, _ipv6),
)
