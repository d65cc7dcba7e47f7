"""Questions to Data Archives that nobody has to wait for.  I/O."""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

from apps.messages import read_latest
from due import Engine, Item
from due.errors import DueError


class ArchiveQuestion(threading.Thread):
    """Asks at once, in a thread, because an archive that is away may take half a minute to say so.

    Args:
        engine: of the app.
        asked_at: wall time, ns.
        queries: each with the time since which items were written, ns, and most items, the newest.
    """

    def __init__(
        self, engine: Engine, asked_at: int, queries: Sequence[tuple[Mapping[str, Any], int, int]]
    ) -> None:
        super().__init__(name="archive question", daemon=True)
        self._engine = engine
        self._queries = queries
        self.asked_at = asked_at
        self.found: list[list[Item]] | None = None
        """By query, oldest first; None: no answer."""
        self.problem = "no answer in time"
        self.start()

    def run(self) -> None:
        """Ask."""
        try:
            self.found = [read_latest(self._engine, *each) for each in self._queries]
        except DueError as error:
            self.problem = str(error)
