"""Reports about decisions: EVE lines, notices, the webhook."""

import logging
from collections.abc import Sequence
from typing import Any, Protocol

import due
from apps.firewall.enforcement.eve import EveFormat, line_of, notice_event
from apps.firewall.policy.block_lifecycle import OperatorNotice
from due import Engine

EVENTS = "network.event.firewall"

log = logging.getLogger(__name__)


class Taker(Protocol):
    """Accepts lines without waiting, such as `event_sink.EventSink`."""

    name: str
    delivered: int
    lost: int

    @property
    def works(self) -> bool: ...

    def put(self, line: str) -> None: ...
    def close(self) -> None: ...


class Announcer:
    """Sinks for every event, sinks for important events only, and notices as DUE items."""

    def __init__(
        self,
        engine: Engine,
        every: Sequence[Taker],
        important: Sequence[Taker],
        form: EveFormat = "eve",
    ) -> None:
        self._engine = engine
        self._form: EveFormat = form
        self._every = every
        self._important = important

    def event(self, line: str, *, important: bool = False) -> None:
        """An EVE line."""
        for sink in (*self._every, *(self._important if important else ())):
            sink.put(line)

    def say(self, notice: OperatorNotice, level: int = logging.WARNING) -> None:
        """Publish a notice for operators; below a warning it is no event."""
        log.log(level, "%s", notice.text)
        if level > logging.INFO:
            self.event(line_of(notice_event(notice), self._form), important=True)
        value = {"kind": notice.kind, "text": notice.text, "event_time": notice.event_time}
        at = notice.event_time or None
        self._engine.write(f"{EVENTS}.{notice.kind}", value, [due.NO_WAIT], event_time=at)

    def check(self) -> None:
        """Raises `RuntimeError` if the thread of a sink has ended with an error."""
        dead = [each.name for each in (*self._every, *self._important) if not each.works]
        if dead:
            raise RuntimeError(f"the thread of {dead[0]} has ended with an error; the log has the reason")

    def close(self) -> None:
        """Deliver what is queued."""
        for sink in (*self._every, *self._important):
            sink.close()

    def health(self) -> dict[str, Any]:
        """Counters by sink."""
        sinks = (*self._every, *self._important)
        return {
            "events_lost": sum(each.lost for each in sinks),
            "sinks": [{"name": each.name, "delivered": each.delivered, "lost": each.lost} for each in sinks],
        }
