"""The thread that sends what waits: batches whose time is up, paced items, items held for permission.

    outlet ──dirty──► heap by due time ──► service(outlet): cut the batch, release what is due

Few wake-ups: an outlet is in the heap once, one whose writer fills whole frames by itself is looked at
rarely, and one whose writer waits for readers ever more rarely.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

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

Service = Callable[[Outlet, int], float | None]


class Pressure:
    """How rarely to look after writers that need no help: the more rarely, the shorter cores are."""

    def __init__(self) -> None:
        self._wait = 0.0

    def felt(self, late: float) -> float:
        """Seconds to stay away after a visit that came `late`.  One visit in time does not end it, many do."""
        self._wait = min(_PRESSED_WAIT, max(_EASING * self._wait, 8 * (late - _HANDOVER)))
        return self._wait


class Sender:
    """Visits outlets that are dirty, after they have lingered, or when their next paced item is due.

    `service` is called with the outlet's lock held and returns after how many seconds to come again, None
    for not before the outlet is dirty again; `blocked` says that the outlet's writer waits for readers.
    """

    def __init__(self, linger: float, service: Service, blocked: Callable[[Outlet], bool]) -> None:
        self._linger = linger
        self._service = service
        self._blocked = blocked
        self._new: deque[tuple[Outlet, float]] = deque()
        self._heap: list[tuple[float, int, Outlet]] = []
        self._numbers = count()
        self._pressure = Pressure()
        self._kick = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="due-sender", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def dirty(self, outlet: Outlet) -> None:
        """Visit this outlet after the linger time; the caller holds its lock."""
        if not outlet.queued:
            outlet.queued = True
            self._new.append((outlet, time.monotonic() + self._linger))
            self._kick.set()

    def hurry(self, outlet: Outlet) -> None:
        """Visit this outlet now, whatever was planned."""
        outlet.queued = True
        self._new.append((outlet, 0.0))
        self._kick.set()

    def close(self) -> None:
        """Stop; what waits stays."""
        self._stopping.set()
        self._kick.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(5)

    def _run(self) -> None:
        while not self._stopping.is_set():
            pause = max(0.0, self._heap[0][0] - time.monotonic()) if self._heap else None
            if self._kick.wait(pause):
                self._kick.clear()
            while self._new:
                self._plan(*self._new.popleft())
            now = time.monotonic()
            while self._heap and self._heap[0][0] <= now:
                due, _, outlet = heappop(self._heap)
                if outlet.due == due:
                    again = self._visit(outlet, late=now - due)
                    if again is not None:
                        self._plan(outlet, now + again)

    def _plan(self, outlet: Outlet, due: float) -> None:
        outlet.due = due
        heappush(self._heap, (due, next(self._numbers), outlet))

    def _visit(self, outlet: Outlet, late: float) -> float | None:
        """Seconds until the next visit.  Never waits for a writer that waits for readers.

        Where cores are so short that we come `late`, we come more rarely: the writers need them more, and
        each visit to a process that waits for a core costs several wake-ups.
        """
        pressure = self._pressure.felt(late)
        if outlet.filled != outlet.filled_before:
            outlet.filled_before = outlet.filled
            outlet.patience = self._linger
            soon = max(self._linger, min(_BUSY_LINGER, 3 * self._linger))
            return max(soon, min(late, _LONGEST_WAIT), pressure)
        if self._blocked(outlet) or not outlet.lock.acquire(blocking=False):
            outlet.patience = max(min(max(2 * outlet.patience, self._linger, late), _LONGEST_WAIT), pressure)
            return outlet.patience
        try:
            outlet.patience = self._linger
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
