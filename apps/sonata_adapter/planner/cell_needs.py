"""How many keys counting entries have in a window, and how many cells these need.  Pure.

frames of keys without a cell ─► such keys in a window ─┐
cells of the entry ─────────────────────────────────────┴─► keys in all ─► the second most of
                                                            five to ten minutes ─► cells

The switch has no counter of keys.  But it reports each frame whose key found its cell taken, and of K keys that are
spread over S cells by a hash, K - S (1 - e^(-K/S)) find none: few keys without a cell tell of many with one (128 keys
in 8,192 cells leave one without).  Gates report nothing, and are left alone.
"""

from collections.abc import Iterable, Mapping
from math import expm1, isqrt, log
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apps.sonata_adapter.planner.placement import StageEntry
from due import RecordBatch

_CELLS_A_KEY: Final = 8
"""The margin: one key in sixteen is then without a cell."""
_SPAN_US: Final = 300_000_000
"""Keys are remembered for one to two of these; fewer cells are given after two."""
_LEAST_WINDOWS: Final = 4
"""At least so many windows are remembered, however long they are."""
_MARKS: Final = 1 << 14
"""Of linear counting: up to a hundred thousand keys without a cell are told apart."""
_MOST_ENTRIES: Final = 1_024
"""Entries, of all switches, that are watched at a time."""
_UNSEEN: Final = 3
"""Where no key was without a cell, there may be as many keys as leave so many without on average: 5 % do by chance."""
_SILENT: Final = 2
"""Windows without a report after which no key is taken to be without a cell any more."""
_FORGOTTEN: Final = 100
"""Windows without a report after which an entry's marks are given up."""
_LOW: Final = (1 << 64) - 1
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)
_PORTS: Final = {"port_mask": ("tcp_dport", "udp_dport"), "source_port_mask": ("tcp_sport", "udp_sport")}
_OTHER_SIDE: Final = {
    "source_mask": "destination_mask",
    "destination_mask": "source_mask",
    "port_mask": "source_port_mask",
    "source_port_mask": "port_mask",
}
Counted = tuple[str, str, tuple[tuple[str, int], ...], int]
"""What cells hold, whichever bit and stage counts it: role, match, masks, window (us)."""


class _WindowKeys(NamedTuple):
    keys: int
    window: int


class _KeysWithoutCell:
    """The keys without a cell of one entry on one switch."""

    def __init__(self, entry: StageEntry) -> None:
        self.entry = entry
        self.number = -1
        self.marks: NDArray[np.bool_] = np.zeros(_MARKS, dtype=bool)
        self.frames = 0
        self.is_told = True

    def begin(self, number: int) -> None:
        self.number, self.frames = number, 0
        self.marks[:] = False

    @property
    def keys(self) -> int:
        """Keys in all, with a cell or without."""
        empty = max(1, _MARKS - int(np.count_nonzero(self.marks)))
        return keys_of(round(_MARKS * log(_MARKS / empty)), self.entry.size)


class _WatchedCount:
    """What is known of one count on one switch."""

    def __init__(self, window_us: int) -> None:
        self.span_us = max(_SPAN_US, _LEAST_WINDOWS * window_us)
        self.since_us = self.last_us = -1
        self.cells = 0
        self._spans: tuple[list[_WindowKeys], list[_WindowKeys]] = ([], [])

    def look(self, now_us: int, cells: int) -> None:
        self.cells = cells
        passed = now_us // self.span_us - self.last_us // self.span_us
        if passed:
            self._spans = (self._spans[1] if passed == 1 else [], [])
        if self.since_us < 0 or now_us < self.last_us or now_us - self.last_us > self.span_us:
            self.since_us = now_us
        self.last_us = now_us

    def is_recent(self, now_us: int | None) -> bool:
        """Whether it was in a plan in the last minutes; None: nothing is heard of the switch."""
        return now_us is not None and now_us - self.last_us <= 2 * self.span_us

    @property
    def is_sure(self) -> bool:
        """Whether it has been watched so long that keys that were not seen would come as a surprise."""
        return self.last_us - self.since_us >= 2 * self.span_us

    def note(self, keys: int, window: int) -> None:
        """Take the keys of a window; two counts may tell of the same one."""
        held = [each for each in self._spans[1] if each.window != window]
        here = [each.keys for each in self._spans[1] if each.window == window]
        self._spans[1][:] = sorted([*held, _WindowKeys(max([keys, *here]), window)], reverse=True)[:2]

    @property
    def keys(self) -> int:
        """Those that more than one window had; 0: too few to tell."""
        found = sorted((each.keys for span in self._spans for each in span), reverse=True)
        return found[1] if len(found) > 1 else 0


