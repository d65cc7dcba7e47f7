"""What a Coordinator leaves in the archive for the next one: who was here, who worked, and the epochs.

    leading ──changes──► due.checkpoint.coordinator ──► archive ──newest──► the next Coordinator

It is a hint, never an order: a remembered instance counts from its first sign of life, which then need not be
answered with a question; the former working instance is preferred if it lives; epochs never fall.
"""

import logging
import threading
import time
from collections.abc import Callable

import msgspec

from coordinator.registry import Checkpoint
from due import DB_ONLY, DueError, Engine

KEY = "due.checkpoint.coordinator"
_EVERY_S = 1.0
_WINDOWS_S = (60, 3600, 7 * 86_400)
"""How far to look back for the newest, step by step."""

log = logging.getLogger("coordinator")


class Checkpoints:
    """Writes what changed, at most once a second, and finds the newest at the start."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._written = -1
        self._write_at = 0.0

    def find(self, found: Callable[[Checkpoint], None]) -> None:
        """Call back with the newest, if there is one, from a thread: the archive may be slow or away."""
        threading.Thread(target=self._find, args=(found,), name="coordinator-checkpoint", daemon=True).start()

    def write(self, changes: int, make: Callable[[], Checkpoint], now: float) -> None:
        """Keep what `make` says, if `changes` has moved on; call often."""
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
        except (DueError, msgspec.ValidationError) as error:
            log.warning("no checkpoint: %s", error)
            return
        if newest is not None:
            found(newest)

    def _newest(self) -> Checkpoint | None:
        for window in _WINDOWS_S:
            since = time.time_ns() - window * 1_000_000_000
            items = self._engine.get({"dataKey": KEY, "timestamp": {"$gte": since}}, limit=1)
            if items:
                return msgspec.convert(items[-1].value, Checkpoint)
        return None
