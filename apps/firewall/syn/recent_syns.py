"""The most recent SYNs, and hosts that receive a surge of them.

Their sources are examined only when a flood is suspected.
"""

import ipaddress
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from apps.firewall.evidence.recent_rows import RecentRows
from due import RecordBatch

HOSTS = 65_536
"""Destinations counted in a window; beyond that number counting starts again."""
_HALF = 64
_SET_BACK = 1_000
"""Windows; a SYN that is this far behind the current one means that a clock was set back."""
SYN_COLUMNS = ("time_us", "ip_version", "ip_src_hi", "ip_src_lo", "ip_dst_hi", "ip_dst_lo", "tcp_dport")


class RecentSyns:
    """Keeps at least the last `rows` SYNs."""

    def __init__(self, rows: int) -> None:
        self._recent = RecentRows(SYN_COLUMNS, rows)

    def __len__(self) -> int:
        return len(self._recent)

    def add(self, batch: RecordBatch, now: float = 0.0) -> None:
        """Add SYNs that arrived at `now`, s; raises KeyError for a missing column."""
        self._recent.add(batch, now)

    def towards(self, host: str, since: int, until: int | None = None) -> Iterator[tuple[int, str]]:
        """Destination port and source address of SYNs to a host, `since` and `until` in capture time, ns."""
        address = ipaddress.ip_address(host)
        high, low = int(address) >> _HALF, int(address) & ((1 << _HALF) - 1)
        make = ipaddress.IPv4Address if address.version == 4 else ipaddress.IPv6Address
        for _, block in self._recent.blocks():
            wanted = (block["ip_version"] == address.version) & (block["time_us"] >= since // 1000)
            if until is not None:
                wanted &= block["time_us"] <= until // 1000
            wanted &= (block["ip_dst_hi"] == np.uint64(high)) & (block["ip_dst_lo"] == np.uint64(low))
            columns = (block[name][wanted].tolist() for name in ("ip_src_hi", "ip_src_lo", "tcp_dport"))
            for source_high, source_low, port in zip(*columns, strict=True):
                yield port, str(make(source_high << _HALF | source_low))


class Surge(NamedTuple):
    """A host to which the threshold of SYNs went within a window; times are capture time, ns."""

    host: str
    window: int
    """Begin of the window."""
    at: int
    """When the threshold was reached."""


class Surges:
    """Hosts to which `threshold` SYNs went within one window of `window_ms`."""

    def __init__(self, threshold: int, window_ms: int) -> None:
        self._threshold = threshold
        self._window_us = window_ms * 1000
        self._window = -1
        self._counts: Counter[tuple[int, int, int]] = Counter()

    @property
    def hosts(self) -> int:
        """Destinations counted in the current window."""
        return len(self._counts)

    def add(self, batch: RecordBatch) -> list[Surge]:
        """Hosts that reach the threshold with this batch; how SYNs are divided into batches does not matter."""
        if not len(batch):
            return []
        numbers = batch["time_us"] // self._window_us
        surging: list[Surge] = []
        for window in np.unique(numbers).tolist():
            if window > self._window or self._window - window > _SET_BACK:
                self._window = window
                self._counts.clear()
            if window == self._window:
                surging += self._count(batch.take(np.flatnonzero(numbers == window)))
        return surging

    def _count(self, batch: RecordBatch) -> list[Surge]:
        if len(self._counts) > HOSTS:
            self._counts.clear()
        times, fields = batch["time_us"], ("ip_version", "ip_dst_hi", "ip_dst_lo")
        surging = []
        for host, count in Counter(zip(*(batch[name].tolist() for name in fields), strict=True)).items():
            before = self._counts[host]
            self._counts[host] = before + count
            version, high, low = host
            if before < self._threshold <= before + count and version:
                theirs = np.logical_and.reduce(
                    [batch[name] == value for name, value in zip(fields, host, strict=True)]
                )
                reached_us = int(times[np.flatnonzero(theirs)[self._threshold - before - 1]])
                make = ipaddress.IPv4Address if version == 4 else ipaddress.IPv6Address
                begin = self._window * self._window_us * 1000
                surging.append(Surge(str(make(high << _HALF | low)), begin, reached_us * 1000))
        return sorted(surging, key=lambda surge: surge.at)
