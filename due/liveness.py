"""Whether an engine's threads still make progress, for supervisors.

    main thread ──ask──► dispatcher ──answer, between two frames──► beat() is True ──► a byte on --heartbeat-fd
                                                                 └─► state() ──► /healthz, health

If a question stays unanswered while a callback runs, the callback is slow ("busy"); otherwise the thread hangs
("stalled").  The heartbeat thread must keep looping.  The archiver may wait for its archive and is only watched
for its death, which `Engine.failed` reports.
"""

import os
import time
from collections.abc import Callable
from typing import Any

from due.archiver import Archiver
from due.dispatcher import Dispatcher
from due.errors import InvalidOption
from due.heartbeat_thread import HeartbeatThread

STALLED_SECONDS = 15.0
BUSY_SECONDS = 60.0
"""A callback that runs for longer counts as hung."""


class Liveness:
    """Asks the dispatcher and watches the other threads.  Thread-safe."""

    def __init__(
        self, dispatcher: Dispatcher, heartbeats: HeartbeatThread, archiver: Callable[[], Archiver | None]
    ) -> None:
        self._dispatcher = dispatcher
        self._heartbeats = heartbeats
        self._archiver = archiver
        self._seen = -1.0

    def beat(self) -> bool:
        """Whether the threads answered since the last call; asks them again."""
        answered = self._dispatcher.answered
        alive = answered != self._seen and self._heartbeat_silent() < STALLED_SECONDS
        self._seen = answered
        self._dispatcher.ask()
        return alive

    def state(self) -> dict[str, Any]:
        """`status`: ok, busy or stalled; and for each thread the seconds since its last sign of life."""
        self._dispatcher.ask()
        unanswered, heartbeats, archiver = (
            self._dispatcher.unanswered(),
            self._heartbeat_silent(),
            self._archiver(),
        )
        busy = self._dispatcher.busy_since is not None
        shown: dict[str, Any] = {"dispatcher_s": round(unanswered, 1), "heartbeat_s": round(heartbeats, 1)}
        if archiver is not None:
            shown["archiver_s"] = round(time.monotonic() - archiver.turned, 1)
        stalled = unanswered > (BUSY_SECONDS if busy else STALLED_SECONDS) or heartbeats > STALLED_SECONDS
        slow = busy and unanswered > 1.0
        return {"status": "stalled" if stalled else "busy" if slow else "ok", **shown}

    def _heartbeat_silent(self) -> float:
        return time.monotonic() - self._heartbeats.turned


class HeartbeatPipe:
    """The pipe on which a process reports to its supervisor that it works: a byte about every second.

    Raises `InvalidOption` where the descriptor is not open.
    """

    def __init__(self, number: int) -> None:
        try:
            os.set_blocking(number, False)
            os.set_inheritable(number, False)
        except OSError as error:
            raise InvalidOption(
                f"--heartbeat-fd {number}: {error.strerror}; give an open pipe's descriptor"
            ) from None
        self._number = number

    def beat(self) -> None:
        """Write one byte; a full or closed pipe is not an error, because nobody may be reading."""
        try:
            os.write(self._number, b".")
        except OSError:
            return
