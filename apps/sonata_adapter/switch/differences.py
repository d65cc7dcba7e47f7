"""Differences that the switch counts in one cell: SYNs - FINs of a host.  Pure.

report: a window is over and a key is still at the threshold or above ─► its result
report: a key has no cell                                      ─► counted here; its cell, should it have got
                                                                  one later, is read when the window is over
sweep: no frame of the query for a while                       ─► the switch is asked to look at what waits

Every frame of the query makes the switch look at one key that waits for the end of a window, so a busy
network needs no sweeps.
"""

from collections.abc import Iterable, Iterator
from typing import Final, Literal

import numpy as np

from apps.sonata_adapter.host.columns import PacketColumns
from apps.sonata_adapter.planner.plan import QueryPlan
from apps.sonata_adapter.query.language import Query
from apps.sonata_adapter.results import QueryResult
from apps.sonata_adapter.switch.cell_read import LATE, TIMEOUT_S, CellRead
from apps.sonata_adapter.switch.clock import Clock
from apps.sonata_adapter.switch.difference_window import DifferenceWindow
from apps.sonata_adapter.switch.register_reads import PATIENCE_S
from apps.sonata_adapter.switch.register_tables import Key, RegisterTables
from apps.sonata_adapter.switch.window_ends import WindowEnds
from due import RecordBatch

SETTLE_S: Final = 0.05
"""Reports of frames without a cell may come so long after those of the window's end: they come in lists."""
_SETTLED_FROM_US: Final = 1_000_000
"""Shorter windows do not wait for them: who asks for such windows wants results soon."""
_SHORTEST_S: Final = 0.2
_LONGEST_S: Final = 5.0
"""Bounds of how often the switch is asked to sweep; in between it is once in a window."""
_AT_ONCE: Final = 64
_PART: Final = 4
"""A part of the window after its end: so long its frames may be under way."""
_KEPT: Final = 64
"""Windows that are remembered, against reports that come twice."""
_NEVER_US: Final = 1 << 47
"""On the switch's clock: after the end of every window."""


