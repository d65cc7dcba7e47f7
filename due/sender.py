"""The thread that sends waiting items: lingering batches, paced items, items held until assigned.

    KeyWriter ──dirty──► heap by due time ──► service(writer): send the batch, release due items

Each wake-up takes the interpreter from a busy writer and costs several context switches. Therefore each new
batch postpones the timer: a writer that fills whole frames itself, or waits for readers, is not interrupted.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from heapq import heappop, heappush, heapreplace
from itertools import count

from due.errors import DueError
from due.key_writer import KeyWriter
from due.threads import Failed, LoudThread
from due.timer import PlainTimer, Timer, new_timer

log = logging.getLogger("due")

_BUSY_LINGER = 0.005
"""Longest linger time of a batch while its writer fills frames faster than that."""
_LONGEST_WAIT = 0.05
_PRESSED_WAIT = 0.2
"""The same on an overloaded machine, where a wake-up is later than a switch of the interpreter takes."""
_HANDOVER = 0.01
_EASING = 0.8
_FRAME_EASING = 0.95
_FORGET_SECONDS = 1.0
"""A writer whose flush is overdue by more than this is rescheduled from now."""

Service = Callable[[KeyWriter, int], float | None]


class Pressure:
    """How long to leave alone writers that fill frames themselves: the longer, the busier the cores are."""

    def __init__(self) -> None:
        self._wait = 0.0

    def felt(self, late: float) -> float:
        """Seconds until the next flush after one that was `late`; decays slowly over punctual ones."""
        self._wait = min(_PRESSED_WAIT, max(_EASING * self._wait, 8 * (late - _HANDOVER)))
        return self._wait


class Agenda:
    """Due times of flushes.  Holds each writer once, with its newest time.  Not thread-safe."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, KeyWriter]] = []
        self._tickets = count(1)

    @property
    def next(self) -> float:
        """The earliest due time; infinite if nothing is scheduled."""
        return self._heap[0][0] if self._heap else math.inf

    def plan(self, writer: KeyWriter, due: float) -> None:
        """Schedule a writer, replacing its earlier due time."""
        writer.due, writer.ticket = due, next(self._tickets)
        entry = (due, writer.ticket, writer)
        if self._heap and self._heap[0][2] is writer:
            heapreplace(self._heap, entry)
        else:
            heappush(self._heap, entry)

    def postpone(self, writer: KeyWriter, due: float) -> None:
        """Move a writer to a later time; a writer that is not first in the heap is only marked."""
        writer.due = due
        if self._heap and self._heap[0][1] == writer.ticket:
            self.plan(writer, due)

    def take(self, now: float) -> list[tuple[float, KeyWriter]]:
        """Remove and return the writers that are due, with their due times."""
        found = []
        while self._heap and self._heap[0][0] <= now:
            _, ticket, writer = heappop(self._heap)
            if ticket != writer.ticket:
                continue
            if writer.due > now:
                self.plan(writer, writer.due)
            else:
                found.append((writer.due, writer))
        return found


class BatchSender:
    """Flushes key writers after their linger time, or when their next paced item is due.

    `service` is called with the writer's lock held and returns after how many seconds to come again, None
    for not before the writer is dirty again; `blocked` says that a writer waits for readers.
    """

    def __init__(
        self,
        linger: float,
        service: Service,
        blocked: Callable[[KeyWriter], bool],
        failed: Failed | None = None,
    ) -> None:
        self._linger = linger
        self._service = service
        self._blocked = blocked
        self._lock = threading.RLock()
        """Guards agenda and timer; always taken after a writer's own lock, never before it."""
        self._agenda = Agenda()
        self._alarm: Timer = PlainTimer()  # until a better timer is needed, which costs a file descriptor
        self._rings_at = math.inf
        self._pressure = Pressure()
        self._stopping = False
        self._thread = LoudThread("due-sender", self._run, failed)

    def start(self) -> None:
        """Begin."""
        with self._lock:
            self._alarm, self._rings_at = new_timer(), math.nan
            self._set()
        self._thread.start()

    def dirty(self, writer: KeyWriter) -> None:
        """Schedule a flush: a batch has begun or an item is paced.  The caller holds the writer's lock.

        It comes after the linger time, or later if the writer fills whole frames on an overloaded machine.
        """
        now = time.monotonic()
        with self._lock:
            eased = _FRAME_EASING * writer.stay if now - writer.due < _FORGET_SECONDS else 0.0
            stay = writer.stay = max(self._linger, eased)
            if not writer.queued:
                writer.queued = True
                self._agenda.plan(writer, now + stay)
                self._set()
            elif writer.pacer is None and 0.0 < writer.due < now + stay / 2:
                # not for each batch: setting the timer is a system call
                self._agenda.postpone(writer, now + stay)
                self._set()

    def hurry(self, writer: KeyWriter) -> None:
        """Flush this writer now."""
        with self._lock:
            writer.queued = True
            self._agenda.plan(writer, 0.0)
            self._set()

    def close(self) -> None:
        """Stop; waiting items are not sent."""
        with self._lock:
            self._stopping = True
            self._set()
        if threading.current_thread() is self._thread:
            return
        if self._thread.is_alive():
            self._thread.join(5)
        if not self._thread.is_alive():
            with self._lock:
                self._alarm.close()

    def _set(self) -> None:
        rings_at = 0.0 if self._stopping else self._agenda.next
        if rings_at != self._rings_at:
            self._rings_at = rings_at
            self._alarm.set(rings_at)

    def _run(self) -> None:
        while not self._stopping:
            self._alarm.wait()
            now = time.monotonic()
            with self._lock:
                due = self._agenda.take(now)
            for planned, writer in due:
                ticket = writer.ticket
                again = self._visit(writer, late=now - planned if planned else 0.0)
                with self._lock:
                    if again is not None and writer.ticket == ticket:  # otherwise `hurry` was called
                        self._agenda.plan(writer, now + again)
            with self._lock:
                self._rings_at = math.nan  # the timer has fired
                self._set()

    def _visit(self, writer: KeyWriter, late: float) -> float | None:
        """Flush one writer; returns seconds until the next flush.  Skips a writer that waits for readers.

        If this flush is `late`, the cores are overloaded, and the next ones come less often: the writers need
        the CPU more, and each flush costs several wake-ups.
        """
        with self._lock:
            if writer.empty and (writer.fast or writer.lock.locked()):
                # the writer is sending or waits for readers; its next batch schedules a new flush
                writer.queued = False
                return None
        pressure = self._pressure.felt(late)
        if writer.filled != writer.filled_before:
            writer.filled_before = writer.filled
            writer.patience = self._linger
            soon = max(self._linger, min(_BUSY_LINGER, 3 * self._linger))
            writer.stay = max(soon, min(late, _LONGEST_WAIT), pressure)
            return writer.stay
        if self._blocked(writer) or not writer.lock.acquire(blocking=False):
            writer.patience = max(min(max(2 * writer.patience, self._linger, late), _LONGEST_WAIT), pressure)
            return writer.patience
        try:
            writer.patience = writer.stay = self._linger
            writer.queued = False
            again = self._service(writer, time.time_ns())
            writer.queued = again is not None
        except DueError as error:
            log.error("%s: %s", writer.key, error)  # noqa: TRY400 - no trace needed
            return None
        else:
            return again
        finally:
            writer.lock.release()
