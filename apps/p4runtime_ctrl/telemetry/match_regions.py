"""Geometry of match conditions: regions over the fields of a table, their intersections and order.

A table looks a packet up once.  For several overlapping conditions to be told apart, the table must
hold every intersection, and narrower regions must win: `closure` and `Shape.priority`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from apps.p4runtime_ctrl.errors import EntryError, TelemetryError
from apps.p4runtime_ctrl.southbound import values
from apps.p4runtime_ctrl.southbound.p4info import EXACT, LPM, RANGE, FieldInfo, TableInfo


@dataclass(frozen=True)
class TernaryMatch:
    """Numbers that agree with `value` wherever `mask` has a bit."""

    value: int
    mask: int

    def covers(self, other: "TernaryMatch") -> bool:
        return self.mask & other.mask == self.mask and other.value & self.mask == self.value

    def meet(self, other: "TernaryMatch") -> "TernaryMatch | None":
        if (self.value ^ other.value) & self.mask & other.mask:
            return None
        return TernaryMatch(self.value | other.value, self.mask | other.mask)

    def narrowness(self) -> int:
        return self.mask.bit_count()

    @property
    def shape(self) -> int:
        return self.mask

    @property
    def place(self) -> int | None:
        return self.value

    def seen_through(self, mask: int) -> int | None:
        """The value under this mask that covers this match; None if none can."""
        return self.value & mask if self.mask & mask == mask else None


@dataclass(frozen=True)
class RangeMatch:
    """Numbers from `low` to `high`, both included, of a field of `width` bits."""

    low: int
    high: int
    width: int

    def covers(self, other: "RangeMatch") -> bool:
        return self.low <= other.low and other.high <= self.high

    def meet(self, other: "RangeMatch") -> "RangeMatch | None":
        low, high = max(self.low, other.low), min(self.high, other.high)
        return RangeMatch(low, high, self.width) if low <= high else None

    def narrowness(self) -> int:
        return (1 << self.width) - 1 - (self.high - self.low)

    @property
    def shape(self) -> tuple[int, int]:
        return self.low, self.high

    @property
    def place(self) -> bool:
        return True

    def seen_through(self, ends: tuple[int, int]) -> bool:
        """Whether the range with these ends covers this one."""
        return ends[0] <= self.low and self.high <= ends[1]


@dataclass(frozen=True)
class MatchRegion:
    """One condition for each field of a table."""

    sides: tuple[Any, ...]

    def covers(self, other: "MatchRegion") -> bool:
        """Whether every packet of `other` is in this region."""
        return all(mine.covers(theirs) for mine, theirs in zip(self.sides, other.sides, strict=True))

    def meet(self, other: "MatchRegion") -> "MatchRegion | None":
        """The packets in both; None if the regions are disjoint."""
        sides = [mine.meet(theirs) for mine, theirs in zip(self.sides, other.sides, strict=True)]
        return None if None in sides else MatchRegion(tuple(sides))


class Shape:
    """The form of regions in one table."""

    def __init__(self, table: TableInfo) -> None:
        self._table = table

    def region(self, match: Mapping[str, Any]) -> MatchRegion:
        """The region of conditions by field name; raises `EntryError` if one cannot be expressed."""
        given = dict(match)
        _add_family(self._table, given)
        for field in self._table.fields:
            if field.kind == EXACT and field.name not in given:
                raise EntryError(
                    f"{self._table.name}: a condition here needs {field.name}, which is matched exactly"
                )
        return MatchRegion(tuple(self._side(field, given.get(field.name)) for field in self._table.fields))

    def _side(self, field: FieldInfo, value: Any) -> TernaryMatch | RangeMatch:
        where = f"{self._table.name} {field.name}"
        if field.kind == RANGE:
            if value is None:
                return RangeMatch(0, (1 << field.width) - 1, field.width)
            low, high = _pair(value, value, where)
            ends = [values.parse(end, field.width, where=where) for end in (low, high)]
            if ends[0] > ends[1]:
                raise EntryError(f"{where}: the range {low}..{high} is empty; low comes first")
            return RangeMatch(ends[0], ends[1], field.width)
        if value is None:
            return TernaryMatch(0, 0)
        full = (1 << field.width) - 1
        if field.kind == LPM:
            first, length = values.parse_prefix(
                *values.prefix_pair(value, field.width), field.width, where=where
            )
            return TernaryMatch(first, full ^ (full >> length))
        first, mask = _pair(value, full, where)
        return TernaryMatch(*values.parse_masked(first, mask, field.width, where=where))

    def match(self, region: MatchRegion) -> dict[str, Any]:
        """The region in the notation of `TableUpdate.match`."""
        found: dict[str, Any] = {}
        for field, side in zip(self._table.fields, region.sides, strict=True):
            if isinstance(side, RangeMatch):
                found[field.name] = [side.low, side.high]
            elif field.kind == LPM:
                found[field.name] = [side.value, side.mask.bit_count()]
            elif field.kind == EXACT:
                found[field.name] = side.value
            else:
                found[field.name] = [side.value, side.mask]
        return found

    def priority(self, region: MatchRegion) -> int:
        """Priority of an entry: higher for every region that lies inside another."""
        return 1 + sum(int(side.narrowness()) for side in region.sides)


def _pair(value: Any, default: Any, where: str) -> tuple[Any, Any]:
    if not isinstance(value, (list, tuple)):
        return value, default
    if len(value) != 2:
        raise EntryError(f"{where}: {str(value)[:80]} is not a pair")
    return value[0], value[1]


def _add_family(table: TableInfo, given: dict[str, Any]) -> None:
    """Whether an address is IPv4, by its own notation."""
    family = next((field for field in table.fields if field.name == "is_ipv4"), None)
    if family is None or family.name in given:
        return
    for value in given.values():
        text = values.prefix_pair(value, values.ADDRESS_BITS)[0]
        if isinstance(text, str):
            given[family.name] = int(values.is_ipv4(text))
            return


class Closure:
    """The regions of one table and all their intersections; extends the last result."""

    def __init__(self, *, limit: int, where: str) -> None:
        self._limit = limit
        self._where = where
        self._asked: set[MatchRegion] = set()
        self._found: dict[MatchRegion, None] = {}

    def of(self, regions: Iterable[MatchRegion]) -> list[MatchRegion]:
        """Raises `TelemetryError` if they exceed the table's size."""
        asked = set(regions)
        if not asked >= self._asked:
            self._asked, self._found = set(), {}
        found = dict(self._found)
        waiting = [region for region in asked if region not in found]
        while waiting:
            region = waiting.pop()
            if region in found:
                continue
            waiting.extend(
                met for other in found if (met := region.meet(other)) is not None and met not in found
            )
            found[region] = None
            if len(found) > self._limit:
                raise TelemetryError(
                    f"{self._where} has room for {self._limit} conditions and their overlaps, and more are"
                    " asked for; use fewer or simpler packet requests"
                )
        self._asked, self._found = asked, found
        return list(found)


class Covering:
    """Finds the regions that cover another: one look-up for each combination of masks."""

    def __init__(self, regions: Mapping[MatchRegion, int]) -> None:
        self._groups: dict[tuple[Any, ...], dict[tuple[Any, ...], int]] = {}
        for region, bits in regions.items():
            group = self._groups.setdefault(tuple(side.shape for side in region.sides), {})
            key = tuple(side.place for side in region.sides)
            group[key] = group.get(key, 0) | bits

    def bits(self, region: MatchRegion) -> int:
        """The bits of all regions that cover this one, or-ed."""
        found = 0
        for shapes, group in self._groups.items():
            key = tuple(side.seen_through(shape) for side, shape in zip(region.sides, shapes, strict=True))
            found |= group.get(key, 0)
        return found
