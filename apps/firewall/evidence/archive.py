"""Queries to Data Archives with a time limit, so that no decision waits for an unreachable archive.  I/O."""

import logging
import time
from collections.abc import Mapping
from typing import Any, Final

from apps.archive_question import ArchiveQuestion
from due import Engine, Item

ASK_AGAIN_S: Final = 10.0
"""Pause after a query without an answer, in seconds."""

log = logging.getLogger(__name__)


class NoAnswer(Exception):
    """Data Archives did not answer, so that it is not known what they hold."""


MOST: Final = 100_000
"""Most items of one query, the newest."""
OFFENCES_READ: Final = 1_000
"""Most archived blocks read per address, the newest."""


class Archive:
    """Queries with a time limit of `patience_s`; while the archive is unreachable they return None."""

    def __init__(self, engine: Engine, patience_s: float) -> None:
        self._engine = engine
        self._patience_s = patience_s
        self._asked: ArchiveQuestion | None = None
        self._looking: ArchiveQuestion | None = None
        self._look_after = time.monotonic()
        self._looked_to = time.time_ns()
        """Wall time of the last look that was answered; before the first, of the start."""
        self._quiet_until = float("-inf")
        self._answers = True
        self.unanswered = 0
        self.items_read = 0

    @property
    def away(self) -> bool:
        """Whether the last query has no answer so far, or got none a moment ago: another one is not asked."""
        asks = self._asked is not None and self._asked.is_alive()
        return asks or self._quiet_until > time.monotonic()

    def health(self) -> dict[str, int]:
        """Counters for the operator and for Prometheus."""
        return {"archive_away": self.unanswered, "archive_items_read": self.items_read}

    def find(
        self,
        query: str | Mapping[str, Any],
        patience_s: float | None = None,
        *,
        since: int = 0,
        most: int = MOST,
    ) -> list[Item] | None:
        """The newest `most` items written after `since` (ns), oldest first; None if no answer comes in time."""
        asked = {"dataKey": query} if isinstance(query, str) else query
        if self.away:
            self.unanswered += 1
            return None
        question = self._asked = ArchiveQuestion(self._engine, time.time_ns(), [(asked, since, most)])
        question.join(self._patience_s if patience_s is None else patience_s)
        found = None if question.found is None else question.found[0]
        if found is None:
            self.unanswered += 1
            self._quiet_until = time.monotonic() + ASK_AGAIN_S
            if self._answers:
                log.warning("Data Archives do not answer: %s", question.problem)
        self._answers = found is not None
        self.items_read += len(found or ())
        return found

    def look(self, query: Mapping[str, Any], back_ns: int, every_s: float) -> list[Item]:
        """Ask in the background for what is new, at intervals.  Never waits.

        Args:
            query: always the same one.
            back_ns: so much before the last answered look, ns, an item's writer may have dated it.
            every_s: seconds between two questions.

        Returns:
            What the last question has found, once; items of the last `back_ns` come again with each answer.
        """
        if self._looking is not None:
            if self._looking.is_alive():
                return []
            looked, self._looking = self._looking, None
            if looked.found is None:
                return []
            self._looked_to = looked.asked_at
            return looked.found[0]
        if time.monotonic() >= self._look_after:
            self._look_after = time.monotonic() + every_s
            # this machine's clock may have been ahead at that time
            now = time.time_ns()
            since = min(self._looked_to, now) - back_ns
            self._looking = ArchiveQuestion(self._engine, now, [(query, since, MOST)])
        return []
