"""NetFlow v9 (RFC 3954) and IPFIX (RFC 7011): sets of templates, of options and of data.

A set of data whose template has not come yet is counted and left out: exporters repeat templates.
"""

import struct
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from due import RecordBatch
from flow_records.columns import LATEST_US, Numbers, flow_batch
from flow_records.decoding.data_sets import DataSet
from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.netflow5 import uptime_us
from flow_records.decoding.octets import octets_of
from flow_records.decoding.sampling import SamplingRates
from flow_records.decoding.sequence import SequenceGaps
from flow_records.decoding.templates import (
    FlowTemplate,
    TemplateCache,
    ipfix_options,
    ipfix_templates,
    netflow9_options,
    netflow9_templates,
)

_NETFLOW9: Final = struct.Struct("!HHIIII")
_IPFIX: Final = struct.Struct("!HHIII")
_SET: Final = struct.Struct("!HH")
_FIRST_DATA: Final = 256
MOST_SETS: Final = 256
"""Sets of one datagram."""
_READERS: Final[dict[tuple[int, int], Callable[[bytes], Iterator[FlowTemplate]]]] = {
    (9, 0): netflow9_templates,
    (9, 1): netflow9_options,
    (10, 2): ipfix_templates,
    (10, 3): ipfix_options,
}
"""Version and id of a set to what reads its templates."""

_COLUMNS: Final = {
    # elements by preference: of the flow as it came in, then as it went out, then since its beginning
    "packets": (2, 24, 86),
    "bytes": (1, 23, 85),
    "ip_proto": (4,),
    "tos": (5,),
    "tcp_flags": (6,),
    "src_port": (7, 180, 182),
    "dst_port": (11, 181, 183),
    "input": (10,),
    "output": (14,),
    "vlan": (58, 243),
    "eth_src": (56,),
    "eth_dst": (80, 57),
}
_SOURCES, _DESTINATIONS = (8, 27), (12, 28)
"""IPv4 and IPv6."""
_ICMP_BOTH: Final = (32, 139)
_ICMP_TYPE, _ICMP_CODE = (176, 178), (177, 179)
_SYSTEM_START: Final = 160
_ABSOLUTE: Final = {"first_us": {150: 1_000_000, 152: 1000}, "last_us": {151: 1_000_000, 153: 1000}}
"""Elements of whole seconds and milliseconds, and us in one."""
_NTP: Final = {"first_us": (154, 156), "last_us": (155, 157)}
_BEFORE_EXPORT: Final = {"first_us": 158, "last_us": 159}
_UPTIME: Final = {"first_us": 22, "last_us": 21}
_NTP_EPOCH: Final = 2_208_988_800
"""Seconds from 1900 to 1970."""


class ExportHeader(NamedTuple):
    """What stands before the sets."""

    version: int
    export_us: int
    uptime_ms: int | None
    """The exporter's uptime at `export_us`; None: IPFIX does not tell it."""
    sequence: int
    domain: int
    """Source id or observation domain."""
    size: int


class SetCounts(NamedTuple):
    """What a datagram held beside flows."""

    without_template: int
    """Sets of data whose template is unknown."""
    not_flows: int
    """Records of data without IP addresses."""


def export_header(datagram: bytes) -> ExportHeader:
    """The header of NetFlow v9 or IPFIX, whose version is known already; raises FlowDecodeError."""
    if datagram[:2] == b"\x00\x09":
        if len(datagram) < _NETFLOW9.size:
            raise FlowDecodeError("short", f"NetFlow v9: {len(datagram)} bytes are no header")
        _, _, uptime, seconds, sequence, domain = _NETFLOW9.unpack_from(datagram)
        return ExportHeader(9, seconds * 1_000_000, uptime, sequence, domain, _NETFLOW9.size)
    if len(datagram) < _IPFIX.size:
        raise FlowDecodeError("short", f"IPFIX: {len(datagram)} bytes are no header")
    _, length, seconds, sequence, domain = _IPFIX.unpack_from(datagram)
    if length != len(datagram):
        raise FlowDecodeError("length", f"IPFIX: a message of {length} bytes in {len(datagram)}")
    return ExportHeader(10, seconds * 1_000_000, None, sequence, domain, _IPFIX.size)


