"""The thread that sends what waits: batches whose time is up, paced items, items held for permission."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from due.errors import DueError
from due.outlet import Outlet

log = logging.getLogger("due")


class Sender:
    """Visits outlets that are dirty, after they have lingered, or when their next paced item is due."""

    def __init__(self, linger: float, service: Callable[[Outlet, int], bool]) -> None:
        self._linger = linger
        self._service = service
        self._dirty: deque[Outlet] = deque()
        self._kick = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="due-sender", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def dirty(self, outlet: Outlet) -> None:
        """Visit this outlet after the linger time."""
        self._dirty.append(outlet)
        if not self._kick.is_set():
            self._kick.set()

    def close(self) -> None:
        """Stop; what waits stays."""
        self._stopping.set()
        self._kick.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(5)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._kick.wait()
            self._stopping.wait(self._linger)
            self._kick.clear()
            for outlet in {
                id(o): o for o in (self._dirty.popleft() for _ in range(len(self._dirty)))
            }.values():
                if not self._visit(outlet):
                    self._dirty.append(outlet)
                    self._kick.set()

    def _visit(self, outlet: Outlet) -> bool:
        """Whether it needs no further visit now.  Never waits for a writer that waits for readers."""
        if not outlet.lock.acquire(blocking=False):
            return False
        try:
            return self._service(outlet, time.time_ns())
        except DueError as error:
            log.error("%s: %s", outlet.key, error)  # noqa: TRY400 - no trace needed
            return True
        finally:
            outlet.lock.release()
