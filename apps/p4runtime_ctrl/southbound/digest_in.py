"""Digest lists of a switch → packet records, with the results of the counting stages for each frame.

A digest holds the header fields that the switch's parser found: the same columns as of a copied frame,
many frames to a message.  What the parser does not cover (`coverage`) is absent in its row.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.errors import P4InfoError
from apps.p4runtime_ctrl.southbound.capture_times import CaptureTimes
from apps.p4runtime_ctrl.southbound.digest_columns import DigestColumns
from apps.p4runtime_ctrl.southbound.digest_rows import read_lists
from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker
from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.rows import RowLayout, has_bit
from apps.p4runtime_ctrl.telemetry.coverage import uncovered
from apps.packets import PACKET_COLUMNS
from due import RecordBatch

FRAME_DIGEST: Final = "frame_digest_t"
_NEEDED: Final = frozenset(
    ("queries", "crossed", "overflow", "fragment", "timestamp", "arrival", "sequence", "ingress_port", "vid",
     "ethertype", "length", "eth_src", "eth_dst", "src", "dst", "protocol", "l4_valid", "quoted",
     "quoted_protocol", "sport", "dport", "tcp_flags", "tcp_sequence", "tcp_acknowledgement", "icmp_type",
     "icmp_code", "arp_operation", "arp_sender_mac", "arp_target_mac")
)  # fmt: skip
_ARP, _IPV4, _IPV6 = 0x0806, 0x0800, 0x86DD
_TCP, _UDP, _ICMP, _ICMP6 = 6, 17, 1, 58
_LEAST_ETHERTYPE: Final = 0x600


@dataclass(frozen=True)
class DigestReports:
    """Frames of digest lists."""

    columns: dict[str, NDArray[Any]]
    queries: NDArray[np.uint8]
    """Which requests for digests each frame met: 256 bits a row."""
    crossed: NDArray[np.uint8]
    """Counting queries whose threshold the frame's key reached with it."""
    overflow: NDArray[np.uint8]
    """Counting queries that had no cell for the frame's key."""
    covered: NDArray[np.bool_]
    """Whether the row has all fields that the frame would give."""

    def __len__(self) -> int:
        return len(self.queries)

    def counted(self, bit: int) -> RecordBatch:
        """Frames that a query reports, with the columns `crossed` and `overflow` (0 or 1) beside."""
        crossed, overflow = has_bit(self.crossed, bit), has_bit(self.overflow, bit)
        rows = has_bit(self.queries, bit) | crossed | overflow
        return self._batch(rows, {"crossed": crossed.astype(np.uint8), "overflow": overflow.astype(np.uint8)})

    def _batch(self, rows: NDArray[np.bool_], more: dict[str, NDArray[Any]]) -> RecordBatch:
        columns = self.columns | more
        return RecordBatch(
            columns if rows.all() else {name: column[rows] for name, column in columns.items()}
        )


class DigestReader:
    """Reads the digests of one switch and records them in `progress`; `base_us` and `times` as in `PacketReader`.

    Raises `P4InfoError` where the program's digest lacks a field.
    """

    def __init__(
        self, program: ProgramInfo, base_us: int, progress: LossTracker, times: CaptureTimes | None = None
    ) -> None:
        fields = program.digest(FRAME_DIGEST)
        missing = sorted(_NEEDED - {name for name, _ in fields})
        if missing:
            raise P4InfoError(
                f"digest {FRAME_DIGEST} of the program lacks {', '.join(missing)}; load the program of SDNator"
            )
        self.digest_id = program.digest_id(FRAME_DIGEST)
        self._layout = RowLayout(fields)
        self._columns = DigestColumns.of(self._layout)
        self._base_us = base_us
        self._times = times
        self._progress = progress

    def read(self, lists: Sequence[Any]) -> DigestReports:
        """Columns of all frames in the lists, in order."""
        found, malformed = read_lists(self._layout, lists)
        self._progress.malformed += malformed
        if self._columns is not None:
            columns, covered = self._columns.read(found, self._base_us)
        else:
            columns, covered = columns_of(found, self._base_us), ~uncovered(found)
        if self._times is not None:
            columns["time_us"] = self._times.of(columns["arrival"])
        self._progress.digests(columns["sequence"], columns["arrival"], columns["time_us"])
        return DigestReports(columns, found["queries"], found["crossed"], found["overflow"], covered)


