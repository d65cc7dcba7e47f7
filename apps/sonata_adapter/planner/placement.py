"""Allocation in the switch: bits of the classifier, entries of counting stages, cells.

A distinct or reduce takes a bit and a place in a stage; no frame may match two entries of one stage,
a reduce behind a distinct stands in a later stage.
"""

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Final, Literal, Protocol

import msgspec

from apps.sonata_adapter.errors import NotPlaced
from apps.sonata_adapter.planner.conditions import Match, disjoint, narrowed
from apps.sonata_adapter.query.expressions import Expression, Field, Number, text_of

_ADDRESS: Final = (1 << 128) - 1
_SHORT: Final = (1 << 16) - 1
_KEY_PARTS: Final = {
    "ip.src": ("source_mask", _ADDRESS),
    "ip.dst": ("destination_mask", _ADDRESS),
    "tcp.sport": ("source_port_mask", _SHORT),
    "udp.sport": ("source_port_mask", _SHORT),
    "tcp.dport": ("port_mask", _SHORT),
    "udp.dport": ("port_mask", _SHORT),
    "length": ("length_mask", _SHORT),
}
_LAST_KNOWN_PORT: Final = 1_023
"""The last well-known port: servers send from these, clients from the others."""
Role = Literal["distinct", "reduce", "difference", "gate", "look", "clock"]
CROWDED: Final = 2
"""Entries that need so many times their cells are crowded; fewer are not worth a change."""
_DIFFERENCE_ZERO: Final = 1 << 31
"""The cell's value for a difference of 0, because differences may be negative."""


class SwitchLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Capacity of the switch program, and the share that queries may use."""

    bits: int = 196
    """Classifier bits from 0 on; the firewall uses four for samples, the controller the others for ports and the
    whole stream."""
    stages: int = 16
    """Counting stages that the adapter may use."""
    entries: int = 32
    """Entries of a stage."""
    cells: int = 32_768
    """Cells of a stage in one bank."""
    distinct_cells: int = 32_768
    """Cells that the entries of one distinct take together, if available; none takes less than a quarter."""
    reduce_cells: int = 8_192
    """Cells that an entry of a reduce takes, if available, otherwise a quarter."""
    reads: bool = True
    """Whether the controller answers requests for cells; if so, differences are counted in the switch too."""
    read_window_ms: int = 1_000
    """Shortest window of queries that need cells read; the switch reports its time no more often."""


class StageEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One entry of a counting stage."""

    role: Role
    bit: int
    stage: int
    match: Match
    """What the classifier's bit means."""
    masks: tuple[tuple[str, int], ...]
    threshold: int
    by_bytes: int
    window_us: int
    base: int = 0
    size: int = 0
    source: int = 0
    """Which of the query's counts it is, in the order of `dataflow.sources`."""
    behind: tuple[int, ...] = ()
    """Of a reduce: the bits of the distincts that let its tuples pass, each those of other packets."""
    count_of: int = 0
    """Of a difference or a gate: the bit of its first entry, whose cells all of them use."""
    answers: int = 0
    """1 where the packets come from the other side, and their source is the key's destination."""
    subtracts: int = 0
    generation: int = 1
    """Of a difference: 1 to 255, other than that of who had the bit before."""
    opens: int = 0
    """Of a gate: the bit of the copies of packets that have passed it."""
    uncounted: int = 0
    """Of a gate: the bit of the copies of packets whose key has no cell."""

    def params(self, repeated: int = 0) -> dict[str, int]:
        """Parameters of the action; `repeated`: bits to forget for a key seen before."""
        common = {
            "bit_of_query": 1 << self.bit,
            "source_mask": 0,
            "destination_mask": 0,
            "port_mask": 0,
            "length_mask": 0,
            "source_port_mask": 0,
            **dict(self.masks),
            "by_bytes": self.by_bytes,
            "reciprocal": reciprocal(self.window_us),
            "base": self.base,
            "size": self.size,
        }
        if self.action == "gate":
            kept = ("source_mask", "destination_mask", "reciprocal", "base", "size")
            return {
                **{name: common[name] for name in kept},
                "query": self.count_of,
                "threshold": self.threshold,
                "answers": self.answers,
                "looks": int(self.role == "look"),
                "opens": 1 << self.opens,
                "uncounted": 1 << self.uncounted,
            }
        if self.role != "difference":
            return {**common, "query": self.bit, "threshold": self.threshold, "repeated": repeated}
        return {
            **common,
            "count_of": self.count_of,
            "threshold": _DIFFERENCE_ZERO + self.threshold,
            "answers": self.answers,
            "subtracts": self.subtracts,
            "generation": self.generation,
        }

    @property
    def action(self) -> str:
        """Name of the counting stages' action."""
        if self.role in ("gate", "look"):
            return "gate"
        return "difference" if self.role == "difference" else "count"

    @property
    def bits(self) -> tuple[int, ...]:
        """Bits that the entry takes."""
        return (self.bit, self.opens, self.uncounted) if self.action == "gate" else (self.bit,)

    @property
    def has_cells(self) -> bool:
        """Whether it has cells of its own: others of a difference or a gate use those of its first entry."""
        return self.role in ("distinct", "reduce") or (self.role != "clock" and self.bit == self.count_of)

    def value(self, count: int) -> int:
        """What a count that was read from its cell means."""
        return count - _DIFFERENCE_ZERO if self.role == "difference" else count


