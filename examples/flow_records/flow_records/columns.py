"""The flow record: a `RecordBatch` with the columns of `FLOW_COLUMNS`, one row a record, is the value of every item
under `network.flows.flow_records.<exporter>`.

Columns that are also packet columns (`apps.packets`) mean the same.  Absent is -1 for signed columns, else 0.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.messages import LATEST_NS, MessageError
from apps.packets import read_columns
from due import RecordBatch

FLOWS: Final = "network.flows.flow_records"
EXPORTER: Final = "network.exporter.flow_records"

FLOW_COLUMNS: Final[dict[str, str]] = {
    # us since the epoch, UTC: when the record was exported (sFlow: received), and the flow's first and last packet
    "time_us": "i8",
    "first_us": "i8",
    "last_us": "i8",
    "ip_version": "u1",
    "ip_src_hi": "u8",
    "ip_src_lo": "u8",
    "ip_dst_hi": "u8",
    "ip_dst_lo": "u8",
    "ip_proto": "i4",
    "src_port": "i4",  # of TCP, UDP, UDP-Lite and SCTP
    "dst_port": "i4",
    "tcp_flags": "u1",  # of all packets together
    "icmp_type": "i4",  # ICMPv4 and ICMPv6
    "icmp_code": "i4",
    "tos": "u1",
    # estimates: what the exporter counted, times its sampling rate
    "packets": "u8",
    "bytes": "u8",  # from the IP header on; sFlow: whole frames
    "sampling": "u4",  # 1 of so many packets was looked at
    "input": "u4",  # interfaces, as the exporter numbers them
    "output": "u4",
    "vlan": "i4",
    "eth_src": "u8",
    "eth_dst": "u8",
}
"""Column name to numpy dtype."""

MOST_SAMPLING: Final = 1 << 20
"""Sampling rates above are taken as this one."""
MOST_COUNT: Final = 1 << 40
"""Packets and bytes of one record above are taken as this many, before they are multiplied with the sampling rate."""
LATEST_US: Final = LATEST_NS // 1000
_WITH_PORTS: Final = (6, 17, 132, 136)
_ICMP: Final = (1, 58)
_MASKS: Final = {
    "ip_version": 0xF,
    "ip_proto": 0xFF,
    "tcp_flags": 0xFF,
    "tos": 0xFF,
    "icmp_type": 0xFF,
    "icmp_code": 0xFF,
    "src_port": 0xFFFF,
    "dst_port": 0xFFFF,
    "vlan": 0xFFF,
    "input": 0xFFFF_FFFF,
    "output": 0xFFFF_FFFF,
    "eth_src": (1 << 48) - 1,
    "eth_dst": (1 << 48) - 1,
}
_RANGES: Final = {
    "first_us": (0, LATEST_US),
    "last_us": (0, LATEST_US),
    "sampling": (1, MOST_SAMPLING),
    "src_port": (-1, 0xFFFF),
    "dst_port": (-1, 0xFFFF),
    "icmp_type": (-1, 0xFF),
    "icmp_code": (-1, 0xFF),
    "packets": (0, MOST_COUNT * MOST_SAMPLING),
    "bytes": (0, MOST_COUNT * MOST_SAMPLING),
}

Numbers = NDArray[Any]


def flow_batch(size: int, given: Mapping[str, Numbers]) -> RecordBatch:
    """Records as a batch with all columns, packets and bytes multiplied with `sampling`.

    Args:
        size: n, the number of records.
        given: columns of FLOW_COLUMNS as whole numbers of any type, shape (n,); others are absent. `packets` and
            `bytes` are as counted.
    """
    columns: dict[str, Numbers] = {}
    for name, kind in FLOW_COLUMNS.items():
        column = given.get(name)
        if column is None:
            columns[name] = np.full(size, -1 if kind[0] == "i" else 0, dtype=kind)
        elif name in _MASKS and column.dtype.kind == "u":
            columns[name] = (column.astype(np.uint64) & np.uint64(_MASKS[name])).astype(kind)
        else:
            columns[name] = column.astype(kind)
    sampling = np.clip(given.get("sampling", np.ones(size, np.uint64)), 1, MOST_SAMPLING).astype(np.uint64)
    columns["sampling"] = sampling.astype(np.uint32)
    for name in ("packets", "bytes"):
        columns[name] = np.minimum(columns[name], np.uint64(MOST_COUNT)) * sampling
    _times(columns)
    _ports(columns)
    return RecordBatch(columns)


def _times(columns: dict[str, Numbers]) -> None:
    for name in ("time_us", "first_us", "last_us"):
        columns[name] = np.clip(columns[name], 0, LATEST_US)
    columns["first_us"] = np.minimum(columns["first_us"], columns["last_us"])


def _ports(columns: dict[str, Numbers]) -> None:
    """Ports of protocols that have them; exporters put the type of ICMP messages into the destination port."""
    protocol = columns["ip_proto"]
    icmp = np.isin(protocol, _ICMP) & (columns["icmp_type"] < 0) & (columns["dst_port"] >= 0)
    columns["icmp_type"][icmp] = columns["dst_port"][icmp] >> 8
    columns["icmp_code"][icmp] = columns["dst_port"][icmp] & 0xFF
    without = ~np.isin(protocol, _WITH_PORTS)
    for name in ("src_port", "dst_port"):
        columns[name][without] = -1


def read_flows(value: object) -> RecordBatch:
    """Check a received batch of flow records; raises `MessageError`."""
    flows = read_columns(value, FLOW_COLUMNS, "flows")
    for name, (low, high) in _RANGES.items():
        column = flows[name]
        if len(column) and not low <= int(column.min()) <= int(column.max()) <= high:
            raise MessageError("range", f"flows: {name} is not within {low} to {high}")
    return flows


def joined(batches: list[RecordBatch]) -> RecordBatch:
    """Batches of flow records as one."""
    if len(batches) == 1:
        return batches[0]
    return RecordBatch({name: np.concatenate([batch[name] for batch in batches]) for name in FLOW_COLUMNS})