def columns_of(found: NDArray[Any], base_us: int) -> dict[str, NDArray[Any]]:
    """What `DigestColumns` reads, without a library.

    Args:
        found: records of the digest's layout.
        base_us: added to their times.
    """
    ethertype = found["ethertype"].astype(np.uint16)
    given = {
        "sequence": found["sequence"],
        "arrival": found["arrival"],
        "time_us": found["timestamp"].astype(np.int64) + base_us,
        "port": found["ingress_port"],
        "length": found["length"],
        "eth_src": found["eth_src"],
        "eth_dst": found["eth_dst"],
        "eth_type": np.where(ethertype >= _LEAST_ETHERTYPE, ethertype, 0),
        "vlan": _where(found["vid"] > 0, found["vid"]),
        **_arp(found, ethertype == _ARP),
        **_ip(found, ethertype),
        **_transport(found, (ethertype == _IPV4) | (ethertype == _IPV6)),
    }
    return {name: given[name].astype(kind) for name, kind in PACKET_COLUMNS.items()}


def _where(condition: NDArray[np.bool_], values: NDArray[Any], absent: int = -1) -> NDArray[np.int64]:
    return np.where(condition, values.astype(np.int64), absent)


def _zeroed(condition: NDArray[np.bool_], values: NDArray[Any]) -> NDArray[np.uint64]:
    return np.where(condition, values.astype(np.uint64), np.uint64(0))


def _arp(found: NDArray[Any], arp: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    read = arp & (found["arp_operation"] != 0)
    return {
        "arp_op": _where(read, found["arp_operation"]),
        "arp_src_mac": _zeroed(read, found["arp_sender_mac"]),
        "arp_src_ip": _zeroed(read, found["src"][:, 1]),
        "arp_dst_mac": _zeroed(read, found["arp_target_mac"]),
        "arp_dst_ip": _zeroed(read, found["dst"][:, 1]),
    }


def _ip(found: NDArray[Any], ethertype: NDArray[np.uint16]) -> dict[str, NDArray[Any]]:
    four, six = ethertype == _IPV4, ethertype == _IPV6
    ip = four | six
    return {
        "ip_version": np.where(four, 4, np.where(six, 6, 0)),
        "ip_src_hi": _zeroed(ip, found["src"][:, 0]),
        "ip_src_lo": _zeroed(ip, found["src"][:, 1]),
        "ip_dst_hi": _zeroed(ip, found["dst"][:, 0]),
        "ip_dst_lo": _zeroed(ip, found["dst"][:, 1]),
        "ip_proto": _where(ip, found["protocol"]),
    }


def _transport(found: NDArray[Any], ip: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    own = ip & (found["l4_valid"] == 1)
    protocol, quoted = found["protocol"], ip & (found["quoted"] == 1)
    tcp, udp = own & (protocol == _TCP), own & (protocol == _UDP)
    tcp_ports = tcp | (quoted & (found["quoted_protocol"] == _TCP))
    udp_ports = udp | (quoted & (found["quoted_protocol"] == _UDP))
    icmp, icmp6 = own & (protocol == _ICMP), own & (protocol == _ICMP6)
    return {
        "tcp_sport": _where(tcp_ports, found["sport"]),
        "tcp_dport": _where(tcp_ports, found["dport"]),
        "udp_sport": _where(udp_ports, found["sport"]),
        "udp_dport": _where(udp_ports, found["dport"]),
        "quoted": quoted & (tcp_ports | udp_ports),
        "tcp_flags": _zeroed(tcp, found["tcp_flags"]),
        "tcp_seq": _zeroed(tcp, found["tcp_sequence"]),
        "tcp_ack": _zeroed(tcp, found["tcp_acknowledgement"]),
        "icmp_type": _where(icmp, found["icmp_type"]),
        "icmp_code": _where(icmp, found["icmp_code"]),
        "icmp6_type": _where(icmp6, found["icmp_type"]),
        "icmp6_code": _where(icmp6, found["icmp_code"]),
    }
