"""What Data Archives know, asked so that a decision never waits for an archive that is away.  I/O."""

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

from due import Engine, Item
from due.errors import DueError

ASK_AGAIN_S: Final = 10.0
"""After a question without an answer the next one is asked this much later."""

log = logging.getLogger(__name__)


class _Question(threading.Thread):
    def __init__(self, engine: Engine, query: str | Mapping[str, Any]) -> None:
        super().__init__(name="archive question", daemon=True)
        self._engine = engine
        self._query = query
        self.items: list[Item] | None = None
        self.problem = "no answer in time"
        self.start()

    def run(self) -> None:
        try:
            self.items = self._engine.get(self._query)
        except DueError as error:
            self.problem = str(error)


class Archive:
    """Questions with a time limit of `patience_s`; while the archive is away they are answered with None."""

    def __init__(self, engine: Engine, patience_s: float) -> None:
        self._engine = engine
        self._patience_s = patience_s
        self._asked: _Question | None = None
        self._looking: _Question | None = None
        self._look_after = time.monotonic()
        self._quiet_until = float("-inf")
        self.unanswered = 0

    @property
    def away(self) -> bool:
        """Whether the last question got no answer."""
        return self._quiet_until > time.monotonic()

    def find(self, query: str | Mapping[str, Any], patience_s: float | None = None) -> list[Item] | None:
        """Items, oldest first; None where the archive does not answer in time."""
        if self.away or (self._asked is not None and self._asked.is_alive()):
            self.unanswered += 1
            return None
        question = self._asked = _Question(self._engine, query)
        question.join(self._patience_s if patience_s is None else patience_s)
        found = question.items
        if found is None:
            self.unanswered += 1
            self._quiet_until = time.monotonic() + ASK_AGAIN_S
            log.warning("Data Archives do not answer, deciding without history: %s", question.problem)
        return found

    def look(self, query: Mapping[str, Any], every_s: float) -> list[Item]:
        """What a question in the background has found by now; a new one is asked every so often.  Never waits."""
        if self._looking is not None:
            if self._looking.is_alive():
                return []
            found, self._looking = self._looking.items or [], None
            return found
        if time.monotonic() >= self._look_after:
            self._look_after = time.monotonic() + every_s
            self._looking = _Question(self._engine, query)
        return []
