"""Geometry of match conditions: boxes over the fields of a table, their intersections and order.

A table looks a packet up once.  For several overlapping conditions to be told apart, the table must
hold every intersection, and narrower boxes must win: `closure` and `Shape.priority`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from apps.p4runtime_ctrl import values
from apps.p4runtime_ctrl.errors import EntryError, TelemetryError
from apps.p4runtime_ctrl.p4info import EXACT, LPM, RANGE, Field, Table


@dataclass(frozen=True)
class Bits:
    """Numbers that agree with `value` wherever `mask` has a bit."""

    value: int
    mask: int

    def covers(self, other: "Bits") -> bool:
        return self.mask & other.mask == self.mask and other.value & self.mask == self.value

    def meet(self, other: "Bits") -> "Bits | None":
        if (self.value ^ other.value) & self.mask & other.mask:
            return None
        return Bits(self.value | other.value, self.mask | other.mask)

    def narrowness(self) -> int:
        return self.mask.bit_count()

    @property
    def shape(self) -> int:
        return self.mask

    @property
    def place(self) -> int | None:
        return self.value

    def seen_through(self, mask: int) -> int | None:
        """The place of the set of this mask that covers this one; None where none can."""
        return self.value & mask if self.mask & mask == mask else None


@dataclass(frozen=True)
class Span:
    """Numbers from `low` to `high`, both included, of a field of `width` bits."""

    low: int
    high: int
    width: int

    def covers(self, other: "Span") -> bool:
        return self.low <= other.low and other.high <= self.high

    def meet(self, other: "Span") -> "Span | None":
        low, high = max(self.low, other.low), min(self.high, other.high)
        return Span(low, high, self.width) if low <= high else None

    def narrowness(self) -> int:
        return (1 << self.width) - 1 - (self.high - self.low)

    @property
    def shape(self) -> tuple[int, int]:
        return self.low, self.high

    @property
    def place(self) -> bool:
        return True

    def seen_through(self, ends: tuple[int, int]) -> bool:
        """Whether the span with these ends covers this one."""
        return ends[0] <= self.low and self.high <= ends[1]


@dataclass(frozen=True)
class Box:
    """One condition for each field of a table."""

    sides: tuple[Any, ...]

    def covers(self, other: "Box") -> bool:
        """Whether every packet of `other` is in this box."""
        return all(mine.covers(theirs) for mine, theirs in zip(self.sides, other.sides, strict=True))

    def meet(self, other: "Box") -> "Box | None":
        """The packets in both, None where there can be none."""
        sides = [mine.meet(theirs) for mine, theirs in zip(self.sides, other.sides, strict=True)]
        return None if None in sides else Box(tuple(sides))


class Shape:
    """How boxes look in one table."""

    def __init__(self, table: Table) -> None:
        self._table = table

    def box(self, match: Mapping[str, Any]) -> Box:
        """The box of conditions by field name; raises `EntryError` where one cannot be expressed."""
        given = dict(match)
        _add_family(self._table, given)
        for field in self._table.fields:
            if field.kind == EXACT and field.name not in given:
                raise EntryError(
                    f"{self._table.name}: a condition here needs {field.name}, which is matched exactly"
                )
        return Box(tuple(self._side(field, given.get(field.name)) for field in self._table.fields))

    def _side(self, field: Field, value: Any) -> Bits | Span:
        where = f"{self._table.name} {field.name}"
        if field.kind == RANGE:
            if value is None:
                return Span(0, (1 << field.width) - 1, field.width)
            low, high = value if isinstance(value, (list, tuple)) else (value, value)
            ends = [values.parse(end, field.width, where=where) for end in (low, high)]
            if ends[0] > ends[1]:
                raise EntryError(f"{where}: the range {low}..{high} is empty; low comes first")
            return Span(ends[0], ends[1], field.width)
        if value is None:
            return Bits(0, 0)
        full = (1 << field.width) - 1
        if field.kind == LPM:
            first, length = values.parse_prefix(
                *values.prefix_pair(value, field.width), field.width, where=where
            )
            return Bits(first, full ^ (full >> length))
        first, mask = value if isinstance(value, (list, tuple)) else (value, full)
        return Bits(*values.parse_masked(first, mask, field.width, where=where))

    def match(self, box: Box) -> dict[str, Any]:
        """The box in the notation of `TableUpdate.match`."""
        found: dict[str, Any] = {}
        for field, side in zip(self._table.fields, box.sides, strict=True):
            if isinstance(side, Span):
                found[field.name] = [side.low, side.high]
            elif field.kind == LPM:
                found[field.name] = [side.value, side.mask.bit_count()]
            elif field.kind == EXACT:
                found[field.name] = side.value
            else:
                found[field.name] = [side.value, side.mask]
        return found

    def priority(self, box: Box) -> int:
        """Higher for every box that lies inside another, whatever else the table holds."""
        return 1 + sum(int(side.narrowness()) for side in box.sides)


def _add_family(table: Table, given: dict[str, Any]) -> None:
    """An address says by itself whether it is IPv4."""
    family = next((field for field in table.fields if field.name == "is_ipv4"), None)
    if family is None or family.name in given:
        return
    for value in given.values():
        text = values.prefix_pair(value, values.ADDRESS_BITS)[0]
        if isinstance(text, str):
            given[family.name] = int(values.is_ipv4(text))
            return


class Closure:
    """The boxes of one table and all their intersections; remembers the last answer, and adds to it."""

    def __init__(self, *, limit: int, where: str) -> None:
        self._limit = limit
        self._where = where
        self._asked: set[Box] = set()
        self._found: dict[Box, None] = {}

    def of(self, boxes: Iterable[Box]) -> list[Box]:
        """Raises `TelemetryError` where they are more than the table's size."""
        asked = set(boxes)
        if not asked >= self._asked:
            self._asked, self._found = set(), {}
        found = dict(self._found)
        waiting = [box for box in asked if box not in found]
        while waiting:
            box = waiting.pop()
            if box in found:
                continue
            waiting.extend(
                met for other in found if (met := box.meet(other)) is not None and met not in found
            )
            found[box] = None
            if len(found) > self._limit:
                raise TelemetryError(
                    f"{self._where} has room for {self._limit} conditions and their overlaps, and more are"
                    " asked for; use fewer or simpler packet requests"
                )
        self._asked, self._found = asked, found
        return list(found)


class Covering:
    """Finds what covers a box among many: one look-up for each combination of masks that occurs."""

    def __init__(self, boxes: Mapping[Box, int]) -> None:
        self._groups: dict[tuple[Any, ...], dict[tuple[Any, ...], int]] = {}
        for box, bits in boxes.items():
            group = self._groups.setdefault(tuple(side.shape for side in box.sides), {})
            key = tuple(side.place for side in box.sides)
            group[key] = group.get(key, 0) | bits

    def bits(self, box: Box) -> int:
        """The bits of all boxes that cover this one, or-ed."""
        found = 0
        for shapes, group in self._groups.items():
            key = tuple(side.seen_through(shape) for side, shape in zip(box.sides, shapes, strict=True))
            found |= group.get(key, 0)
        return found