class KeysSeen(Protocol):
    """What is known of the keys that an entry counts."""

    def wanted(self, entry: StageEntry) -> int:
        """Cells for the keys that were seen; 0: too few to tell."""

    def enough(self, entry: StageEntry) -> int | None:
        """Cells that are enough; None: not known."""


class Copy(msgspec.Struct, frozen=True, kw_only=True):
    """Copies of packets to the host."""

    bit: int
    match: Match
    payload: bool
    """The frames' bytes are needed, not only their headers."""


def reciprocal(window_us: int) -> int:
    """2^64 / window, rounded up: `time * reciprocal >> 64` is the window's number.

    Exact for times below 2^64 / (reciprocal * window - 2^64): at least 71 days for 3 s, 85 minutes for
    an hour; beyond, frames in the last microseconds of a window may fall into the next.
    """
    return -(-(1 << 64) // window_us)


def by_bytes(value: Expression) -> int:
    if value == Number(1):
        return 0
    if value == Field("length"):
        return 1
    raise NotPlaced(f"the switch adds up frames or bytes, not {text_of(value)}")


def masks_of(keys: Iterable[Expression]) -> tuple[tuple[str, int], ...]:
    masks: dict[str, int] = {}
    for key in keys:
        part = _KEY_PARTS.get(key.name) if isinstance(key, Field) else None
        if part is None:
            known = ", ".join(_KEY_PARTS)
            raise NotPlaced(f"the key of a cell has no room for {text_of(key)}, only for {known}")
        masks[part[0]] = part[1]
    return tuple(sorted(masks.items()))


class Shares(msgspec.Struct, frozen=True):
    """How cells are shared out."""

    splits: bool = False
    """A distinct whose tuples hold the source port gets two entries, for packets from well-known ports and for the
    others, each with its own cells: half as many keys are without a cell."""
    keys: KeysSeen | None = None
    """Whose entries get more cells than usual where their keys need them."""
    spares: bool = False
    """No entry gets more cells than are enough for its keys, where that is known."""


class Space:
    """The free bits, stages and cells."""

    def __init__(self, limits: SwitchLimits, shares: Shares | None = None) -> None:
        self._limits = limits
        self._shares = shares or Shares()
        self._bits: set[int] = set()
        self._stages: list[list[StageEntry]] = [[] for _ in range(limits.stages)]

    def copy(self, shares: Shares | None = None) -> "Space":
        twin = Space(self._limits, shares or self._shares)
        twin._bits = set(self._bits)
        twin._stages = [list(stage) for stage in self._stages]
        return twin

    @property
    def free_stages(self) -> int:
        """Stages without any entry."""
        return sum(1 for held in self._stages if not held)

    def hold(self, entries: Iterable[StageEntry]) -> None:
        for entry in entries:
            if entry.bit not in self._bits:
                self._bits.update(entry.bits)
                self._stages[entry.stage].append(entry)

    def take_bits(self, bits: Iterable[int]) -> None:
        self._bits |= set(bits)

    def bit(self) -> int:
        """A free bit; raises `NotPlaced`."""
        free = self.bit_for_copy()
        if free is None:
            raise NotPlaced(f"all {self._limits.bits} bits of the classifier are taken")
        return free

    @property
    def last_bit(self) -> int:
        """Kept for copies of every packet."""
        return self._limits.bits - 1

    def bit_for_copy(self) -> int | None:
        """A free bit, None if there is none."""
        free = next((bit for bit in range(self.last_bit) if bit not in self._bits), None)
        if free is not None:
            self._bits.add(free)
        return free

    def distinct(
        self, match: Match, masks: tuple[tuple[str, int], ...], window_us: int, alternatives: int
    ) -> list[StageEntry]:
        """Entries for a distinct: those that are there already, with room behind them, or new ones."""
        parts = (
            _by_source_port(match) if self._shares.splits and "source_port_mask" in dict(masks) else [match]
        )
        if self._there(match, masks, window_us) is not None:
            parts = [match]
        return [self._distinct(part, masks, window_us, alternatives) for part in parts]

    def _there(self, match: Match, masks: tuple[tuple[str, int], ...], window_us: int) -> StageEntry | None:
        """The largest that is the same."""
        wanted = ("distinct", match, masks, window_us)
        found = [
            entry
            for number, held in enumerate(self._stages)
            for entry in held
            if (entry.role, entry.match, entry.masks, entry.window_us) == wanted
            and self._room_behind(number, match)
        ]
        return max(found, key=lambda entry: entry.size, default=None)

    def _distinct(
        self, match: Match, masks: tuple[tuple[str, int], ...], window_us: int, alternatives: int
    ) -> StageEntry:
        there = self._there(match, masks, window_us)
        new = StageEntry(
            role="distinct",
            bit=0,
            stage=0,
            match=match,
            masks=masks,
            window_us=window_us,
            threshold=0,
            by_bytes=0,
        )
        cells = self._limits.distinct_cells // alternatives
        if there is not None and there.size * CROWDED > self._wish(new, there.size):
            return there
        try:
            return self.place(new, after=-1, cells=cells)
        except NotPlaced:
            if there is None:
                raise
            return there

    def clock(self) -> StageEntry:
        """The entry with which the switch reports its time; raises `NotPlaced`.

        The first frame of each period is reported, whatever frame that is: it needs a stage of its own.
        """
        for held in self._stages:
            for entry in held:
                if entry.role == "clock":
                    return entry
        new = StageEntry(
            role="clock",
            bit=0,
            stage=0,
            match={},
            masks=(),
            window_us=self._limits.read_window_ms * 1000,
            threshold=1,
            by_bytes=0,
        )
        return self.place(new, after=-1, cells=1)

    def _room_behind(self, stage: int, match: Match) -> bool:
        return any(
            all(disjoint(match, entry.match) for entry in held) and len(held) < self._limits.entries
            for held in self._stages[stage + 1 :]
        )

    def place(self, wanted: StageEntry, *, after: int, cells: int = 0) -> StageEntry:
        """The entry in the first stage behind `after` that has room; raises `NotPlaced`."""
        usual = cells or self._limits.reduce_cells
        wish = self._wish(wanted, usual)
        for number in range(after + 1, self._limits.stages):
            held = self._stages[number]
            if len(held) >= self._limits.entries:
                continue
            if not all(disjoint(wanted.match, entry.match) for entry in held):
                continue
            gap = self._gap(held, wish, usual)
            if gap is None:
                continue
            entry = msgspec.structs.replace(wanted, bit=self.bit(), stage=number, base=gap[0], size=gap[1])
            held.append(entry)
            return entry
        raise NotPlaced(f"no counting stage of {self._limits.stages} has room for its {wanted.role}")

    def gate(self, wanted: Sequence[StageEntry]) -> list[StageEntry]:
        """Entries for one gate, and the bits of its copies; raises `NotPlaced`."""
        entries = self.together(wanted)
        opens, uncounted = self.bit(), self.bit()
        return [msgspec.structs.replace(entry, opens=opens, uncounted=uncounted) for entry in entries]

    def together(self, wanted: Sequence[StageEntry]) -> list[StageEntry]:
        """Entries for one difference or gate: all in one stage, on the same cells; raises `NotPlaced`."""
        apart = all(disjoint(one.match, other.match) for one, other in combinations(wanted, 2))
        usual = sum(entry.role != "look" for entry in wanted) * self._limits.reduce_cells
        wish = self._wish(wanted[0], usual)
        for number, held in enumerate(self._stages if apart else ()):
            gap = self._gap(held, wish, usual)
            fits = all(disjoint(one.match, other.match) for one in wanted for other in held)
            if not fits or gap is None or len(held) + len(wanted) > self._limits.entries:
                continue
            bits = [self.bit() for _ in wanted]
            found = [
                msgspec.structs.replace(
                    entry, bit=bit, count_of=bits[0], stage=number, base=gap[0], size=gap[1]
                )
                for entry, bit in zip(wanted, bits, strict=True)
            ]
            held.extend(found)
            return found
        raise NotPlaced(f"no counting stage of {self._limits.stages} has room for its {wanted[0].role}")

    def _wish(self, entry: StageEntry, usual: int) -> int:
        """How many cells an entry had better get."""
        keys = self._shares.keys
        if keys is None:
            return usual
        enough = keys.enough(entry) if self._shares.spares else None
        found = max(usual, keys.wanted(entry)) if enough is None else enough
        return min(found, max(usual, self._limits.cells))

    def _gap(self, held: Iterable[StageEntry], wish: int, usual: int) -> tuple[int, int] | None:
        """The first gap of cells that is as large as wished, else the largest of at least a quarter of the usual."""
        gaps = []
        start = 0
        for entry in sorted(held, key=lambda entry: entry.base):
            gaps.append((start, entry.base - start))
            start = entry.base + entry.size
        gaps.append((start, self._limits.cells - start))
        large = next(((base, wish) for base, size in gaps if size >= wish), None)
        if large is not None:
            return large
        base, size = max(gaps, key=lambda gap: gap[1])
        return (base, size) if size >= max(1, min(wish, usual) // 4) else None


def _by_source_port(match: Match) -> list[Match]:
    """The packets of a condition in two parts, from well-known ports and from others."""
    spans = ([0, _LAST_KNOWN_PORT], [_LAST_KNOWN_PORT + 1, _SHORT])
    return [part for span in spans if (part := narrowed(match, {"sport": span})) is not None]