class Differences:
    """One query on one switch."""

    def __init__(
        self, query: Query, found: QueryPlan, *, base_us: int = 0, since_us: int | None = None
    ) -> None:
        self._query = query
        self._settle_s = SETTLE_S if query.window_us >= _SETTLED_FROM_US else 0.0
        self._tables = RegisterTables(query)
        self._base_us = base_us
        self._ends = WindowEnds(query, base_us, since_us)
        self._entries = {entry.bit: entry for entry in found.entries}
        self._first = found.entries[0]
        self._windows: dict[int, DifferenceWindow] = {}
        self._questions: dict[int, tuple[int, Key] | None] = {}
        """Window and key; None: a sweep."""
        self._swept_at: float | None = None
        self._more = 0
        """Sweeps to request at once, because more keys wait in the switch."""
        self._ending: float | None = None
        """After the last frame: since when no report has arrived."""
        self._answered = False
        self.tuples = 0
        self.overflow = 0
        """Tuples that were sent because a key had no cell."""
        self.missed = 0
        """Cells read too late, and reports of keys that were already decided."""

    def take(self, bit: int, batch: RecordBatch) -> list[QueryResult]:
        """Frames without a cell; results come when the window is over."""
        entry = self._entries[bit]
        over = batch["overflow"].tolist()
        self.tuples += len(batch)
        self.overflow += int(np.count_nonzero(batch["overflow"]))
        numbers = ((batch["time_us"] - self._base_us) // self._query.window_us).tolist()
        keys = self._tables.keys(entry.source, PacketColumns(batch))
        amounts = batch["length"].tolist() if entry.by_bytes else [1] * len(batch)
        for number, key, without_cell, amount in zip(numbers, keys, over, amounts, strict=True):
            window = self._window(number)
            if not without_cell:
                window.unheard.add(key)  # no room to wait for the window's end
            else:
                window.count(key, -amount if entry.subtracts else amount)
        return []

    def counted(self, batch: RecordBatch, now: float) -> list[QueryResult]:
        """Keys at or above the threshold at the end of their windows, seconds of the caller's clock."""
        self.tuples += len(batch)
        self._ending = now if self._ending is not None else None
        keys = self._tables.told(self._first.source, batch)
        for number, key, counted in zip(batch["window"].tolist(), keys, batch["count"].tolist(), strict=True):
            window = self._window(number)
            if key in window.done:
                self.missed += 1
            else:
                window.told[key] = counted
                window.ready = now + self._settle_s
        return [] if self._settle_s else self._decided(batch["window"].tolist())

    def _decided(self, numbers: Iterable[int]) -> list[QueryResult]:
        """Results of keys that the switch alone has counted, of windows that wait for nothing."""
        found: list[QueryResult] = []
        for number in dict.fromkeys(numbers):
            window = self._windows[number]
            found += self._results(number, window, sorted(window.whole()))
        return found

    def due(self, clock: Clock, now: float) -> list[CellRead]:
        """Questions about windows that are over, and sweeps while the switch has nothing to do."""
        asked = [self._sweep(1, 0) for _ in range(self._sweeps(now))]
        heard = clock.heard_us
        silent = clock.idle_s(now) >= self._query.window_us / 1e6 + PATIENCE_S
        for number, window in self._windows.items():
            settled = (
                heard is not None and heard >= self._ends.end_us(number) + self._query.window_us // _PART
            )
            if window.over is None and (settled or silent):
                window.over = now
                asked += self._ask(number, window)
        return asked

    def finish(self, now: float) -> list[CellRead]:
        """Requests for all windows, after the last frame; called until nothing `waits`."""
        if self._ending is None:
            self._drop_sweeps()
            self._more = 1
        if self._more or self._answered:
            self._ending = now
        far_us = self._base_us + _NEVER_US
        asked = [self._sweep(2, far_us) for _ in range(self._more)]
        self._more, self._answered = 0, False
        for number, window in self._windows.items():
            if window.over is None:
                window.over = now
                asked += self._ask(number, window)
        return asked

    def waits_for(self, question: int) -> bool:
        return question in self._questions

    def waits(self, now: float) -> bool:
        """Whether an answer is outstanding, or, at the end, a report."""
        reading = any(window.waiting for window in self._windows.values())
        if self._ending is None:
            return reading
        return bool(reading or self._questions or self._more or now - self._ending < 2 * SETTLE_S)

    @property
    def open(self) -> int:
        """Windows that may still yield results."""
        return sum(1 for window in self._windows.values() if window.is_open)

    def answer(self, question: int, counted: int, clock: Clock) -> list[QueryResult]:
        """The count of a key, or whether more keys wait in the switch."""
        asked = self._questions.pop(question)
        self._answered = True
        self.tuples += 1
        if asked is None:
            self._more = min(_AT_ONCE, max(2, 2 * self._more)) if counted else self._more
            return []
        number, key = asked
        self.overflow += 1  # it would not have been asked for
        window = self._windows[number]
        window.waiting.discard(question)
        window.read[key] = self._first.value(counted)
        is_late = (clock.heard_us or 0) >= self._ends.end_us(number + 1)
        if is_late or not counted:
            self.missed += 1
            window.unsure.add(key)
        return []

    def expire(self, _: Clock, now: float) -> list[QueryResult]:
        """Results that nothing is waited for any more, or whose answers are overdue: as estimates."""
        found: list[QueryResult] = []
        for number, window in list(self._windows.items()):
            if window.over is not None and now - window.over >= TIMEOUT_S:
                self._give_up(window)
            if now >= window.ready:
                found += self._results(number, window, sorted(window.whole()))
            if window.over is not None and not window.waiting and now >= window.ready:
                found += self._results(number, window, sorted(window.split()))
        self._forget()
        return found

    def flush(self) -> list[QueryResult]:
        """Report the remaining results: no more answers will arrive."""
        found: list[QueryResult] = []
        for number, window in list(self._windows.items()):
            unasked = [] if window.over is not None else self._unread(window)
            if unasked:
                window.errors[f"{len(unasked)} keys were not asked for"] = None
                window.unsure.update(unasked)
            self._give_up(window)
            found += self._results(number, window, sorted((*window.whole(), *window.split())))
        self._windows.clear()
        self._questions.clear()
        return found

    def set_back(self, now_us: int) -> list[QueryResult]:
        """The switch's clock was set back to `now_us`: report the remaining results, and begin anew."""
        found = self.flush()
        self._ends.since_us = now_us
        return found

    def _window(self, number: int) -> DifferenceWindow:
        return self._windows.setdefault(number, DifferenceWindow())

    def _sweeps(self, now: float) -> int:
        """Number of sweeps to request now: one from time to time, more if the switch reports waiting keys."""
        every = min(_LONGEST_S, max(_SHORTEST_S, self._query.window_us / 1e6))
        if self._swept_at is None:
            self._swept_at = now
        found, self._more = self._more, 0
        if now - self._swept_at >= every:
            self._swept_at = now
            self._drop_sweeps()
            found = max(found, 1)
        return found

    def _drop_sweeps(self) -> None:
        """Drop unanswered sweeps, which found nothing."""
        self._questions = {n: asked for n, asked in self._questions.items() if asked is not None}

    def _sweep(self, kind: Literal[1, 2], time_us: int) -> CellRead:
        read = CellRead(bit=self._first.bit, time_us=time_us, sweep=kind)
        self._questions[read.id] = None
        return read

    def _unread(self, window: DifferenceWindow) -> list[Key]:
        """Keys whose cells may make them results."""
        return [key for key in window.candidates(self._first.threshold) if key not in window.told]

    def _ask(self, number: int, window: DifferenceWindow) -> Iterator[CellRead]:
        for key in self._unread(window):
            read = self._tables.question(
                self._first.bit, self._first.source, key, self._ends.middle_us(number)
            )
            self._questions[read.id] = (number, key)
            window.waiting.add(read.id)
            yield read

    def _give_up(self, window: DifferenceWindow) -> None:
        """Stop waiting for this window's answers."""
        if window.waiting:
            window.errors[f"{len(window.waiting)} cells could not be read"] = None
        for question in window.waiting:
            asked = self._questions.pop(question)
            if asked is not None:
                window.unsure.add(asked[1])
        window.waiting.clear()

    def _results(self, number: int, window: DifferenceWindow, keys: list[Key]) -> list[QueryResult]:
        found: list[QueryResult] = []
        for key in keys:
            total = window.total(key)
            window.done.add(key)
            errors = [*window.errors, *([LATE] if key in window.unsure else [])]
            if total >= self._first.threshold:
                counts = {0: total}
                found += [
                    self._ends.result(number, fields, errors)
                    for fields in self._tables.results([(key, counts)])
                ]
        return found

    def _forget(self) -> None:
        """Forget old windows for which nothing is expected."""
        closed = [number for number, window in self._windows.items() if not window.is_open]
        for number in sorted(closed)[: max(0, len(self._windows) - _KEPT)]:
            del self._windows[number]