class ExportDomain:
    """One exporter's domain: its templates, its sampling rates, its sequence numbers.

    Args:
        sampling: rate where the exporter tells none.
        lifetime_s: how long templates are kept without being repeated.
    """

    def __init__(self, sampling: int, lifetime_s: float) -> None:
        self.templates = TemplateCache(lifetime_s)
        self.sampling = SamplingRates(sampling)
        self.gaps = SequenceGaps()
        self._started_ms: int | None = None

    def decode(
        self, datagram: bytes, header: ExportHeader, now: float
    ) -> tuple[list[RecordBatch], SetCounts]:
        """Flows of a datagram, a batch for each set; raises FlowDecodeError.

        Args:
            datagram: all of it.
            header: as `export_header` reads it.
            now: s, of a clock that never goes back.
        """
        if header.version == 9:
            self.gaps.hear(header.sequence, 1)
            found, counts, _ = self._sets(datagram, header, now)
            return found, counts
        records: int | None = None
        try:
            found, counts, records = self._sets(datagram, header, now)
        finally:
            self.gaps.hear(header.sequence, records)
        return found, counts

    def _sets(
        self, datagram: bytes, header: ExportHeader, now: float
    ) -> tuple[list[RecordBatch], SetCounts, int | None]:
        octets = octets_of(datagram)
        found: list[RecordBatch] = []
        without = not_flows = records = 0
        for number, start, end in list(_sets(datagram, header.size)):
            reader = _READERS.get((header.version, number))
            if reader is not None:
                for template in reader(datagram[start:end]):
                    self.templates.put(template, now)
            if number < _FIRST_DATA:
                continue
            known = self.templates.get(number, now)
            if known is None:
                without += 1
                continue
            data = DataSet(datagram, octets, start, end, known)
            records += data.size
            flows = self._taken(data, known, header)
            if flows is not None:
                found.append(flows)
            elif not known.options:
                not_flows += data.size
        return found, SetCounts(without, not_flows), None if without else records

    def _taken(self, data: DataSet, template: FlowTemplate, header: ExportHeader) -> RecordBatch | None:
        """Flows of a set; options are noted."""
        if template.options:
            self.sampling.learn(data)
            started = data.number(_SYSTEM_START)
            if started is not None and len(started):
                self._started_ms = int(started[-1])
            return None
        found = _addresses(data)
        if found is None:
            return None
        for name, elements in _COLUMNS.items():
            column = data.number(*elements)
            if column is not None:
                found[name] = column
        found |= _icmp(data)
        found["time_us"] = np.full(data.size, header.export_us)
        found["sampling"] = self.sampling.of(data)
        return flow_batch(data.size, found | self._times(data, header))

    def _times(self, data: DataSet, header: ExportHeader) -> dict[str, Numbers]:
        last = self._time("last_us", data, header)
        if last is None:
            last = np.full(data.size, header.export_us)
        first = self._time("first_us", data, header)
        return {"first_us": last if first is None else first, "last_us": last}

    def _time(self, name: str, data: DataSet, header: ExportHeader) -> Numbers | None:
        absolute = _absolute(data, name)
        return self._relative(data, name, header) if absolute is None else absolute

    def _relative(self, data: DataSet, name: str, header: ExportHeader) -> Numbers | None:
        """Times told as a distance from the export, or by the exporter's uptime."""
        before = data.number(_BEFORE_EXPORT[name])
        if before is not None:
            return header.export_us - np.minimum(before, np.uint64(LATEST_US)).astype(np.int64)
        uptimes = data.number(_UPTIME[name])
        now_ms = header.uptime_ms
        if now_ms is None and self._started_ms is not None:
            now_ms = (header.export_us // 1000 - self._started_ms) & 0xFFFF_FFFF
        if uptimes is None or now_ms is None:
            return None
        return uptime_us(uptimes & np.uint64(0xFFFF_FFFF), now_ms, header.export_us)


def _sets(datagram: bytes, start: int) -> Iterator[tuple[int, int, int]]:
    """Id, first byte and end of each set; raises FlowDecodeError."""
    at, found = start, 0
    while len(datagram) - at >= _SET.size:
        number, length = _SET.unpack_from(datagram, at)
        if not _SET.size <= length <= len(datagram) - at:
            raise FlowDecodeError("length", f"a set of {length} bytes where {len(datagram) - at} are left")
        found += 1
        if found > MOST_SETS:
            raise FlowDecodeError("limit", f"over {MOST_SETS} sets in one datagram")
        yield number, at + _SET.size, at + length
        at += length
    if at != len(datagram):
        raise FlowDecodeError("short", f"{len(datagram) - at} bytes after the last set")


def _addresses(data: DataSet) -> dict[str, Numbers] | None:
    """Columns of addresses; None: the records are not about IP.

    A record may have fields for both versions, with those of one all zero.
    """
    found: dict[str, Numbers] = {}
    is_six = np.zeros(data.size, dtype=np.bool_)
    known = False
    for side, (four, six) in (("src", _SOURCES), ("dst", _DESTINATIONS)):
        low, halves = data.number(four, width=4), data.halves(six)
        known = known or low is not None or halves is not None
        lows = np.zeros(data.size, dtype=np.uint64) if low is None else low
        highs = np.zeros(data.size, dtype=np.uint64)
        if halves is not None:
            used = (halves[0] | halves[1]) != 0 if low is not None else np.ones(data.size, dtype=np.bool_)
            highs, lows = np.where(used, halves[0], highs), np.where(used, halves[1], lows)
            is_six |= used
        found |= {f"ip_{side}_hi": highs, f"ip_{side}_lo": lows}
    found["ip_version"] = np.where(is_six, 6, 4)
    return found if known else None


def _icmp(data: DataSet) -> dict[str, Numbers]:
    both = data.number(*_ICMP_BOTH)
    kind, code = data.number(*_ICMP_TYPE), data.number(*_ICMP_CODE)
    found: dict[str, Numbers] = {}
    protocol = data.number(4)
    if protocol is None:
        return found
    other = ~np.isin(protocol, (1, 58))
    for name, column in (
        ("icmp_type", _upper(both) if kind is None else kind),
        ("icmp_code", both if code is None else code),
    ):
        if column is not None:
            values = (column & np.uint64(0xFF)).astype(np.int64)
            values[other] = -1
            found[name] = values
    return found


def _upper(both: NDArray[np.uint64] | None) -> NDArray[np.uint64] | None:
    return None if both is None else both >> np.uint64(8)


def _absolute(data: DataSet, name: str) -> Numbers | None:
    """Times told as such."""
    for element, scale in _ABSOLUTE[name].items():
        times = data.number(element)
        if times is not None:
            return np.minimum(times, np.uint64(LATEST_US // scale)).astype(np.int64) * scale
    times = data.number(*_NTP[name])
    if times is None:
        return None
    seconds = (times >> np.uint64(32)).astype(np.int64) - _NTP_EPOCH
    fraction = (times & np.uint64(0xFFFF_FFFF)) * np.uint64(1_000_000) >> np.uint64(32)
    return seconds * 1_000_000 + fraction.astype(np.int64)
