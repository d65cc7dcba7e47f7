"""Digests and packet-ins of one switch → packet records, each frame once, in the order of their numbers.

The switch numbers the frames that it reports or copies, in one sequence.  A frame arrives as digest, as
packet-in, or as both.  A copy has all fields; a digest has them if the switch's parser covers the frame.

    digests     1 2 3 · 5 6 7       (4 came as a copy only)
    packet-ins  · · · 4 · 6         (6 is not covered by the parser)
    records     1 2 3 4 5 6 7

A missing number is waited for until it arrives, until both streams have passed it, or until `flush`.  The switch's
numbers have 32 bits and skip 0; between arrival and record they go on behind them.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from apps.p4runtime_ctrl.southbound.loss_tracker import WRAP, Source, numbers_between, steps_ahead, unwrapped
from apps.p4runtime_ctrl.southbound.rows import has_bit
from due import RecordBatch

_LONGEST: Final = 1 << 16
"""Most rows that wait."""
_ALL: Final = 1 << 62
"""No number is higher."""

_Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class PacketRows:
    """Packet records with the requests that each meets; `whole`: whether the row has all fields."""

    columns: _Columns
    queries: NDArray[np.uint8]
    whole: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.queries)

    @property
    def sequence(self) -> NDArray[np.int64]:
        return self.columns["sequence"].astype(np.int64)

    def numbered(self, numbers: NDArray[np.int64]) -> "PacketRows":
        """The same rows with other numbers."""
        return PacketRows(self.columns | {"sequence": numbers.astype(np.uint64)}, self.queries, self.whole)

    def only(self, rows: NDArray[Any] | slice) -> "PacketRows":
        columns = {name: column[rows] for name, column in self.columns.items()}
        return PacketRows(columns, self.queries[rows], self.whole[rows])

    def where(self, chosen: NDArray[np.bool_]) -> "PacketRows":
        """The chosen rows; a copy only if others are left out."""
        return self if chosen.all() else self.only(chosen)

    def split(self, number: int) -> "tuple[PacketRows, PacketRows]":
        """Of rows in order: those up to a number, and those behind it; nothing is copied."""
        place = int(np.searchsorted(self.sequence, number, side="right"))
        return self.only(slice(0, place)), self.only(slice(place, None))

    def replaced(self, places: NDArray[np.intp], others: "PacketRows") -> "PacketRows":
        """A copy with other rows at some places."""
        found = PacketRows(
            {name: column.copy() for name, column in self.columns.items()},
            self.queries.copy(),
            self.whole.copy(),
        )
        for name, column in found.columns.items():
            column[places] = others.columns[name]
        found.queries[places], found.whole[places] = others.queries, others.whole
        return found

    def matching(self, bit: int) -> RecordBatch:
        """The records that meet a request."""
        rows = has_bit(self.queries, bit)
        return RecordBatch(
            self.columns if rows.all() else {name: column[rows] for name, column in self.columns.items()}
        )


class SequenceMerger:
    """Merges the two streams of one switch.  Not thread-safe."""

    def __init__(self) -> None:
        self.copies = 0
        """Records that were made from copied frames."""
        self.skipped = 0
        """Numbers that were given up; their frames are dropped if they arrive later."""
        self._held: dict[Source, PacketRows | None] = {"digest": None, "packet": None}
        self._passed: dict[Source, int] = {"digest": 0, "packet": 0}
        self._told = 0
        """All numbers up to this one are finished."""
        self._follows = False
        """`_told` is what another controller reported last; it may have handed on more."""

    def __len__(self) -> int:
        """Rows that wait."""
        return sum(len(rows) for rows in self._held.values() if rows is not None)

    def begin_anew(self) -> None:
        """Another controller receives the frames from now on."""
        self._passed = dict.fromkeys(self._passed, 0)
        self._told, self._follows = 0, False

    def follow(self, sequence: int) -> None:
        """Go on behind another controller, unless rows were told already.

        Args:
            sequence: the highest number that it has reported.
        """
        if not self._told:
            self._passed = {stream: max(number, sequence) for stream, number in self._passed.items()}
            self._told, self._follows = sequence, True

    @property
    def waits_for(self) -> int:
        """The missing number that rows wait for; 0 if none wait."""
        return self._told + 1 if len(self) else 0

    def digests(self, rows: PacketRows) -> list[PacketRows]:
        """Add reported frames, in the order of their stream; returns the rows that are complete."""
        return self._take("digest", rows)

    def packets(self, rows: PacketRows) -> list[PacketRows]:
        """Add copied frames, in the order of their stream; returns the rows that are complete."""
        return self._take("packet", rows)

    def flush(self) -> list[PacketRows]:
        """Return all waiting rows and give up missing numbers."""
        before, self._follows = 0 if self._follows else self._told, False
        told = self._tell(_ALL)
        if told:
            first = before + 1 if before else unwrapped(int(told[0].sequence[0]), self._told)
            self.skipped += numbers_between(first, self._told + 1) - sum(map(len, told))
        return told

    def _take(self, stream: Source, rows: PacketRows) -> list[PacketRows]:
        if self._is_next(rows):
            self._told = self._passed[stream] = _next(self._told) - 1 + len(rows)
            self.copies += len(rows) if stream == "packet" else 0
            return [rows]
        rows = rows.where(rows.sequence != 0)
        if not len(rows):
            return []
        numbers = rows.sequence
        # a stream that was silent for long goes on where the other one is
        before = max(self._passed[stream], unwrapped(int(numbers[0]), self._told) - 1)
        steps, restarts = steps_ahead(numbers, before)
        back = np.flatnonzero(restarts | (steps == 0))
        if not len(back):
            return self._follow(stream, _placed(rows, before + np.cumsum(steps)))
        told: list[PacketRows] = []
        for begin, end in pairwise(sorted({0, *back.tolist(), len(rows)})):
            if begin in back:  # the switch counts from 1 again
                told += self.flush()
                self._passed = dict.fromkeys(self._passed, 0)
                self._told = before = 0
                steps[begin] = numbers[begin]
            part = slice(begin, end)
            told += self._follow(stream, _placed(rows.only(part), before + np.cumsum(steps[part])))
        return told

    def _is_next(self, rows: PacketRows) -> bool:
        """The usual case: nothing waits, nothing is missing."""
        if len(self) or not len(rows) or not rows.whole.all():
            return False
        first = _next(self._told) % WRAP
        return bool((rows.sequence == np.arange(first, first + len(rows))).all())

    def _follow(self, stream: Source, rows: PacketRows) -> list[PacketRows]:
        self._passed[stream] = int(rows.sequence[-1])
        _, rows = rows.split(self._told)
        held = self._held[stream]
        self._held[stream] = rows if held is None else _joined(held, rows)
        return self._tell(self._decided()) if len(self) <= _LONGEST else self.flush()

    def _decided(self) -> int:
        """The highest number up to which each number has arrived or is given up."""
        both = _next(max(self._told, min(self._passed.values()))) - 1
        there = [rows.sequence[rows.whole] for rows in self._held.values() if rows is not None and len(rows)]
        later = [numbers[numbers > both] for numbers in there]
        # each of them is in order already: merging them is faster than np.unique, which hashes
        numbers = np.sort(np.concatenate(later), kind="stable") if later else np.zeros(0, np.int64)
        numbers = numbers[np.diff(numbers, prepend=both) != 0]
        run = numbers == both + 1 + np.arange(len(numbers))
        return both + (len(run) if run.all() else int(run.argmin()))

    def _tell(self, end: int) -> list[PacketRows]:
        """The rows up to a number; a copy is preferred to a digest of the same frame."""
        chosen: dict[Source, PacketRows] = {}
        for stream, rows in self._held.items():
            if rows is None:
                continue
            chosen[stream], rest = rows.split(end)
            self._held[stream] = rest if len(rest) else None
        self._told = max(self._told, min(end, max(self._passed.values())))
        chosen = {stream: rows for stream, rows in chosen.items() if len(rows)}
        self.copies += len(chosen.get("packet", ()))
        found = [self._merged(**chosen)] if len(chosen) > 1 else list(chosen.values())
        if self._told < WRAP:
            return found
        return [rows.numbered(rows.sequence & (WRAP - 1)) for rows in found]

    def _merged(self, packet: PacketRows, digest: PacketRows) -> PacketRows:
        known, numbers = packet.sequence, digest.sequence
        places = np.searchsorted(numbers, known)
        if (numbers[np.minimum(places, len(numbers) - 1)] == known).all():
            return digest.replaced(places, packet)  # as usual: what is copied is reported, too
        place = np.minimum(np.searchsorted(known, numbers), len(known) - 1)
        rows = _joined(packet, digest.where(known[place] != numbers))
        return rows.only(np.argsort(rows.sequence, kind="stable"))


def _next(number: int) -> int:
    """The number after one: none is 0 modulo 2^32."""
    return number + 1 + ((number + 1) % WRAP == 0)


def _placed(rows: PacketRows, numbers: NDArray[np.int64]) -> PacketRows:
    """The rows with numbers that go on behind the wrap."""
    return rows if int(numbers[-1]) < WRAP else rows.numbered(numbers)


def _joined(first: PacketRows, second: PacketRows) -> PacketRows:
    return PacketRows(
        {name: np.concatenate((first.columns[name], second.columns[name])) for name in first.columns},
        np.concatenate((first.queries, second.queries)),
        np.concatenate((first.whole, second.whole)),
    )
