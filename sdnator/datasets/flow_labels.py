"""Labels of packets from labels of flows: by addresses, ports, protocol and time.

    capture ──► key and time of each packet, sorted ─┐
    flows   ──► key, begin and end of each attack ───┴─► packets between begin and end ──► Labels

A packet is one of an attack when the *originator* of a flow with such a label sent it, to the flow's
destination, within the flow's time and a second around it.  Replies of victims are not: they are benign,
as in all labels of this product.  Where flows of two labels share their key and time (CICIDS2017 knows
minutes only), the attack wins.  Packets without ports of their own (fragments, quoted headers) match flows
of protocols without ports only.
"""

import ipaddress
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from sdnator.capture.labels import Labels
from sdnator.capture.packet_sources import Batch, CaptureSource
from sdnator.datasets.flow_tables import FlowTableError, LabelledFlow

SLACK_NS: Final = 1_000_000_000
"""How far the clocks of a capture and of its flows may be apart."""
_CHUNK: Final = 65_536
_LOW: Final = (1 << 64) - 1
_TCP, _UDP = 6, 17

_Numbers = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class FlowLabels:
    """Labels that were made from flows, and how well both fit together."""

    labels: Labels
    flows: int
    """Flows that the tables label as attacks."""
    flows_found: int
    """Those of them of which the capture has at least one packet."""


def labels_of_flows(capture: Path, flows: Iterable[LabelledFlow]) -> FlowLabels:
    """Label each packet of a capture; memory grows with its packets, not with the flows.

    Raises:
        CaptureError, TsvError: the capture cannot be read.
        FlowTableError: the flows cannot be read, or none of the attacks is in the capture.
    """
    packets = _Packets(CaptureSource(capture))
    found, count = 0, 0
    attacks = (flow for flow in flows if flow.attack)
    while chunk := tuple(islice(attacks, _CHUNK)):
        count += len(chunk)
        found += packets.mark(chunk)
    if count and not found:
        raise FlowTableError(
            f"{capture}: none of {count:,} flows that are labelled as attacks has a packet in it; give the table "
            "that belongs to this capture, and check by how much its clock is ahead of UTC"
        )
    return FlowLabels(packets.labels(), count, found)


class _Packets:
    """Keys and times of all packets, sorted, and a balance of attacks that begin and end there."""

    def __init__(self, source: Iterable[Batch]) -> None:
        keys, times, senders = [np.zeros(0, np.uint64)], [np.zeros(0, np.int64)], [np.zeros(0, np.int32)]
        self._names: dict[tuple[int, int, int], int] = {}
        for batch in source:
            keys.append(_packet_keys(batch))
            times.append(np.asarray(batch["time_ns"]))
            senders.append(self._senders(batch))
        self._sender, time_ns = np.concatenate(senders), np.concatenate(times)
        self._known, rank = np.unique(np.concatenate(keys), return_inverse=True)
        self._first = int(time_ns.min()) if len(time_ns) else 0
        span = int(time_ns.max()) - self._first if len(time_ns) else 0
        self._tick = 1_000
        while (span // self._tick + 2) * (len(self._known) + 1) >= 1 << 62:
            self._tick *= 10
        self._span = span // self._tick + 2
        place = rank.astype(np.int64) * self._span + (time_ns - self._first) // self._tick
        self._order = np.argsort(place, kind="stable")
        self._place = place[self._order]
        self._balance = np.zeros(len(place) + 1, np.int64)

    def mark(self, flows: tuple[LabelledFlow, ...]) -> int:
        """Mark the packets of attacks; returns how many of the flows have any."""
        if not len(self._known):
            return 0
        keys = _keys(
            *(np.array([value >> 64 for value in side], np.uint64) for side in _ends(flows)),
            *(np.array([value & _LOW for value in side], np.uint64) for side in _ends(flows)),
            np.array([each.source_port for each in flows], np.uint64),
            np.array([each.destination_port for each in flows], np.uint64),
            np.array([each.protocol for each in flows], np.uint64),
        )
        rank = np.minimum(np.searchsorted(self._known, keys), len(self._known) - 1)
        here = self._known[rank] == keys
        base = rank.astype(np.int64) * self._span
        begin = self._relative([each.begin_ns - SLACK_NS for each in flows])
        end = self._relative([each.end_ns + SLACK_NS for each in flows])
        first = np.searchsorted(self._place, base + begin, "left")
        behind = np.searchsorted(self._place, base + end, "right")
        here &= behind > first
        np.add.at(self._balance, first[here], 1)
        np.subtract.at(self._balance, behind[here], 1)
        return int(np.count_nonzero(here))

    def labels(self) -> Labels:
        attack = np.zeros(len(self._order), np.bool_)
        attack[self._order] = np.cumsum(self._balance)[:-1] > 0
        used, sender = np.unique(np.where(attack, self._sender, -1), return_inverse=True)
        addresses = list(self._names)
        names = [_shown(addresses[number]) for number in used.tolist() if number >= 0]
        shift = 0 if len(used) and used[0] < 0 else 1
        return Labels(attack, (sender + shift).astype(np.int32), ("", *names))

    def _relative(self, times_ns: list[int]) -> _Numbers:
        ticks = (np.array(times_ns, np.int64) - self._first) // self._tick
        return np.clip(ticks, -1, self._span - 1)  # no packet of any key is at either end

    def _senders(self, batch: Batch) -> npt.NDArray[np.int32]:
        triples = zip(
            batch["ip_version"].tolist(),
            batch["ip_src_hi"].tolist(),
            batch["ip_src_lo"].tolist(),
            strict=True,
        )
        names = self._names
        return np.fromiter((names.setdefault(each, len(names)) for each in triples), np.int32)


def _ends(flows: tuple[LabelledFlow, ...]) -> Iterator[list[int]]:
    yield [each.source for each in flows]
    yield [each.destination for each in flows]


def _packet_keys(batch: Batch) -> npt.NDArray[np.uint64]:
    protocol, own = batch["ip_proto"], batch["quoted"] == 0
    ports = []
    for end in ("sport", "dport"):
        tcp = np.where((protocol == _TCP) & own, batch[f"tcp_{end}"], 0)
        udp = np.where((protocol == _UDP) & own, batch[f"udp_{end}"], 0)
        ports.append(np.maximum(np.maximum(tcp, udp), 0).astype(np.uint64))
    return _keys(
        *(batch[name].astype(np.uint64) for name in ("ip_src_hi", "ip_dst_hi", "ip_src_lo", "ip_dst_lo")),
        *ports,
        np.maximum(protocol, 0).astype(np.uint64),
    )


def _keys(*columns: _Numbers) -> npt.NDArray[np.uint64]:
    """64 bits that stand for a row of numbers (the finalizer of MurmurHash3 over each)."""
    key: npt.NDArray[np.uint64] = np.full(len(columns[0]), 0x9E3779B97F4A7C15, np.uint64)
    for column in columns:
        key = (key ^ column) * np.uint64(0xFF51AFD7ED558CCD)
        key ^= key >> np.uint64(33)
        key *= np.uint64(0xC4CEB9FE1A85EC53)
        key ^= key >> np.uint64(29)
    return key


def _shown(address: tuple[int, int, int]) -> str:
    version, high, low = address
    if version == 6:
        return str(ipaddress.IPv6Address(high << 64 | low))
    return str(ipaddress.IPv4Address(low & 0xFFFFFFFF))
