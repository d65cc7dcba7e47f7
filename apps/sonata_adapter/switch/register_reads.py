"""Counts that are read from the switch at a window's end, for the keys that may become results.

report: a key reached its candidate count ─► when the window is over, read its cells of all sources
report: a key has no cell                 ─► counted here, exactly
answers ─► the query's own steps over these keys ─► results

The switch's clock, known from what it sends, tells when a window is over.  If it falls
silent, cells are requested early: they may be overwritten before the next report, and since a
count only grows, the larger of two answers is right.  A key whose answers arrived too late is reported
with the known counts, as an estimate.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.planner.placement import StageEntry
from apps.sonata_adapter.planner.plan import QueryPlan
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult
from apps.sonata_adapter.switch.cell_read import LATE, TIMEOUT_S, CellRead
from apps.sonata_adapter.switch.clock import Clock
from apps.sonata_adapter.switch.register_tables import Key, RegisterTables
from apps.sonata_adapter.switch.register_window import MOST_KEYS, RegisterWindow
from apps.sonata_adapter.switch.window_ends import WindowEnds
from due import RecordBatch

PATIENCE_S: Final = 10.0
"""A switch that is silent for a window and this long, seconds, has nothing to report; it is not just slow."""
_EARLY: Final = 4
"""A part of the window after its end: so long the switch's clock is waited for before cells are asked early,
and so long reports may be under way behind it."""
_SILENT: Final = "the switch sent nothing; the end was taken from this machine's clock"


class _Question(NamedTuple):
    window: int
    bit: int
    key: Key
    last: bool
    """Asked when the window was over, so that its answer is waited for."""


class RegisterReads:
    """One query on one switch."""

    def __init__(
        self, query: Query, found: QueryPlan, *, base_us: int = 0, since_us: int | None = None
    ) -> None:
        self._query = query
        self._tables = RegisterTables(query)
        self._base_us = base_us
        self._ends = WindowEnds(query, base_us, since_us)
        self._reduces = {entry.bit: entry for entry in found.entries if entry.role == "reduce"}
        self._windows: dict[int, RegisterWindow] = {}
        self._closed: int | None = None
        """The newest window whose state was dropped."""
        self._questions: dict[int, _Question] = {}
        self.tuples = 0
        self.overflow = 0
        """Tuples that were sent because a key had no cell."""
        self.missed = 0
        """Cells read too late, and reports for windows that ended long ago."""

    def take(self, bit: int, batch: RecordBatch) -> list[QueryResult]:
        """Note candidates and keys without a cell; results come with the answers."""
        self.tuples += len(batch)
        self.overflow += int(np.count_nonzero(batch["overflow"]))
        packets = PacketColumns(batch)
        numbers = ((batch["time_us"] - self._base_us) // self._query.window_us).tolist()
        entry = self._reduces.get(bit)
        if entry is not None:
            self._counted(entry, packets, numbers, batch)
        for behind in [each for each in self._reduces.values() if bit in each.behind]:
            self._distinct(behind, packets, numbers)
        return []

    def _window(self, number: int) -> RegisterWindow | None:
        if self._closed is not None and number <= self._closed:
            self.missed += 1
            return None
        return self._windows.setdefault(number, RegisterWindow())

    def _counted(
        self, entry: StageEntry, packets: PacketColumns, numbers: list[int], batch: RecordBatch
    ) -> None:
        """Keys that reached the candidate count, and frames whose key has no cell."""
        over = batch["overflow"].tolist()
        amounts = batch["length"].tolist() if entry.by_bytes else [1] * len(batch)
        keys = self._tables.keys(entry.source, packets)
        for number, key, without_cell, amount in zip(numbers, keys, over, amounts, strict=True):
            window = self._window(number)
            if window is None:
                continue
            place = (entry.bit, key)
            if without_cell:
                window.apart[place] = window.apart.get(place, 0) + amount
            else:
                window.reported.add(place)
            if entry.threshold and window.apart.get(place, entry.threshold) >= entry.threshold:
                window.remember(key)

    def _distinct(self, entry: StageEntry, packets: PacketColumns, numbers: list[int]) -> None:
        """Tuples without a cell in the stage of the distinct: duplicates are removed here."""
        keys = self._tables.keys(entry.source, packets)
        tuples = self._tables.tuples(entry.source, packets)
        for number, key, values in zip(numbers, keys, tuples, strict=True):
            window = self._window(number)
            if window is None:
                continue
            if entry.threshold:
                window.remember(key)
            held = window.tuples.setdefault((entry.bit, key), set())
            if len(held) < MOST_KEYS:
                held.add(values)
            elif values not in held:
                window.errors["a key had too many tuples without a cell in the switch"] = None

    def due(self, clock: Clock, now: float) -> list[CellRead]:
        """Requests for windows that are over, or seem to be over while the switch is silent."""
        asked: list[CellRead] = []
        heard, guess = clock.heard_us, clock.guess_us(now)
        if heard is None or guess is None:
            return asked
        length = self._query.window_us
        silent = clock.idle_s(now) >= length / 1e6 + PATIENCE_S
        for number, window in self._windows.items():
            end = self._ends.end_us(number)
            if window.over is None and (heard >= end or silent):
                self._is_over(window, now)
                if heard < end:
                    window.errors[_SILENT] = None
                elif window.early is not None:
                    window.early_counts = (clock.was_us(window.early) or 0) >= end
            window.settled = silent or heard >= end + length // _EARLY
            if window.over is not None:
                asked += self._ask(number, window, last=True)
            elif guess >= end + length // _EARLY:
                window.early = now if window.early is None else window.early
                asked += self._ask(number, window, last=False)
        return asked

    def finish(self, now: float) -> list[CellRead]:
        """Requests for all windows, after the last frame."""
        asked: list[CellRead] = []
        for number, window in self._windows.items():
            if window.over is None:
                self._is_over(window, now)
            window.settled = True
            asked += self._ask(number, window, last=True)
        return asked

    def waits_for(self, question: int) -> bool:
        return question in self._questions

    def waits(self, now: float) -> bool:  # noqa: ARG002 - as `Differences` has it
        """Whether an answer is outstanding."""
        return any(window.waiting for window in self._windows.values())

    @property
    def open(self) -> int:
        """Windows that may still yield results."""
        return sum(1 for window in self._windows.values() if window.over is None or window.pending)

    def answer(self, question: int, counted: int, clock: Clock) -> list[QueryResult]:
        """The count of a key.

        Results come once all answers of the window are there.
        """
        asked = self._questions.pop(question, None)
        window = None if asked is None else self._windows.get(asked.window)
        if asked is None or window is None:
            return []
        self.tuples += 1
        place = (asked.bit, asked.key)
        before = window.cells.get(place)
        window.cells[place] = max(counted, before or 0)
        if not asked.last:
            return []
        window.waiting.discard(question)
        least = self._reduces[asked.bit].threshold if place in window.reported else 0
        is_lost = counted < max(least, before or 0)
        is_late = (clock.heard_us or 0) >= self._ends.end_us(asked.window + 1)
        self.missed += is_lost or is_late
        if (is_lost or is_late) and not (window.early_counts and before is not None and before >= least):
            (window.doubtful if is_lost else window.unsure).add(asked.key)
        return self._finished(asked.window, window)

    def expire(self, clock: Clock, now: float) -> list[QueryResult]:
        """Results of windows that have nothing to wait for, or whose answers are overdue: as estimates."""
        found: list[QueryResult] = []
        for number, window in list(self._windows.items()):
            if window.over is not None and now - window.over >= TIMEOUT_S:
                self._give_up(window)
            found += self._finished(number, window)
            is_past = clock.heard_us is not None and clock.heard_us >= self._ends.end_us(number + 1)
            if window.over is not None and not window.pending and not window.waiting and is_past:
                self._forget(number)
        return found

    def flush(self) -> list[QueryResult]:
        """Report the remaining results as estimates: no more answers will arrive."""
        found: list[QueryResult] = []
        for number, window in list(self._windows.items()):
            if window.over is None:
                self._is_over(window, 0.0)
            window.settled = True
            unasked = len(window.unasked[True])
            if unasked:
                window.errors[f"{unasked} keys were not asked for"] = None
                window.doubtful.update(window.unasked[True])
                window.unasked[True].clear()
            self._give_up(window)
            found += self._finished(number, window)
            self._forget(number)
        return found

    def set_back(self, now_us: int) -> list[QueryResult]:
        """The switch's clock was set back to `now_us`: report the remaining results, and begin anew."""
        found = self.flush()
        self._closed = None
        self._ends.since_us = now_us
        return found

    def _forget(self, number: int) -> None:
        del self._windows[number]
        self._closed = max(number, self._closed if self._closed is not None else number)
        self._questions = {n: asked for n, asked in self._questions.items() if asked.window != number}

    def _give_up(self, window: RegisterWindow) -> None:
        """Do not wait any longer."""
        if window.waiting:
            window.errors[f"{len(window.waiting)} cells could not be read"] = None
        for question in window.waiting:
            window.doubtful.add(self._questions.pop(question).key)
        window.waiting.clear()

    def _is_over(self, window: RegisterWindow, now: float) -> None:
        window.over = now
        if window.beyond:
            window.errors[f"{window.beyond} keys beyond the bound of {MOST_KEYS} were not looked at"] = None

    def _ask(self, number: int, window: RegisterWindow, *, last: bool) -> Iterator[CellRead]:
        keys = window.unasked[last]
        window.unasked[last] = []
        for key in keys:
            for entry in self._reduces.values():
                if (entry.bit, key) in window.apart:
                    continue
                read = self._tables.question(entry.bit, entry.source, key, self._ends.middle_us(number))
                self._questions[read.id] = _Question(number, entry.bit, key, last)
                if last:
                    window.waiting.add(read.id)
                yield read

    def _finished(self, number: int, window: RegisterWindow) -> list[QueryResult]:
        """Results of the keys of which all is known."""
        if window.over is None or window.waiting or not window.pending:
            return []
        unasked = set(window.unasked[True])
        ready = [key for key in window.pending if key not in unasked and self._is_whole(window, key)]
        for key in ready:
            del window.pending[key]
        groups: tuple[list[tuple[Key, dict[int, int]]], ...] = ([], [], [])
        for key in ready:
            group = 2 if key in window.doubtful else 1 if key in window.unsure else 0
            groups[group].append((key, self._counts(window, key)))
        sure, unsure, doubtful = groups
        reasons = list(window.errors)
        doubts = reasons or [LATE]
        return [
            *(self._ends.result(number, fields, reasons) for fields in self._tables.results(sure)),
            *(self._ends.result(number, fields, doubts) for fields in self._tables.results(unsure)),
            *(self._ends.result(number, fields, doubts) for fields in self._tables.guesses(doubtful)),
        ]

    def _is_whole(self, window: RegisterWindow, key: Key) -> bool:
        """Whether no more reports of a key without a cell are under way."""
        return window.settled or not any(
            (bit, key) in window.apart or (bit, key) in window.tuples for bit in self._reduces
        )

    def _counts(self, window: RegisterWindow, key: Key) -> dict[int, int]:
        """What is known of a key, by source."""
        counts: dict[int, int] = {}
        for bit, entry in self._reduces.items():
            place = (bit, key)
            cell = window.cells.get(place, 0)
            if place in window.reported:
                cell = max(cell, entry.threshold)
            more = window.apart.get(place, 0) + len(window.tuples.get(place, ()))
            counts[entry.source] = counts.get(entry.source, 0) + cell + more
        return counts
