"""The thread that sends what waits: batches whose time is up, paced items, items held for permission.

    outlet ──dirty──► heap by due time ──► service(outlet): cut the batch, release what is due

Few wake-ups, for each takes the interpreter from a writer that computes, and costs both several switches: each
new batch moves the alarm on, so a writer that fills whole frames by itself, or waits for readers, is left alone.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from heapq import heappop, heappush, heapreplace
from itertools import count

from due.alarm import Alarm, PlainAlarm, new_alarm
from due.errors import DueError
from due.outlet import Outlet

log = logging.getLogger("due")

_BUSY_LINGER = 0.005
"""How long a batch lingers at most while its writer fills frames faster than that."""
_LONGEST_WAIT = 0.05
_PRESSED_WAIT = 0.2
"""The same where cores are so short that a visit comes late by more than handing over the interpreter takes."""
_HANDOVER = 0.01
_EASING = 0.8
_FRAME_EASING = 0.95
_FORGET_SECONDS = 1.0
"""Who has not been visited for so long after it was planned begins anew."""

Service = Callable[[Outlet, int], float | None]


class Pressure:
    """How rarely to look after writers that need no help: the more rarely, the shorter cores are."""

    def __init__(self) -> None:
        self._wait = 0.0

    def felt(self, late: float) -> float:
        """Seconds to stay away after a visit that came `late`.  One visit in time does not end it, many do."""
        self._wait = min(_PRESSED_WAIT, max(_EASING * self._wait, 8 * (late - _HANDOVER)))
        return self._wait


class Agenda:
    """When to visit whom.  Each outlet stands in it once; its newest time counts.  Not thread-safe."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Outlet]] = []
        self._tickets = count(1)

    @property
    def next(self) -> float:
        """When to look again, at the latest; infinite where nothing is planned."""
        return self._heap[0][0] if self._heap else math.inf

    def plan(self, outlet: Outlet, due: float) -> None:
        """Visit it then, and not when it was planned before."""
        outlet.due, outlet.ticket = due, next(self._tickets)
        entry = (due, outlet.ticket, outlet)
        if self._heap and self._heap[0][2] is outlet:
            heapreplace(self._heap, entry)
        else:
            heappush(self._heap, entry)

    def postpone(self, outlet: Outlet, due: float) -> None:
        """The same for an outlet that is planned for an earlier time; noted where it does not come first."""
        outlet.due = due
        if self._heap and self._heap[0][1] == outlet.ticket:
            self.plan(outlet, due)

    def take(self, now: float) -> list[tuple[float, Outlet]]:
        """Whose time has come, and when that was."""
        found = []
        while self._heap and self._heap[0][0] <= now:
            _, ticket, outlet = heappop(self._heap)
            if ticket != outlet.ticket:
                continue
            if outlet.due > now:
                self.plan(outlet, outlet.due)
            else:
                found.append((outlet.due, outlet))
        return found


class Sender:
    """Visits outlets that are dirty, after they have lingered, or when their next paced item is due.

    `service` is called with the outlet's lock held and returns after how many seconds to come again, None
    for not before the outlet is dirty again; `blocked` says that the outlet's writer waits for readers.
    """

    def __init__(self, linger: float, service: Service, blocked: Callable[[Outlet], bool]) -> None:
        self._linger = linger
        self._service = service
        self._blocked = blocked
        self._lock = threading.RLock()
        """Guards the agenda and the alarm; taken by holders of an outlet's lock, never the other way round."""
        self._agenda = Agenda()
        self._alarm: Alarm = PlainAlarm()  # until it is needed: a better one costs a descriptor
        self._rings_at = math.inf
        self._pressure = Pressure()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="due-sender", daemon=True)

    def start(self) -> None:
        """Begin."""
        with self._lock:
            self._alarm, self._rings_at = new_alarm(), math.nan
            self._set()
        self._thread.start()

    def dirty(self, outlet: Outlet) -> None:
        """A batch has begun, or an item waits for its pace: visit this outlet later; the caller holds its lock.

        Later is after the linger time, or longer where the writer fills whole frames and cores are short.
        """
        now = time.monotonic()
        with self._lock:
            eased = _FRAME_EASING * outlet.stay if now - outlet.due < _FORGET_SECONDS else 0.0
            stay = outlet.stay = max(self._linger, eased)
            if not outlet.queued:
                outlet.queued = True
                self._agenda.plan(outlet, now + stay)
                self._set()
            elif outlet.pacer is None and 0.0 < outlet.due < now + stay / 2:
                # not at each batch, for to set the alarm costs a call of the system
                self._agenda.postpone(outlet, now + stay)
                self._set()

    def hurry(self, outlet: Outlet) -> None:
        """Visit this outlet now, whatever was planned."""
        with self._lock:
            outlet.queued = True
            self._agenda.plan(outlet, 0.0)
            self._set()

    def close(self) -> None:
        """Stop; what waits stays."""
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
            for planned, outlet in due:
                ticket = outlet.ticket
                again = self._visit(outlet, late=now - planned if planned else 0.0)
                with self._lock:
                    if again is not None and outlet.ticket == ticket:  # else somebody is in a hurry
                        self._agenda.plan(outlet, now + again)
            with self._lock:
                self._rings_at = math.nan  # it has rung
                self._set()

    def _visit(self, outlet: Outlet, late: float) -> float | None:
        """Seconds until the next visit.  Never waits for a writer that waits for readers.

        Where cores are so short that we come `late`, we come more rarely: the writers need them more, and
        each visit to a process that waits for a core costs several wake-ups.
        """
        with self._lock:
            if outlet.empty and (outlet.fast or outlet.lock.locked()):
                # its writer is sending, or waits for readers: the next batch will say so
                outlet.queued = False
                return None
        pressure = self._pressure.felt(late)
        if outlet.filled != outlet.filled_before:
            outlet.filled_before = outlet.filled
            outlet.patience = self._linger
            soon = max(self._linger, min(_BUSY_LINGER, 3 * self._linger))
            outlet.stay = max(soon, min(late, _LONGEST_WAIT), pressure)
            return outlet.stay
        if self._blocked(outlet) or not outlet.lock.acquire(blocking=False):
            outlet.patience = max(min(max(2 * outlet.patience, self._linger, late), _LONGEST_WAIT), pressure)
            return outlet.patience
        try:
            outlet.patience = outlet.stay = self._linger
            outlet.queued = False
            again = self._service(outlet, time.time_ns())
            outlet.queued = again is not None
        except DueError as error:
            log.error("%s: %s", outlet.key, error)  # noqa: TRY400 - no trace needed
            return None
        else:
            return again
        finally:
            outlet.lock.release()
