"""The obvious table: every entry is tried."""

from collections.abc import Sequence

from dataplane.v1model.tables import Exact, Lpm, Match, MatchValue, Optional, Range, TableEntry, Ternary


def matches(value: int, m: MatchValue, width: int = 32) -> bool:
    if isinstance(m, Exact):
        return value == m.value
    if isinstance(m, Ternary):
        return value & m.mask == m.value
    if isinstance(m, Lpm):
        return value >> (width - m.prefix_len) == m.value >> (width - m.prefix_len)
    if isinstance(m, Range):
        return m.low <= value <= m.high
    assert isinstance(m, Optional)
    return m.value is None or m.value == value


class Naive:
    """Slots are reused lowest first, as in BMv2; of equal priorities the lowest slot wins."""

    def __init__(self) -> None:
        self.slots: list[TableEntry | None] = []

    def insert(self, entry: TableEntry) -> None:
        for i, old in enumerate(self.slots):
            if old is None:
                self.slots[i] = entry
                return
        self.slots.append(entry)

    def delete(self, match: Match, priority: int) -> None:
        for i, old in enumerate(self.slots):
            if old is not None and (old.match, old.priority) == (match, priority):
                self.slots[i] = None

    def find(self, values: Sequence[int]) -> TableEntry | None:
        best: TableEntry | None = None
        for entry in self.slots:
            if entry is None or (best is not None and entry.priority <= best.priority):
                continue
            if all(matches(v, m) for v, m in zip(values, entry.match, strict=True)):
                best = entry
        return best