class CellWords(dict[int, str]):
    """Cells in words, and how many keys they have, by bit of an entry."""

    @property
    def text(self) -> str:
        """All of them in one line."""
        return "; ".join(dict.fromkeys(self.values()))


class CellNeeds:
    """Keys of counting entries, learnt from reports of keys without a cell."""

    def __init__(self) -> None:
        self._windows: dict[tuple[str, int], _KeysWithoutCell] = {}
        """By switch and bit."""
        self._seen: dict[Counted, dict[str, _WatchedCount]] = {}
        """By what is counted, and switch."""
        self._rates: dict[tuple[str, int], float] = {}
        """Frames a second of keys without a cell, by switch and bit."""

    def reported(
        self, switch: str, bit: int, batch: RecordBatch, entries: Mapping[int, StageEntry], base_us: int
    ) -> None:
        """Take reports of an entry.

        Args:
            switch: that reports.
            bit: of the entry.
            batch: frames; those whose key had no cell are marked by `overflow`.
            entries: of the plan, by bit.
            base_us: time of the switch's zero.
        """
        entry = entries.get(bit)
        over = np.flatnonzero(batch["overflow"]) if entry is not None else ()
        if entry is not None and len(over):
            first = entries.get(entry.count_of, entry) if entry.role == "difference" else entry
            self._take(switch, first, batch.take(over), base_us, answers=bool(entry.answers))

    def _take(
        self, switch: str, entry: StageEntry, batch: RecordBatch, base_us: int, *, answers: bool
    ) -> None:
        window = self._windows.get((switch, entry.bit))
        if window is None or window.entry != entry:
            if len(self._windows) >= _MOST_ENTRIES:
                return
            window = self._windows[switch, entry.bit] = _KeysWithoutCell(entry)
        numbers = (batch["time_us"] - base_us) // entry.window_us
        places = _places(entry, batch, answers=answers)
        for number in np.unique(numbers).tolist():
            if number < window.number:
                continue
            if number > window.number:
                self._close(switch, window)
                window.begin(number)
            mine = numbers == number
            window.marks[places[mine]] = True
            window.frames += int(np.count_nonzero(mine))
            window.is_told = False

    def _close(self, switch: str, window: _KeysWithoutCell) -> None:
        if window.is_told:
            return
        window.is_told = True
        entry = window.entry
        seen = self._seen.get(counted(entry), {}).get(switch)
        if seen is not None:
            seen.note(window.keys, window.number)
        self._rates[switch, entry.bit] = window.frames / entry.window_us * 1e6

    def look(self, entries: Mapping[int, StageEntry], clocks: Mapping[str, int | None]) -> None:
        """End windows that are over; `clocks`: for each switch the time since its zero, us."""
        told = {name: now_us for name, now_us in clocks.items() if now_us is not None}
        self._end_windows(entries, told)
        mine = [entry for entry in entries.values() if entry.has_cells and entry.role != "gate"]
        counts = {counted(entry): entry for entry in mine}
        for what, entry in counts.items():
            by_switch = self._seen.setdefault(what, {})
            for name, now_us in told.items():
                if name not in by_switch:
                    by_switch[name] = _WatchedCount(entry.window_us)
                by_switch[name].look(now_us, entry.size)
        for what, by_switch in list(self._seen.items()):
            kept = {name: seen for name, seen in by_switch.items() if seen.is_recent(told.get(name))}
            self._seen[what] = kept
            if not kept:
                del self._seen[what]

    def _end_windows(self, entries: Mapping[int, StageEntry], told: Mapping[str, int]) -> None:
        for (switch, bit), window in list(self._windows.items()):
            ended = told.get(switch, -1) // window.entry.window_us - window.number
            is_lost = ended < -1 or ended > _FORGOTTEN  # the first: the switch's clock began anew
            if is_lost or entries.get(bit) != window.entry:
                del self._windows[switch, bit]
            elif ended > 0:
                self._close(switch, window)
            if ended > 1 + _SILENT:
                self._rates.pop((switch, bit), None)
        self._rates = {key: rate for key, rate in self._rates.items() if key in self._windows}

    def wanted(self, entry: StageEntry) -> int:
        """Cells for the keys that were seen, by their number and a margin; 0: too few to tell."""
        keys = max((seen.keys for seen in self._of(entry)), default=0)
        return _cells(keys) if keys else 0

    def enough(self, entry: StageEntry) -> int | None:
        """Cells that were enough in the last minutes; None where that is not known yet."""
        seen = self._of(entry)
        if not seen or not all(each.is_sure for each in seen):
            return None
        return max(_cells(max(each.keys, fewest(each.cells))) for each in seen)

    def without_cell(self, entries: Iterable[StageEntry]) -> float:
        """Frames a second of entries, of keys without a cell, on all switches."""
        bits = {entry.bit for entry in entries}
        return sum(rate for (_, bit), rate in self._rates.items() if bit in bits)

    @property
    def known(self) -> bool:
        """Whether anything is known."""
        return bool(self._seen)

    def told(self, entries: Iterable[StageEntry]) -> CellWords:
        """The cells of a query's entries and how many keys they have."""
        by_bit = {entry.bit: entry for entry in entries}
        firsts = {
            bit: entry if entry.has_cells else by_bit.get(entry.count_of, entry)
            for bit, entry in by_bit.items()
            if entry.role != "clock"
        }
        return CellWords(
            {
                bit: ", ".join(part for part in (f"{first.size:,} cells", self._keys_text(first)) if part)
                for bit, first in firsts.items()
            }
        )

    def _keys_text(self, entry: StageEntry) -> str:
        seen = self._of(entry)
        keys = max((each.keys for each in seen), default=0)
        if keys:
            return f"{_rounded(keys):,} keys seen"
        watched = seen and all(each.last_us - each.since_us >= 2 * entry.window_us for each in seen)
        return f"fewer than {fewest(entry.size) + 1:,} keys" if watched else ""

    def _of(self, entry: StageEntry) -> list[_WatchedCount]:
        return list(self._seen.get(counted(entry), {}).values())


