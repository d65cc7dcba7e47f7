"""Record batches as the Sonata adapter sends them: SYNs, SYN-ACKs and ARP packets of a few words each."""

import ipaddress
from collections.abc import Sequence
from typing import Any

import numpy as np

from apps.packets import PACKET_COLUMNS
from due import RecordBatch

_LOW = (1 << 64) - 1


def records(rows: Sequence[dict[str, Any]]) -> RecordBatch:
    """Rows with some of the packet columns; `src` and `dst` are addresses, what is missing is absent."""
    empty = {name: -1 if kind[0] == "i" else 0 for name, kind in PACKET_COLUMNS.items()}
    full = [empty | {"time_us": 0} | _addresses(row) for row in rows]
    return RecordBatch(
        {name: np.array([row[name] for row in full], kind) for name, kind in PACKET_COLUMNS.items()}
    )


def _addresses(row: dict[str, Any]) -> dict[str, Any]:
    found = {name: value for name, value in row.items() if name not in ("src", "dst")}
    for name in {"src", "dst"} & row.keys():
        address = ipaddress.ip_address(row[name])
        found |= {f"ip_{name}_hi": int(address) >> 64, f"ip_{name}_lo": int(address) & _LOW}
        found["ip_version"] = address.version
    return found


def syn_ack(client: str, client_port: int, server: str, expected: int, **more: Any) -> dict[str, Any]:
    """An answer of port 80."""
    fields = {"src": server, "tcp_sport": 80, "dst": client, "tcp_dport": client_port, "tcp_ack": expected}
    macs = {"eth_src": 0x020000000001, "eth_dst": 0x020000000002, "port": 3, "tcp_flags": 0x12}
    return fields | macs | more


def arp(seconds: float, port: int, mac: int, address: str, **more: Any) -> dict[str, Any]:
    """A station that says which address it has."""
    said = {"arp_op": 1, "eth_src": mac, "arp_src_mac": mac, "arp_src_ip": int(ipaddress.ip_address(address))}
    return said | {"time_us": int(seconds * 1e6), "port": port} | more


def spoofed_syns(
    number: int, server: str, port: int, *, first: int, start_us: int, step_us: int
) -> RecordBatch:
    """SYNs from as many sources, made without a loop."""
    target = int(ipaddress.IPv4Address(server))
    zeros = np.zeros(number, np.uint64)
    return RecordBatch(
        {
            "ip_src_hi": zeros,
            "ip_src_lo": np.arange(first, first + number, dtype=np.uint64),
            "ip_dst_hi": zeros,
            "ip_dst_lo": np.full(number, target, np.uint64),
            "ip_version": np.full(number, 4, np.uint8),
            "tcp_dport": np.full(number, port, np.int32),
            "time_us": start_us + step_us * np.arange(number, dtype=np.int64),
        }
    )
