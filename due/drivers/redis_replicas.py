"""How far replicas are with what a producer has sent: `WAIT`, pipelined like everything else.

    XADD, XADD, WAIT ──► how many replicas have all of it ──► kept entries up to here may be forgotten

An entry that no replica has is lost with the primary.  Its producer keeps it, and appends it to the next primary.
"""

import logging
import time
from typing import Any

import msgspec

from due.errors import UpdatesUnavailable

log = logging.getLogger("due.updates")

_WAIT_MS = 100
"""The server answers nothing else on this connection meanwhile."""
_TOLD_AFTER = 5.0


class ReplicaQuestion(msgspec.Struct, frozen=True):
    """Awaits how many replicas have every entry up to this number."""

    number: int


class Confirmations:
    """Numbers the entries of one producer in the order in which they are sent.  Not thread-safe.

    Args:
        least: how many replicas must have an entry; 0: none, and entries have no numbers.
        place: of the server, for messages.
    """

    def __init__(self, least: int, place: str) -> None:
        self.least = least
        self.confirmed = 0
        """Entries up to this number are on enough replicas."""
        self._place = place
        self._sent = 0
        self._asked = False
        self._missing_since: float | None = None
        self._told = False

    @property
    def missing(self) -> int:
        """Entries that have not been confirmed."""
        return self._sent - self.confirmed

    def number(self) -> int:
        """The number of an entry that is being sent, for the first time or again."""
        if self.least:
            self._sent += 1
        return self._sent

    def question(self) -> ReplicaQuestion | None:
        """What to ask now; None while an answer is awaited, or nothing is missing."""
        if self._asked or not self.missing:
            return None
        self._asked = True
        return ReplicaQuestion(self._sent)

    def command(self) -> tuple[bytes | str | int, ...]:
        """How to ask it."""
        return b"WAIT", self.least, _WAIT_MS

    def answered(self, question: ReplicaQuestion, reply: Any) -> None:
        """Take the answer; raises `UpdatesUnavailable` for one that says nothing."""
        self._asked = False
        if not isinstance(reply, int):
            raise UpdatesUnavailable(f"the server does not say which replicas confirm: {reply}")
        if reply >= self.least:
            self.confirmed = max(self.confirmed, question.number)
            self._missing_since, self._told = None, False
        else:
            self._still_missing(reply, time.monotonic())

    def lost(self) -> None:
        """The connection was lost, and with it the answer that was awaited."""
        self._asked = False

    def _still_missing(self, replicas: int, now: float) -> None:
        if self._missing_since is None:
            self._missing_since = now
        if now - self._missing_since > _TOLD_AFTER and not self._told:
            self._told = True
            log.warning(
                "only %d of %d replicas of %s confirm items: these are kept, and writers wait when the window is full",
                replicas,
                self.least,
                self._place,
            )
