"""A timer that other threads can move without waking the waiting thread.

On systems without such a timer the waiting thread wakes up at the old time, checks, and waits again: it is never
late, but wakes up more often.
"""

import ctypes
import math
import os
import threading
import time
from typing import Any, Protocol

_CLOCK_MONOTONIC = 1
_ABSOLUTE = 1
_CLOSE_ON_EXEC = 0o2000000


class Timer(Protocol):
    """One thread waits; the others set it, one at a time.  Times are those of `time.monotonic`."""

    def set(self, due: float) -> None:
        """Fire at `due` instead of the earlier time; `math.inf`: never."""
        ...

    def wait(self) -> None:
        """Return when it fires, or has fired since it was last set."""
        ...

    def close(self) -> None:
        """Release the timer; setting it has no effect from now on."""
        ...


class KernelTimer:
    """Linux: a timerfd, moved by one system call."""

    def __init__(self) -> None:
        libc: Any = ctypes.PyDLL(
            None, use_errno=True
        )  # PyDLL keeps the GIL: the call is too short to release it
        self._number = libc.timerfd_create(_CLOCK_MONOTONIC, _CLOSE_ON_EXEC)
        if self._number < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        self._settime = libc.timerfd_settime
        self._times = (ctypes.c_long * 4)()  # interval and time, each in seconds and ns

    def set(self, due: float) -> None:
        """See `Timer.set`."""
        if self._number < 0:
            return
        ns = 0 if due == math.inf else max(1, int(due * 1e9))  # 0 disarms
        self._times[2], self._times[3] = divmod(ns, 1_000_000_000)
        self._settime(self._number, _ABSOLUTE, self._times, None)

    def wait(self) -> None:
        """See `Timer.wait`."""
        os.read(self._number, 8)

    def close(self) -> None:
        """See `Timer.close`."""
        number, self._number = self._number, -1
        if number >= 0:
            os.close(number)


class PlainTimer:
    """Any system: an event and the monotonic clock."""

    def __init__(self) -> None:
        self._due = math.inf
        self._earlier = threading.Event()

    def set(self, due: float) -> None:
        """See `Timer.set`."""
        earlier, self._due = due < self._due, due
        if earlier:
            self._earlier.set()

    def wait(self) -> None:
        """See `Timer.wait`."""
        while (left := self._due - time.monotonic()) > 0:
            self._earlier.wait(min(left, threading.TIMEOUT_MAX))
            self._earlier.clear()
        self._due = math.inf

    def close(self) -> None:
        """See `Timer.close`."""


def new_timer() -> Timer:
    """The best timer of this system."""
    try:
        return KernelTimer()
    except (AttributeError, OSError):
        return PlainTimer()
