"""Threads whose death is logged and reported.

engine's thread ──unexpected exception──► log with traceback ──► failed(error) ──► Engine.failed: calls raise
                                                                              └──► service.run: exit code 1
"""

import logging
import threading
from collections.abc import Callable

log = logging.getLogger("due")

Failed = Callable[[BaseException], None]


class LoudThread(threading.Thread):
    """A daemon thread that logs and reports the exception it dies of.

    `run`: the body; an exception that leaves it is a bug.  `failed` is called in the dying thread.
    """

    def __init__(self, name: str, run: Callable[[], None], failed: Failed | None = None) -> None:
        super().__init__(name=name, daemon=True)
        self.failed: Failed = failed or (lambda _error: None)
        self._work = run

    def run(self) -> None:
        """See `threading.Thread.run`."""
        try:
            self._work()
        except BaseException as error:
            log.critical("the thread %s died; the engine cannot work without it", self.name, exc_info=error)
            self.failed(error)
