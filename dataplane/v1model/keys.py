"""Keys of tables: match values by field, and the numbers that the back ends compare.

    Match (Exact, Ternary, …)  ── rule() ──►  Rule (value, mask, ranges, rank)
    Match of exact values only ◄── unpacked() ── packed() ──►  one integer

A key whose fields are all exact is kept packed: an entry then costs one number instead of a tuple of tuples,
which bulk writers feel most in the garbage collector.
"""

from collections.abc import Sequence
from typing import NamedTuple

from dataplane.compiler.machine import RangePart, Rule
from dataplane.errors import InvalidEntry
from dataplane.v1model.tree import KeySpec, MatchKind, TableSpec


class Exact(NamedTuple):
    value: int


class Ternary(NamedTuple):
    """`value` under `mask`; mask 0 = any."""

    value: int
    mask: int


class Lpm(NamedTuple):
    """The first `prefix_len` bits of `value`; 0 = any."""

    value: int
    prefix_len: int


class Range(NamedTuple):
    """low <= field <= high."""

    low: int
    high: int


class Optional(NamedTuple):
    """Exactly `value`, or anything when None."""

    value: int | None


MatchValue = Exact | Ternary | Lpm | Range | Optional
Match = tuple[MatchValue, ...]


class TableKey:
    """The key of one table.

    shifts: where the back end has each field in the key's long integer, in bits
    """

    def __init__(self, spec: TableSpec, shifts: Sequence[int]) -> None:
        self.table = spec.name
        self.fields = tuple(zip(spec.keys, shifts, strict=True))
        self.mask = sum(((1 << key.width) - 1) << shift for key, shift in self.fields)
        self.all_exact = bool(spec.keys) and all(key.kind is MatchKind.EXACT for key in spec.keys)
        self._needs_priority = spec.needs_priority
        self._only_lpm = not spec.needs_priority and any(k.kind is MatchKind.LPM for k in spec.keys)

    def packed(self, match: Match, priority: int) -> int:
        """The key as one integer, where all fields are exact.  Raises InvalidEntry."""
        self._check(match, priority)
        packed = 0
        for (spec, shift), m in zip(self.fields, match, strict=True):
            packed |= self._value_and_mask(spec, m)[0] << shift
        return packed

    def unpacked(self, packed: int) -> Match:
        """The match values again."""
        return tuple(Exact(packed >> shift & ((1 << key.width) - 1)) for key, shift in self.fields)

    def rule(self, match: Match, priority: int) -> Rule:
        """What the back end looks up.  Raises InvalidEntry."""
        self._check(match, priority)
        value = mask = 0
        rank = priority
        ranges: list[RangePart] = []
        for (spec, shift), m in zip(self.fields, match, strict=True):
            if isinstance(m, Range):
                ranges.extend(self._range(spec, shift, m))
                continue
            v, k = self._value_and_mask(spec, m)
            value |= v << shift
            mask |= k << shift
            if self._only_lpm and isinstance(m, Lpm):
                rank = m.prefix_len
        return value, mask, tuple(ranges), rank

    def shown(self, match: Match, priority: int) -> str:
        """For error texts."""
        fields = ", ".join(f"{spec.name}={m}" for (spec, _), m in zip(self.fields, match, strict=False))
        return f"({fields})" + (f" at priority {priority}" if priority else "")

    def _check(self, match: Match, priority: int) -> None:
        if len(match) != len(self.fields):
            raise InvalidEntry(f"table {self.table} has {len(self.fields)} key fields, got {len(match)}")
        if self._needs_priority and priority < 1:
            raise InvalidEntry(f"table {self.table} needs a priority of at least 1, got {priority}")
        if not self._needs_priority and priority:
            raise InvalidEntry(f"table {self.table} takes no priority, got {priority}")
        if priority >= 1 << 31:
            raise InvalidEntry(f"table {self.table}: priority {priority} does not fit 31 bits")

    def _range(self, spec: KeySpec, shift: int, m: Range) -> list[RangePart]:
        full = (1 << spec.width) - 1
        if spec.kind is not MatchKind.RANGE:
            raise self._wrong_kind(spec, m)
        if not 0 <= m.low <= m.high <= full:
            raise InvalidEntry(
                f"table {self.table}: {spec.name} range {m.low}..{m.high} is not within 0..{full}"
            )
        return [] if (m.low, m.high) == (0, full) else [RangePart(shift, spec.width, m.low, m.high)]

    def _wrong_kind(self, spec: KeySpec, m: MatchValue) -> InvalidEntry:
        return InvalidEntry(f"table {self.table}: {spec.name} is matched {spec.kind}, got {m}")

    def _value_and_mask(self, spec: KeySpec, m: MatchValue) -> tuple[int, int]:
        full = (1 << spec.width) - 1
        if not isinstance(m, _KINDS[spec.kind]):
            raise self._wrong_kind(spec, m)
        value, mask = 0, full
        if isinstance(m, Exact):
            value = m.value
        elif isinstance(m, Optional):
            value, mask = (0, 0) if m.value is None else (m.value, full)
        elif isinstance(m, Ternary):
            value, mask = m.value, m.mask
        elif isinstance(m, Lpm):
            if not 0 <= m.prefix_len <= spec.width:
                raise InvalidEntry(f"table {self.table}: {spec.name} prefix length {m.prefix_len}")
            value, mask = m.value, full ^ (full >> m.prefix_len)
        if not (0 <= value <= full and 0 <= mask <= full):
            raise InvalidEntry(f"table {self.table}: {spec.name}={m} does not fit {spec.width} bits")
        if value & ~mask:
            raise InvalidEntry(f"table {self.table}: {spec.name}={m} has bits set outside its mask")
        return value, mask


_KINDS: dict[MatchKind, type[MatchValue]] = {
    MatchKind.EXACT: Exact,
    MatchKind.LPM: Lpm,
    MatchKind.TERNARY: Ternary,
    MatchKind.RANGE: Range,
    MatchKind.OPTIONAL: Optional,
}
