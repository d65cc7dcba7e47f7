"""What of each kind of flood comes to each host anyway: packets a second in training, and from whom.

    kind   datagrams from a well-known port, to a port, all of them; TCP segments to a port that are no SYNs; pings

Counted in C (`victims.c`): no Python object a packet.  A rate limit towards a victim
is set from this.  Pure; bounded in hosts and in sources.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Any, Final, NamedTuple, Self

import numpy as np

from apps.evidence import MOST_USUAL
from apps.kitsune.behaviour.rows import address_of, parts_of
from apps.kitsune.kernel import Columns, Kernel, load_kernel
from apps.kitsune.kernel_rows import check, rows_of, seed

MOST_KINDS: Final = 65_536
"""Pairs of host and kind that are remembered of training, and within a second."""
MOST_SOURCES: Final = 1_024
"""Sources counted of one pair ..."""
MOST_SOURCES_OF_ALL: Final = 262_144
"""... and of all."""
_WHAT: Final = "victims"
BACK_S: Final = 60
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
    """Counts what comes to every host; `add` takes packets in capture order.

    Args:
        kernel: None loads the one that was built.
    """

    def __init__(self, kernel: Kernel | None = None) -> None:
        kernel = kernel or load_kernel()
        self._kernel, self._lib = kernel, kernel.lib
        limits = {
            "most_kinds": MOST_KINDS,
            "most_sources": MOST_SOURCES,
            "most_sources_of_all": MOST_SOURCES_OF_ALL,
            "back_s": BACK_S,
        }
        state = self._lib.victims_new(kernel.ffi.new("VictimLimits *", limits), seed())
        if state == kernel.ffi.NULL:
            raise MemoryError("victims: no memory for their tables")
        self._state = kernel.ffi.gc(state, self._lib.victims_free)
        self._has_learnt = False
        self._highest: dict[HostKind, int] = {}
        self._sources: dict[HostKind, Counter[int]] = {}
        self._packets: Counter[HostKind] = Counter()

    def add(self, batch: Columns, trained: int) -> None:
        """Take a batch of which the first `trained` packets were training."""
        rows = rows_of(self._kernel, batch)
        check(self._lib.victims_add(self._state, rows.decoded, rows.count, trained), _WHAT)
        self._has_learnt |= trained > 0

    def usual(self, victim: int, kind: int) -> UsualTraffic:
        """What came of this kind to a host."""
        self._fetch()
        key = (victim, kind)
        version, hi, lo = parts_of(victim)
        rate = self._lib.victims_rate(self._state, kind, version == 6, hi, lo)
        sources, packets = self._sources.get(key, Counter()), self._packets[key]
        named = sources.most_common(MOST_USUAL)
        return UsualTraffic(
            float(rate),
            float(self._highest.get(key, 0)),
            tuple(source for source, _ in named),
            sum(count for _, count in named) / packets if packets else 0.0,
        )

    def to_state(self) -> list[list[Any]]:
        """What training has taught, as plain values for the model file."""
        self._fetch()
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
    def from_state(cls, state: Iterable[Any], kernel: Kernel | None = None) -> Self:
        """The inverse of `to_state`.

        Raises:
            TypeError, ValueError: the state is not one.
        """
        self = cls(kernel)
        for host, kind, highest, packets, sources in state:
            key = int(host), int(kind)
            self._highest[key], self._packets[key] = int(highest), int(packets)
            self._sources[key] = Counter({int(source): int(count) for source, count in sources})
        return self

    def _fetch(self) -> None:
        """What C has learnt since the last time."""
        if not self._has_learnt:
            return
        self._has_learnt = False
        self._sources = {}
        for kind, six, *host, highest, packets in self._rows(self._lib.victims_usual, 6):
            key = _key(kind, six, host)
            self._highest[key], self._packets[key], self._sources[key] = highest, packets, Counter()
        for kind, six, *numbers, count in self._rows(self._lib.victims_sources, 7):
            source = address_of(6 if six else 4, *numbers[2:])
            self._sources[_key(kind, six, numbers[:2])][source] = count

    def _rows(self, read: Any, width: int) -> list[list[int]]:
        count = read(self._state, self._kernel.ffi.NULL, 0)
        rows = np.zeros((count, width), np.uint64)
        read(self._state, self._kernel.pointer("uint64_t", rows), count)
        found: list[list[int]] = rows.tolist()
        return found


def _key(kind: int, six: int, host: list[int]) -> HostKind:
    return address_of(6 if six else 4, *host), kind
