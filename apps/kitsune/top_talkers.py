"""Top talkers: packets and bytes by sender, over windows of capture time.  Pure.

    batches of packets ──add──► sums by port and address ──a window is over──► TopTalkers

A sender is an IP address behind a port; what has no IP address goes by its MAC address.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from apps.kitsune.names import ip_text, mac_text
from apps.messages import Sender
from apps.talkers import MOST_TALKERS, Talker, TopTalkers

WINDOW_US: Final = 2_000_000
MOST_SENDERS: Final = 4_096
"""Sums kept in a window; a flood from forged addresses brings more, and those with the fewest bytes are forgotten."""

_SenderKey = tuple[int, int, int, int]
"""Port, IP version (0: none), and the address in two halves; without IP the low one is the MAC address."""


@dataclass(slots=True)
class _Window:
    """Sums since `since`, us."""

    since: int
    last: int = 0
    packets: int = 0
    octets: int = 0
    sums: dict[_SenderKey, tuple[int, int, int]] = field(default_factory=dict)
    """Packets, bytes and the MAC address of the first packet, by sender."""


class TalkerTable:
    """The windows of all switches; switches are as many as the caller lets in."""

    def __init__(self) -> None:
        self._windows: dict[str, _Window] = {}

    def add(self, batch: Any, switch: str) -> TopTalkers | None:
        """Count a batch.

        Args:
            batch: columns of `apps.packets.PACKET_COLUMNS`, n rows, n > 0; times do not go backwards.
            switch: where the packets came in.

        Returns:
            The window that this batch ends, if it does.
        """
        end = int(batch["time_us"][-1])
        window = self._windows.get(switch)
        if window is None or end < window.since:
            window = self._windows[switch] = _Window(int(batch["time_us"][0]))
        _count(window, batch)
        window.last = end
        if end - window.since < WINDOW_US:
            return None
        self._windows[switch] = _Window(end)
        return _told(window, switch)


def _count(window: _Window, batch: Any) -> None:
    version = batch["ip_version"]
    bare = version == 0
    low = np.where(bare, batch["eth_src"], batch["ip_src_lo"])
    columns = (low, np.where(bare, 0, batch["ip_src_hi"]), version, batch["port"])
    order = np.lexsort(columns)
    ordered = [column[order] for column in columns]
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = np.logical_or.reduce([column[1:] != column[:-1] for column in ordered])
    first = np.flatnonzero(is_first)
    lengths = batch["length"][order].astype(np.int64)
    octets = np.add.reduceat(lengths, first)
    packets = np.diff(np.append(first, len(order)))
    macs = batch["eth_src"][order[first]]
    low, high, kinds, ports = (column[first].tolist() for column in ordered)
    keys = zip(ports, kinds, high, low, strict=True)
    for key, count, size, mac in zip(keys, packets.tolist(), octets.tolist(), macs.tolist(), strict=True):
        before = window.sums.get(key, (0, 0, mac))
        window.sums[key] = (before[0] + count, before[1] + size, before[2])
    window.packets += len(order)
    window.octets += int(lengths.sum())
    if len(window.sums) > MOST_SENDERS:
        kept = sorted(window.sums.items(), key=lambda one: -one[1][1])[: MOST_SENDERS // 2]
        window.sums = dict(kept)


def _told(window: _Window, switch: str) -> TopTalkers:
    busiest = sorted(window.sums.items(), key=lambda one: -one[1][1])[:MOST_TALKERS]
    talkers = tuple(
        Talker(
            sender=Sender(switch=switch, port=port, mac=mac_text(mac), ip=ip_text(version, high, low)),
            packets=packets,
            bytes=octets,
        )
        for (port, version, high, low), (packets, octets, mac) in busiest
    )
    return TopTalkers(
        switch=switch,
        since=window.since * 1_000,
        event_time=window.last * 1_000,
        packets=window.packets,
        bytes=window.octets,
        talkers=talkers,
    )
