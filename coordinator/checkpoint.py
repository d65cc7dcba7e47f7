"""What a Coordinator archives for its successor: the instances, which were active, and the epochs.

    active ──changes──► due.checkpoint.coordinator ──► archive ──newest──► the next Coordinator

It is only a hint: a remembered instance counts from its first heartbeat, which then need not be
answered with a question; the former active instance is preferred if it is alive; epochs never fall. The newest is the
one with the latest time stamp: after a wall clock that went back an older one may be found, which costs a question
to each instance and no more. Unreadable or implausible parts are ignored and logged.
"""

import logging
import threading
import time
from collections.abc import Callable

import msgspec

from coordinator.registry import Checkpoint
from due import DB_ONLY, DueError, Engine
from due.errors import DecodeError

KEY = "due.checkpoint.coordinator"
_EVERY_S = 1.0
_WINDOWS_S = (60, 3600, 7 * 86_400)
"""How far to look back for the newest, step by step."""

log = logging.getLogger("coordinator")


class Checkpoints:
    """Writes changes, at most once a second, and finds the newest checkpoint at start."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._written = -1
        self._write_at = 0.0

    def find(self, found: Callable[[Checkpoint], None]) -> None:
        """Call back with the newest checkpoint, if any, from a thread: the archive may be slow or away."""
        threading.Thread(target=self._find, args=(found,), name="coordinator-checkpoint", daemon=True).start()

    def write(self, changes: int, make: Callable[[], Checkpoint], now: float) -> None:
        """Write the result of `make` if `changes` has increased; call often."""
        if changes == self._written or now < self._write_at:
            return
        self._written, self._write_at = changes, now + _EVERY_S
        try:
            self._engine.write(KEY, msgspec.to_builtins(make()), [DB_ONLY])
        except DueError as error:
            log.warning("the checkpoint could not be written: %s", error)

    def _find(self, found: Callable[[Checkpoint], None]) -> None:
        try:
            newest = self._newest()
        except DueError as error:
            log.error("started without the checkpoint %s, it cannot be read: %s", KEY, error)  # noqa: TRY400
            return
        if newest is not None:
            found(newest)

    def _newest(self) -> Checkpoint | None:
        for window in _WINDOWS_S:
            since = time.time_ns() - window * 1_000_000_000
            items = self._engine.get({"dataKey": KEY, "timestamp": {"$gte": since}}, limit=1)
            if items:
                return checkpoint_in(items[-1].value)
        return None


def checkpoint_in(value: object) -> Checkpoint:
    """The checkpoint that an archived value is.  Raises `DecodeError`; what it says is not judged here."""
    try:
        return msgspec.convert(value, Checkpoint)
    except (DueError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        # msgspec takes an array or a record batch in place of a map for an object, and fails within it
        raise DecodeError(f"not a checkpoint: {error}") from None
