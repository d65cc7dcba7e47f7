"""What of each kind of flood comes to each host anyway: packets a second in training, and from whom.

    kind   datagrams from a well-known port, to a port, all of them; TCP segments to a port that are no SYNs; pings

A rate limit towards a victim is set from this.  Pure; bounded in hosts and in sources.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from apps.evidence import MOST_USUAL
from apps.kitsune.afterimage import seconds
from apps.kitsune.behaviour.contacts import ANY_UDP, ECHO, FROM_UDP, STRAY_TCP, UDP
from apps.kitsune.behaviour.rows import address_of
from apps.kitsune.kernel import Columns

MOST_KINDS: Final = 65_536
"""Pairs of host and kind that are remembered of training, and within a second."""
MOST_SOURCES: Final = 1_024
"""Sources counted of one pair ..."""
MOST_SOURCES_OF_ALL: Final = 262_144
"""... and of all."""
_WELL_KNOWN: Final = 1_024
_SYN: Final = 0x02
_BACK_S: Final = 60
"""Ports may be this far behind one another; time that goes back farther was set."""

HostKind = tuple[int, int]
"""Address as `address_of` makes it, and kind as a service of `contacts`."""


class UsualTraffic(NamedTuple):
    """Packets of one kind towards one host."""

    rate: float
    """Packets in the newest second."""
    training_rate: float
    """The most of any second of training."""
    sources: tuple[int, ...]
    """Addresses that sent them in training, the busiest first."""
    share: float
    """Part of training's packets that these sources sent."""


class VictimRates:
    """Counts what comes to every host; `add` takes packets in capture order."""

    def __init__(self) -> None:
        self._second = -1
        self._now: Counter[HostKind] = Counter()
        self._last: Counter[HostKind] = Counter()
        self._highest: dict[HostKind, int] = {}
        self._sources: dict[HostKind, Counter[int]] = {}
        self._named = 0
        self._packets: Counter[HostKind] = Counter()

    def add(self, batch: Columns, trained: int) -> None:
        """Take a batch of which the first `trained` packets were training."""
        whole = seconds(batch).astype(np.int64)
        for training, rows in ((True, slice(0, trained)), (False, slice(trained, None))):
            for second, kind, source, count in _grouped(batch, whole, rows):
                if second > self._second or second < self._second - _BACK_S:
                    self._second, self._last, self._now = second, self._now, Counter()
                if kind in self._now or len(self._now) < MOST_KINDS:
                    self._now[kind] += count
                if training:
                    self._learn(kind, source, count)

    def usual(self, victim: int, kind: int) -> UsualTraffic:
        """What came of this kind to a host."""
        key = (victim, kind)
        sources, packets = self._sources.get(key, Counter()), self._packets[key]
        named = sources.most_common(MOST_USUAL)
        return UsualTraffic(
            float(max(self._now[key], self._last[key])),
            float(self._highest.get(key, 0)),
            tuple(source for source, _ in named),
            sum(count for _, count in named) / packets if packets else 0.0,
        )

    def to_state(self) -> list[list[Any]]:
        """What training has taught, as plain values for the model file."""
        return [
            [
                *key,
                highest,
                self._packets[key],
                [list(pair) for pair in self._sources[key].most_common(MOST_USUAL)],
            ]
            for key, highest in self._highest.items()
            if key in self._sources
        ]

    @classmethod
    def from_state(cls, state: Iterable[Any]) -> Self:
        """The inverse of `to_state`.

        Raises:
            TypeError, ValueError: the state is not one.
        """
        self = cls()
        for host, kind, highest, packets, sources in state:
            key = int(host), int(kind)
            self._highest[key], self._packets[key] = int(highest), int(packets)
            self._sources[key] = Counter({int(source): int(count) for source, count in sources})
        return self

    def _learn(self, key: HostKind, source: int, count: int) -> None:
        if key not in self._highest and len(self._highest) >= MOST_KINDS:
            return
        self._highest[key] = max(self._highest.get(key, 0), self._now[key])
        self._packets[key] += count
        sources = self._sources.setdefault(key, Counter())
        if source not in sources:
            if len(sources) >= MOST_SOURCES or self._named >= MOST_SOURCES_OF_ALL:
                return
            self._named += 1
        sources[source] += count


def _grouped(
    batch: Columns, times: npt.NDArray[np.int64], rows: slice
) -> Iterable[tuple[int, HostKind, int, int]]:
    """Second, host and kind, source, and how many packets, in order of time."""
    columns = {name: batch[name][rows] for name in _COLUMNS}
    tcp, udp = columns["tcp_sport"] >= 0, columns["udp_sport"] >= 0
    echo = (columns["icmp_type"] == 8) | (columns["icmp6_type"] == 128)
    has_address = ((columns["ip_version"] == 4) | (columns["ip_version"] == 6)) & (columns["quoted"] == 0)
    whole = times[rows]
    kinds: list[tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]] = [
        (udp & (columns["udp_sport"] < _WELL_KNOWN), FROM_UDP | columns["udp_sport"].astype(np.int64)),
        (udp & (columns["udp_sport"] >= _WELL_KNOWN), UDP | columns["udp_dport"].astype(np.int64)),
        (udp, np.full(len(whole), ANY_UDP)),
        (tcp & (columns["tcp_flags"] & _SYN == 0), STRAY_TCP | columns["tcp_dport"].astype(np.int64)),
        (echo & ~tcp & ~udp, np.full(len(whole), ECHO)),
    ]
    found: list[tuple[int, HostKind, int, int]] = []
    for mine, kind in kinds:
        chosen = mine & has_address
        if not chosen.any():
            continue
        table = np.stack(
            [
                whole[chosen].astype(np.uint64),
                kind[chosen].astype(np.uint64),
                *(columns[name][chosen].astype(np.uint64) for name in _ADDRESSES),
            ],
            axis=1,
        )
        unique, counts = np.unique(table, axis=0, return_counts=True)
        for (second, code, version, *ends), count in zip(unique.tolist(), counts.tolist(), strict=True):
            key = address_of(version, ends[0], ends[1]), code
            found.append((second, key, address_of(version, ends[2], ends[3]), count))
    return sorted(found, key=lambda each: each[0])


_ADDRESSES: Final = ("ip_version", "ip_dst_hi", "ip_dst_lo", "ip_src_hi", "ip_src_lo")
_COLUMNS: Final = (
    *("quoted", "tcp_sport", "tcp_dport", "udp_sport", "udp_dport"),
    *("tcp_flags", "icmp_type", "icmp6_type", *_ADDRESSES),
)
