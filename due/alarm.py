"""An alarm clock that others may set anew without waking up who sleeps by it.

Where the system has no timer that can be moved while somebody waits for it, the sleeper gets up at the old time,
looks, and lies down again: it is late for nothing, but costs wake-ups.
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


class Alarm(Protocol):
    """One thread waits; any thread, one at a time, sets.  Times are those of `time.monotonic`."""

    def set(self, due: float) -> None:
        """Ring at `due` and no longer at the time before; `math.inf`: not at all."""
        ...

    def wait(self) -> None:
        """Return when it rings, or has rung since it was set last."""
        ...

    def close(self) -> None:
        """Nobody waits any more; setting it has no effect from now on."""
        ...


class KernelAlarm:
    """Linux: a timerfd, which is moved by one call of the system."""

    def __init__(self) -> None:
        libc: Any = ctypes.PyDLL(None, use_errno=True)  # PyDLL: too short to give up the interpreter for it
        self._number = libc.timerfd_create(_CLOCK_MONOTONIC, _CLOSE_ON_EXEC)
        if self._number < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        self._settime = libc.timerfd_settime
        self._times = (ctypes.c_long * 4)()  # interval and time, each in seconds and ns

    def set(self, due: float) -> None:
        """See `Alarm.set`."""
        if self._number < 0:
            return
        ns = 0 if due == math.inf else max(1, int(due * 1e9))  # 0 disarms
        self._times[2], self._times[3] = divmod(ns, 1_000_000_000)
        self._settime(self._number, _ABSOLUTE, self._times, None)

    def wait(self) -> None:
        """See `Alarm.wait`."""
        os.read(self._number, 8)

    def close(self) -> None:
        """See `Alarm.close`."""
        number, self._number = self._number, -1
        if number >= 0:
            os.close(number)


class PlainAlarm:
    """Anywhere: an event, and a look at the clock."""

    def __init__(self) -> None:
        self._due = math.inf
        self._earlier = threading.Event()

    def set(self, due: float) -> None:
        """See `Alarm.set`."""
        earlier, self._due = due < self._due, due
        if earlier:
            self._earlier.set()

    def wait(self) -> None:
        """See `Alarm.wait`."""
        while (left := self._due - time.monotonic()) > 0:
            self._earlier.wait(min(left, threading.TIMEOUT_MAX))
            self._earlier.clear()
        self._due = math.inf

    def close(self) -> None:
        """See `Alarm.close`."""


def new_alarm() -> Alarm:
    """The best there is here."""
    try:
        return KernelAlarm()
    except (AttributeError, OSError):
        return PlainAlarm()
