"""Payloads that cannot be set aside while the server is away: kept within bounds, and stored later.

set_aside ──► store ──► the server
                │ away          ▲
                └──► queue ──care──┘   what does not fit, or is left at the end, is lost and counted
"""

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from due.backoff import Backoff
from due.errors import BackendError, UpdatesUnavailable
from due.logs import LogLimit

log = logging.getLogger("due.updates")

_MOST_ENTRIES = 1000
_MOST_BYTES = 16 << 20


class AsidePayload(NamedTuple):
    """What is to be set aside, and why."""

    path: str
    payload: bytes
    reason: str
    size: int
    """Bytes of the whole payload, of which this may be the beginning."""


class AsideQueue:
    """Stores payloads in order; thread-safe.

    Args:
        store: raises `UpdatesUnavailable` where the same call may succeed later, and another `BackendError` where it
            never will.
    """

    def __init__(self, store: Callable[[AsidePayload], None]) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._waiting: deque[AsidePayload] = deque()
        self._bytes = 0
        self._backoff = Backoff()
        self._reason = ""
        """Of the last failure."""
        self._errors = LogLimit(log)
        self.lost = 0
        """Payloads that were not stored and never will be."""

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, one: AsidePayload, now: float) -> None:
        """Store it, or keep it until `care`."""
        with self._lock:
            if not self._waiting and self._done(one, now):
                return
            if len(self._waiting) >= _MOST_ENTRIES or self._bytes + len(one.payload) > _MOST_BYTES:
                self._lose(one, "there is no room for it while the server is away")
                return
            if not self._waiting:
                log.warning(
                    "payloads cannot be set aside now; they wait here for the server: %s", self._reason
                )
            self._waiting.append(one)
            self._bytes += len(one.payload)

    def care(self, now: float) -> None:
        """Try again what waits, when it is time."""
        if self._waiting and self._backoff.due(now):
            with self._lock:
                self._try_again(now)

    def patience(self, now: float) -> float:
        """Seconds until `care` has something to do."""
        return self._backoff.wait(now) if self._waiting else float("inf")

    def close(self, now: float) -> None:
        """Try one last time; what is left is lost."""
        with self._lock:
            self._try_again(now)
            for one in self._waiting:
                self._lose(one, self._reason)
            self._waiting.clear()
            self._bytes = 0

    def _try_again(self, now: float) -> None:
        while self._waiting and self._done(self._waiting[0], now):
            self._bytes -= len(self._waiting.popleft().payload)

    def _done(self, one: AsidePayload, now: float) -> bool:
        """Whether it is stored, or lost; False: try again later."""
        try:
            self._store(one)
        except UpdatesUnavailable as error:
            self._reason = str(error)
            self._backoff.failed(now)
            return False
        except BackendError as error:
            self._lose(one, str(error))
            return True
        self._backoff.succeeded()
        return True

    def _lose(self, one: AsidePayload, why: str) -> None:
        self.lost += 1
        self._errors.error("a payload of %s could not be set aside and is lost: %s", one.path, why)