def counted(entry: StageEntry) -> Counted:
    return entry.role, repr(sorted(entry.match.items())), entry.masks, entry.window_us


def keys_of(without: int, cells: int) -> int:
    """How many keys there are where so many find no cell."""
    low, high = float(without), float(without + cells)
    while high - low > 0.5 and cells:
        middle = (low + high) / 2
        low, high = (middle, high) if middle + cells * expm1(-middle / cells) < without else (low, middle)
    return round(high) if without else 0


def fewest(cells: int) -> int:
    """The most keys of which probably none is without a cell."""
    return isqrt(2 * _UNSEEN * cells)


def _cells(keys: int) -> int:
    """A power of two, so that a few keys more or less change nothing."""
    return 1 << (_CELLS_A_KEY * keys - 1).bit_length()


def _rounded(keys: int) -> int:
    """To two digits: more are not known."""
    digits = max(0, len(str(keys)) - 2)
    return round(keys, -digits)


def _places(entry: StageEntry, batch: RecordBatch, *, answers: bool) -> NDArray[np.int64]:
    """A mark for each frame, the same for frames of one key."""
    found = np.zeros(len(batch), dtype=np.uint64)
    for name, mask in entry.masks:
        for part in _parts(_OTHER_SIDE.get(name, name) if answers else name, mask, batch):
            found = (found ^ part) * _MIX
            found ^= found >> np.uint64(29)
    return (found * _MIX >> np.uint64(65 - _MARKS.bit_length())).astype(np.int64)


def _parts(name: str, mask: int, batch: RecordBatch) -> Iterable[NDArray[np.uint64]]:
    """The columns that a mask chooses, masked."""
    if name in _PORTS:
        first, second = _PORTS[name]
        return [np.maximum(np.maximum(batch[first], batch[second]), 0).astype(np.uint64)]
    if name == "length_mask":
        return [batch["length"].astype(np.uint64)]
    side = "src" if name == "source_mask" else "dst"
    return [
        batch[f"ip_{side}_hi"] & np.uint64(mask >> 64),
        batch[f"ip_{side}_lo"] & np.uint64(mask & _LOW),
    ]
