"""A thread that dies ends the process: a partly working switch is worse than one that is restarted."""

import os
import sys
import threading
import traceback
from threading import ExceptHookArgs
from typing import Protocol

_PATIENCE_S = 5.0


class _Stop(Protocol):
    def set(self) -> None: ...


class Faults:
    """Install the hook for threads that end with an error.

    stop: ends the main thread's wait
    """

    def __init__(self, stop: _Stop) -> None:
        self.died = False
        self._stop = stop
        threading.excepthook = self._take

    def _take(self, fault: ExceptHookArgs) -> None:
        name = "unknown" if fault.thread is None else fault.thread.name
        print(f"dataplane: the thread {name} died, so the switch ends", file=sys.stderr)
        traceback.print_exception(fault.exc_type, fault.exc_value, fault.exc_traceback)
        sys.stderr.flush()
        self.died = True
        self._stop.set()

    def end_soon(self) -> None:
        """End the process in any case: a shutdown may wait for the thread that died."""
        timer = threading.Timer(_PATIENCE_S, os._exit, (1,))
        timer.daemon = True
        timer.start()
