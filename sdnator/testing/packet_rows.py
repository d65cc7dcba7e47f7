"""Packets as columns: blank ones, those of a tshark table, and tshark's fields for given columns."""

import gzip
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from apps.packets import PACKET_COLUMNS
from due import RecordBatch

FIELDS = [
    "frame.time_epoch",
    "frame.len",
    "eth.src",
    "eth.dst",
    "ip.src",
    "ip.dst",
    "tcp.srcport",
    "tcp.dstport",
    "udp.srcport",
    "udp.dstport",
    "icmp.type",
    "icmp.code",
    "arp.opcode",
    "arp.src.hw_mac",
    "arp.src.proto_ipv4",
    "arp.dst.hw_mac",
    "arp.dst.proto_ipv4",
    "ipv6.src",
    "ipv6.dst",
]
"""Columns of the tables that the published Kitsune reads."""


def blank(count: int, **columns: Any) -> RecordBatch:
    """A batch of packets in which only the given columns are set.

    Args:
        count: n, the number of packets.
        columns: of `apps.packets.PACKET_COLUMNS`, each a number for all packets or shape (n,).
    """
    batch = {
        name: np.full(count, -1 if kind[0] == "i" else 0, dtype=kind) for name, kind in PACKET_COLUMNS.items()
    }
    batch["arrival"] = np.arange(count, dtype="u8")
    batch["sequence"] = batch["arrival"] + 1
    batch["length"] += 60
    batch["time_us"][:] = 0
    batch |= {name: np.asarray(values, dtype=PACKET_COLUMNS[name]) for name, values in columns.items()}
    return RecordBatch(batch)


def part(batch: RecordBatch, start: int, stop: int) -> RecordBatch:
    """Rows `start` to `stop` of a batch, without that one."""
    return RecordBatch({name: batch[name][start:stop] for name in batch})


def tsv_rows(table: Path, limit: int | None = None) -> Iterator[dict[str, str]]:
    """The packets of a table, each as field to text.

    Args:
        table: gzip of FIELDS separated by tabs, after one line of headings.
        limit: packets at most; None: all.
    """
    with gzip.open(table, "rt") as text:
        next(text)
        for number, line in enumerate(text):
            if number == limit:
                return
            yield dict(zip(FIELDS, line.rstrip("\n").split("\t"), strict=True))


def batch_of(rows: Iterable[Mapping[str, str]]) -> RecordBatch:
    """tshark's fields, as `tsv_rows` gives them, as a batch with the columns of `apps.packets`."""
    columns: dict[str, list[int]] = {name: [] for name in PACKET_COLUMNS}
    for number, fields in enumerate(rows):
        for name, value in _columns(number, fields).items():
            columns[name].append(value)
    return RecordBatch({name: np.array(columns[name], dtype=kind) for name, kind in PACKET_COLUMNS.items()})


def _columns(number: int, fields: Mapping[str, str]) -> dict[str, int]:
    seconds, fraction = fields["frame.time_epoch"].split(".")
    version = 4 if fields["ip.src"] else 6 if fields["ipv6.src"] else 0
    prefix = "ip" if version == 4 else "ipv6"
    source, destination = _halves(fields[f"{prefix}.src"]), _halves(fields[f"{prefix}.dst"])
    signed = {
        "tcp_sport": "tcp.srcport",
        "tcp_dport": "tcp.dstport",
        "udp_sport": "udp.srcport",
        "udp_dport": "udp.dstport",
        "icmp_type": "icmp.type",
        "icmp_code": "icmp.code",
        "arp_op": "arp.opcode",
    }
    row = dict.fromkeys(PACKET_COLUMNS, 0) | {
        name: int(fields[field] or -1) for name, field in signed.items()
    }
    return row | {
        "sequence": number + 1,
        "arrival": number,
        "time_us": int(seconds) * 1_000_000 + int(fraction[:6]),
        "port": 1,
        "length": int(fields["frame.len"]),
        "eth_src": _mac(fields["eth.src"]),
        "eth_dst": _mac(fields["eth.dst"]),
        "vlan": -1,
        "arp_src_mac": _mac(fields["arp.src.hw_mac"]),
        "arp_src_ip": _halves(fields["arp.src.proto_ipv4"])[1],
        "arp_dst_mac": _mac(fields["arp.dst.hw_mac"]),
        "arp_dst_ip": _halves(fields["arp.dst.proto_ipv4"])[1],
        "ip_version": version,
        "ip_src_hi": source[0],
        "ip_src_lo": source[1],
        "ip_dst_hi": destination[0],
        "ip_dst_lo": destination[1],
        "ip_proto": -1,
        "quoted": int(bool(fields["icmp.type"] and (fields["tcp.srcport"] or fields["udp.srcport"]))),
        "icmp6_type": -1,
        "icmp6_code": -1,
    }


def _mac(text: str) -> int:
    return int(text.replace(":", ""), 16) if text else 0


def _halves(text: str) -> tuple[int, int]:
    if not text:
        return 0, 0
    if ":" not in text:
        return 0, int.from_bytes(socket.inet_aton(text), "big")
    packed = socket.inet_pton(socket.AF_INET6, text)
    return int.from_bytes(packed[:8], "big"), int.from_bytes(packed[8:], "big")


def tshark_fields(batch: RecordBatch, times: Iterable[str]) -> Iterator[dict[str, str]]:
    """The text fields that tshark would show for each row.

    Args:
        batch: n packets with the columns of `apps.packets`.
        times: n times, seconds as text.
    """
    for number, time in enumerate(times):
        value = {name: int(batch[name][number]) for name in PACKET_COLUMNS}
        is_arp, version = value["arp_op"] >= 0, value["ip_version"]
        yield {
            "frame.time_epoch": time,
            "frame.len": str(value["length"]),
            "eth.src": value["eth_src"].to_bytes(6, "big").hex(":"),
            "eth.dst": value["eth_dst"].to_bytes(6, "big").hex(":"),
            "ip.src": _address(value, "src") if version == 4 else "",
            "ip.dst": _address(value, "dst") if version == 4 else "",
            "tcp.srcport": _shown(value["tcp_sport"]),
            "tcp.dstport": _shown(value["tcp_dport"]),
            "udp.srcport": _shown(value["udp_sport"]),
            "udp.dstport": _shown(value["udp_dport"]),
            "icmp.type": _shown(value["icmp_type"]),
            "arp.opcode": _shown(value["arp_op"]),
            "arp.src.proto_ipv4": socket.inet_ntoa(value["arp_src_ip"].to_bytes(4, "big")) if is_arp else "",
            "arp.dst.proto_ipv4": socket.inet_ntoa(value["arp_dst_ip"].to_bytes(4, "big")) if is_arp else "",
            "ipv6.src": _address(value, "src") if version == 6 else "",
            "ipv6.dst": _address(value, "dst") if version == 6 else "",
        }


def _shown(value: int) -> str:
    return "" if value < 0 else str(value)


def _address(value: Mapping[str, int], side: str) -> str:
    hi, lo = value[f"ip_{side}_hi"], value[f"ip_{side}_lo"]
    if value["ip_version"] == 4:
        return socket.inet_ntoa(lo.to_bytes(4, "big"))
    return socket.inet_ntop(socket.AF_INET6, hi.to_bytes(8, "big") + lo.to_bytes(8, "big"))
