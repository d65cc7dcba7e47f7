"""`VictimRates` on the C ledger: equal results, no Python object a packet."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from apps.kitsune import victims
from apps.kitsune.behaviour.rows import address_of, parts_of
from apps.kitsune.kernel import Columns, Kernel
from apps.kitsune.ledger import check, rows_of, seed
from apps.kitsune.victims import HostKind, UsualTraffic, VictimRates

_WHAT = "victims"


class NativeVictimRates(VictimRates):
    """Counts what comes to every host; `add` takes packets in capture order."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__()
        self._kernel, self._lib = kernel, kernel.lib
        limits = {
            "most_kinds": victims.MOST_KINDS,
            "most_sources": victims.MOST_SOURCES,
            "most_sources_of_all": victims.MOST_SOURCES_OF_ALL,
            "back_s": victims.BACK_S,
        }
        state = self._lib.victims_new(kernel.ffi.new("VictimLimits *", limits), seed())
        if state == kernel.ffi.NULL:
            raise MemoryError("victims: no memory for their tables")
        self._state = kernel.ffi.gc(state, self._lib.victims_free)
        self._has_learnt = False

    def add(self, batch: Columns, trained: int) -> None:
        """Take a batch of which the first `trained` packets were training."""
        rows = rows_of(self._kernel, batch)
        check(self._lib.victims_add(self._state, rows.pointer, rows.count, trained), _WHAT)
        self._has_learnt |= trained > 0

    def usual(self, victim: int, kind: int) -> UsualTraffic:
        """What came of this kind to a host."""
        self._fetch()
        version, hi, lo = parts_of(victim)
        rate = self._lib.victims_rate(self._state, kind, version == 6, hi, lo)
        return super().usual(victim, kind)._replace(rate=float(rate))

    def to_state(self) -> list[list[Any]]:
        """What training has taught, as plain values for the model file."""
        self._fetch()
        return super().to_state()

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


def victims_of(kernel: Kernel | None) -> VictimRates:
    """On the C kernel, or its Python twin without one."""
    return VictimRates() if kernel is None else NativeVictimRates(kernel)


def restored_victims(state: Iterable[Any], kernel: Kernel | None) -> VictimRates:
    """From a model file; raises TypeError or ValueError."""
    rates = victims_of(kernel)
    rates.restore(state)
    return rates
