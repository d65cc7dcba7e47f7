"""`apps.kitsune.victims` packet by packet, in Python."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from apps.evidence import MOST_USUAL
from apps.kitsune import victims as product
from apps.kitsune.afterimage import seconds
from apps.kitsune.behaviour.contacts import ANY_UDP, ECHO, FROM_UDP, STRAY_TCP, UDP
from apps.kitsune.behaviour.rows import address_of
from apps.kitsune.kernel import Columns
from apps.kitsune.victims import BACK_S, HostKind, UsualTraffic

_WELL_KNOWN: Final = 1_024
_SYN: Final = 0x02
_ECHO, _ECHO6 = 8, 128


class PythonVictimRates:
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
        for row, (second, source, host, kinds) in enumerate(_packets(batch)):
            if not kinds:
                continue
            if second > self._second or second < self._second - BACK_S:
                self._second, self._last, self._now = second, self._now, Counter()
            for kind in kinds:
                key = host, kind
                if key in self._now or len(self._now) < product.MOST_KINDS:
                    self._now[key] += 1
                if row < trained:
                    self._learn(key, source)

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

    def _learn(self, key: HostKind, source: int) -> None:
        if key not in self._highest and len(self._highest) >= product.MOST_KINDS:
            return
        self._highest[key] = max(self._highest.get(key, 0), self._now[key])
        self._packets[key] += 1
        sources = self._sources.setdefault(key, Counter())
        if source not in sources:
            if len(sources) >= product.MOST_SOURCES or self._named >= product.MOST_SOURCES_OF_ALL:
                return
            self._named += 1
        sources[source] += 1


def _packets(batch: Columns) -> Iterator[tuple[int, int, int, list[int]]]:
    """Second, source, host, and the kinds that a packet belongs to."""
    names = ("arp_op", "quoted", "ip_version", *_PORTS, "tcp_flags", "icmp_type", "icmp6_type", *_ADDRESSES)
    whole = seconds(batch).astype(np.int64).tolist()
    columns = zip(*(batch[name].tolist() for name in names), strict=True)
    for second, (arp, quoted, version, *ports, flags, icmp, icmp6, to_hi, to_lo, hi, lo) in zip(
        whole, columns, strict=True
    ):
        if arp >= 0 or quoted or version not in (4, 6):
            yield second, 0, 0, []
            continue
        mask = 0xFFFF_FFFF if version == 4 else (1 << 64) - 1
        source, host = (address_of(version, *end) for end in ((hi, lo & mask), (to_hi, to_lo & mask)))
        yield second, source, host, _kinds(ports, flags, icmp == _ECHO or icmp6 == _ECHO6)


def _kinds(ports: Sequence[int], flags: int, is_ping: bool) -> list[int]:
    tcp_sport, tcp_dport, udp_sport, udp_dport = ports
    kinds = []
    if udp_sport >= 0:
        kinds += [FROM_UDP | udp_sport if udp_sport < _WELL_KNOWN else UDP | udp_dport & 0xFFFF, ANY_UDP]
    if tcp_sport >= 0 and not flags & _SYN:
        kinds.append(STRAY_TCP | tcp_dport & 0xFFFF)
    if is_ping and tcp_sport < 0 and udp_sport < 0:
        kinds.append(ECHO)
    return kinds


_PORTS: Final = ("tcp_sport", "tcp_dport", "udp_sport", "udp_dport")
_ADDRESSES: Final = ("ip_dst_hi", "ip_dst_lo", "ip_src_hi", "ip_src_lo")
