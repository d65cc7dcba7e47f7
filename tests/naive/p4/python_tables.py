"""State of the Python back end: tables by tuple-space search, counters, meters, registers.

Entries with the same mask share a dict from masked key to candidates; a lookup asks each dict, best rank
first, and stops where no later one can win.
"""

from bisect import insort
from collections.abc import Sequence
from operator import attrgetter

from dataplane.compiler.machine import KeyPlace, RangePart, Rule
from dataplane.v1model.tree import ArraySpec, TableSpec
from tests.naive.p4.meter import Meter

_Rates = tuple[int, int, int, int]


class CompiledEntry:
    """One entry as the generated code sees it."""

    __slots__ = ("action", "bytes", "hit", "mask", "meter", "order", "packets", "params", "ranges", "value")

    def __init__(self, action: int, params: tuple[int, ...]) -> None:
        self.action = action
        self.params = params
        self.packets = 0
        self.bytes = 0
        self.hit = 0
        self.meter = Meter(per_byte=False)
        self.order = (0, 0)
        self.value = 0
        self.mask = 0
        self.ranges: tuple[RangePart, ...] = ()


class _Group:
    """Entries under one mask; `best` may be better than what is left after a removal."""

    __slots__ = ("best", "buckets", "count", "mask")

    def __init__(self, mask: int) -> None:
        self.mask = mask
        self.buckets: dict[int, list[CompiledEntry]] = {}
        self.best = (0, 0)
        self.count = 0


_order = attrgetter("order")
_best = attrgetter("best")


class PythonTable:
    """See machine.TableStore."""

    def __init__(self, spec: TableSpec) -> None:
        shifts: list[int] = []
        total = 0
        for key in reversed(spec.keys):
            shifts.append(total)
            total += key.width
        self.place = KeyPlace(tuple(reversed(shifts)))
        self.default = CompiledEntry(-1, ())
        self._slots: dict[int, CompiledEntry] = {}
        self._groups: dict[int, _Group] = {}
        self._ordered: list[_Group] = []
        self._per_byte = False

    def meter_unit(self, unit: str) -> None:
        self._per_byte = unit == "bytes"

    def find(self, key: int) -> CompiledEntry | None:
        found: CompiledEntry | None = None
        for group in self._ordered:
            if found is not None and group.best > found.order:
                break
            for entry in group.buckets.get(key & group.mask, ()):
                if found is not None and entry.order > found.order:
                    break
                if _within(key, entry.ranges):
                    found = entry
                    break
        return found

    def insert(self, slot: int, rule: Rule, action: int, params: Sequence[int], now_us: int) -> None:
        value, mask, ranges, rank = rule
        entry = CompiledEntry(action, tuple(params))
        entry.meter = Meter(per_byte=self._per_byte)
        entry.hit = now_us
        entry.value, entry.mask, entry.ranges = value & mask, mask, ranges
        entry.order = (-rank, slot)
        self._slots[slot] = entry
        group = self._groups.get(mask)
        if group is None:
            group = self._groups[mask] = _Group(mask)
            group.best = entry.order
            self._ordered.append(group)
        insort(group.buckets.setdefault(entry.value, []), entry, key=_order)
        group.count += 1
        if group.count == 1 or entry.order < group.best:
            group.best = entry.order
            self._ordered.sort(key=_best)

    def replace(self, slot: int, action: int, params: Sequence[int]) -> None:
        entry = self._slots[slot]
        entry.action, entry.params = action, tuple(params)

    def remove(self, slot: int) -> None:
        entry = self._slots.pop(slot)
        group = self._groups[entry.mask]
        bucket = group.buckets[entry.value]
        bucket.remove(entry)
        if not bucket:
            del group.buckets[entry.value]
        group.count -= 1
        if not group.count:
            del self._groups[entry.mask]
            self._ordered.remove(group)

    def set_default(self, action: int, params: Sequence[int]) -> None:
        self.default = CompiledEntry(action, tuple(params))

    def counter(self, slot: int) -> tuple[int, int]:
        entry = self._slots[slot]
        return entry.packets, entry.bytes

    def set_counter(self, slot: int, packets: int, octets: int) -> None:
        entry = self._slots[slot]
        entry.packets, entry.bytes = packets, octets

    def set_meter(self, slot: int, rates: _Rates | None) -> None:
        self._slots[slot].meter.configure(rates)

    def hit_us(self, slot: int) -> int:
        return self._slots[slot].hit

    def touch(self, slot: int, now_us: int) -> None:
        self._slots[slot].hit = now_us


def _within(key: int, ranges: tuple[RangePart, ...]) -> bool:
    return all(r.low <= (key >> r.shift) & ((1 << r.width) - 1) <= r.high for r in ranges)


class PythonCounters:
    """See machine.CounterStore."""

    def __init__(self, size: int) -> None:
        self._packets = [0] * size
        self._bytes = [0] * size

    def count(self, index: int, octets: int) -> None:
        self._packets[index] += 1
        self._bytes[index] += octets

    def read(self, index: int) -> tuple[int, int]:
        return self._packets[index], self._bytes[index]

    def write(self, index: int, packets: int, octets: int) -> None:
        self._packets[index], self._bytes[index] = packets, octets


class PythonMeters:
    """See machine.MeterStore."""

    def __init__(self, spec: ArraySpec) -> None:
        count = 0 if spec.table else spec.size
        self.meters = [Meter(per_byte=spec.unit == "bytes") for _ in range(count)]

    def configure(self, index: int, rates: _Rates | None) -> None:
        self.meters[index].configure(rates)


class PythonRegisters:
    """See machine.RegisterStore."""

    def __init__(self, size: int) -> None:
        self.values = [0] * size

    def read(self, index: int) -> int:
        return self.values[index]

    def write(self, index: int, value: int) -> None:
        self.values[index] = value

    def written(self) -> list[tuple[int, int]]:
        return [(index, value) for index, value in enumerate(self.values) if value]
