"""NetFlow v5: a header of 24 bytes and up to 30 records of 48, as Cisco documents them."""

import struct
from typing import Final

import numpy as np

from due import RecordBatch
from flow_records.columns import Numbers, flow_batch
from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.octets import numbers, octets_of

_HEADER: Final = struct.Struct("!HHIIIIBBH")
_RECORD: Final = 48
_MOST: Final = 30
_FIELDS: Final = {
    "ip_src_lo": (0, 4),
    "ip_dst_lo": (4, 4),
    "input": (12, 2),
    "output": (14, 2),
    "packets": (16, 4),
    "bytes": (20, 4),
    "src_port": (32, 2),
    "dst_port": (34, 2),
    "tcp_flags": (37, 1),
    "ip_proto": (38, 1),
    "tos": (39, 1),
}
"""Column to offset and width in a record."""
_FIRST, _LAST = 24, 28


class NetFlow5:
    """One datagram, checked.

    Args:
        datagram: its bytes, the version included.

    Raises:
        FlowDecodeError: it is shorter or longer than its number of records.
    """

    def __init__(self, datagram: bytes) -> None:
        if len(datagram) < _HEADER.size:
            raise FlowDecodeError("short", f"NetFlow v5: {len(datagram)} bytes are no header")
        (_, self.count, self._uptime_ms, seconds, nanoseconds, self.sequence, kind, engine, sampling) = (
            _HEADER.unpack_from(datagram)
        )
        if not 1 <= self.count <= _MOST or len(datagram) != _HEADER.size + self.count * _RECORD:
            text = f"NetFlow v5: {self.count} records do not fill {len(datagram)} bytes"
            raise FlowDecodeError("count", text)
        self.engine = kind << 8 | engine
        """Numbers of flows are counted by engine."""
        self.export_us = seconds * 1_000_000 + nanoseconds // 1000
        self._sampling = sampling & 0x3FFF
        self._octets = octets_of(datagram)

    def flows(self, sampling: int) -> RecordBatch:
        """Its records; `sampling` is the rate where the header has none."""
        at = _HEADER.size + _RECORD * np.arange(self.count)
        found: dict[str, Numbers] = {
            name: numbers(self._octets, at + offset, width) for name, (offset, width) in _FIELDS.items()
        }
        found["time_us"] = np.full(self.count, self.export_us)
        for name, offset in (("first_us", _FIRST), ("last_us", _LAST)):
            uptimes = numbers(self._octets, at + offset, 4)
            found[name] = uptime_us(uptimes, self._uptime_ms, self.export_us)
        found["ip_version"] = np.full(self.count, 4)
        found["sampling"] = np.full(self.count, self._sampling or sampling)
        return flow_batch(self.count, found)


def uptime_us(uptimes: Numbers, now_ms: int, now_us: int) -> Numbers:
    """Times told as milliseconds since the exporter's start, a clock of 32 bits that wraps after 49.7 days.

    Args:
        uptimes: shape (n,).
        now_ms: the same clock at a known time.
        now_us: that time, us since the epoch.

    Returns:
        us since the epoch, shape (n,): of all times that may be meant the one closest to `now_us`.
    """
    ago = (np.int64(now_ms) - uptimes.astype(np.int64)) & 0xFFFF_FFFF
    ago[ago >= 1 << 31] -= 1 << 32
    return now_us - ago * 1000
