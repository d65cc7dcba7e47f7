"""What the firewall tells others beside its decisions: EVE lines, notices, the webhook."""

import logging
from collections.abc import Sequence
from typing import Any, Protocol

import due
from apps.firewall.eve import notice_line
from apps.firewall.ledger import Notice
from due import Engine

EVENTS = "network.event.firewall"

log = logging.getLogger(__name__)


class Taker(Protocol):
    """Takes lines without waiting; an `outlets.Outlet`."""

    name: str
    delivered: int
    lost: int

    def put(self, line: str) -> None: ...
    def close(self) -> None: ...


class Announcer:
    """Takers of every event, takers of what is important, and notices as items of DUE."""

    def __init__(self, engine: Engine, every: Sequence[Taker], important: Sequence[Taker]) -> None:
        self._engine = engine
        self._every = every
        self._important = important

    def event(self, line: str, *, important: bool = False) -> None:
        """An EVE line."""
        for outlet in (*self._every, *(self._important if important else ())):
            outlet.put(line)

    def say(self, notice: Notice, level: int = logging.WARNING) -> None:
        """Something that people have to know; below a warning it is no event."""
        log.log(level, "%s", notice.text)
        if level > logging.INFO:
            self.event(notice_line(notice), important=True)
        value = {"kind": notice.kind, "text": notice.text, "event_time": notice.event_time}
        at = notice.event_time or None
        self._engine.write(f"{EVENTS}.{notice.kind}", value, [due.NO_WAIT], event_time=at)

    def close(self) -> None:
        """Deliver what waits."""
        for outlet in (*self._every, *self._important):
            outlet.close()

    def health(self) -> dict[str, Any]:
        """Counters by taker."""
        outlets = (*self._every, *self._important)
        return {
            "events_lost": sum(each.lost for each in outlets),
            "outlets": [
                {"name": each.name, "delivered": each.delivered, "lost": each.lost} for each in outlets
            ],
        }
