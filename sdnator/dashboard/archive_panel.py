"""Archive: items of the past by key and time."""

import asyncio
import json
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from nicegui import ui

from apps.incidents import Incident
from apps.messages import MessageError
from due.errors import DueError
from due.keys import Key
from sdnator.dashboard.texts import clock, incident_row
from sdnator.errors import BadInput
from sdnator.notation import brief, instant_ns, typed_key
from sdnator.plurals import counted
from sdnator.rights.audited_deed import AUDITED

if TYPE_CHECKING:
    from due import Item
    from sdnator.dashboard.operator_actions import OperatorActions
    from sdnator.dashboard.page_backend import PageBackend

_AUDITED = Key.parse(AUDITED)
_INCIDENTS = Key.parse("network.incident.firewall.*")
_LIMIT = 200
_TEXT = 400


class ArchivePanel:
    """One browser's searches."""

    def __init__(self, service: "PageBackend", acting: "OperatorActions") -> None:
        self._service = service
        self._acting = acting
        self._opened = False
        with ui.element("div").classes("panel"):
            with ui.element("div").classes("form"):
                self._key = ui.input(
                    "Key; * is one segment, ** the rest", value="network.incident.firewall.*"
                )
                self._key.props("outlined dense").style("flex: 1 1 280px").classes("search-key")
                self._since = ui.input("From: 1h, 2d or a time", value="1d").props("outlined dense")
                self._until = ui.input("To: empty is now").props("outlined dense")
                ui.button("Search", icon="search", on_click=self._search).props("unelevated no-caps").classes(
                    "search-now"
                )
                if acting.allowed:
                    ui.button("Who did what", icon="history", on_click=self._audit).props(
                        "unelevated no-caps"
                    ).classes("audit-now")
                self._key.on("keydown.enter", self._search)
            self._said = ui.label("").classes("quiet said")
            columns = [
                {"name": name, "label": name, "field": name, "align": "left"}
                for name in ("time", "key", "value")
            ]
            self._table = ui.table(rows=[], columns=columns, row_key="id", pagination=25)
            self._table.props("flat dense rows-per-page-label=rows").classes("plain found")
            self._table.add_slot("no-data", '<div class="nothing">nothing to show</div>')

    async def open(self) -> None:
        """The first search, of the incidents of the last day: the page opens with something to see."""
        if not self._opened:
            self._opened = True
            await self._search()

    async def _audit(self) -> None:
        self._key.set_value(AUDITED)
        await self._search()

    async def _search(self) -> None:
        now = time.time_ns()
        try:
            key = typed_key(str(self._key.value or "").strip())
            start = instant_ns(str(self._since.value), now, "from") if self._since.value else 0
            end = instant_ns(str(self._until.value), now, "to") if self._until.value else now + 1
            items, more = await asyncio.to_thread(self._service.find, key, start, end, _LIMIT)
        except (BadInput, DueError) as error:
            self._said.set_text(str(error))
            self._table.rows = []
            return
        if not self._acting.allowed:
            # whoever is refused may have typed a password for a name, and a browser's address is its owner's
            items = [item for item in items if not is_of_the_trail(item)]
        shown = newest_reports(items)
        self._table.rows = [row(place, item) for place, item in enumerate(reversed(shown))]
        newest = "; of each incident the newest report is shown" if len(shown) < len(items) else ""
        older = f"; there are older ones: these are the {_LIMIT} newest" if more else ""
        self._said.set_text(f"{counted(len(items), 'item')}{newest}{older}")


def newest_reports(items: Sequence["Item"]) -> list["Item"]:
    """All items, but of each incident the last: one that goes on is reported every second."""
    last = {str(item.value.get("id")): item for item in items if _is_incident(item)}
    return [item for item in items if not _is_incident(item) or last[str(item.value.get("id"))] is item]


def _is_incident(item: "Item") -> bool:
    return isinstance(item.value, dict) and _INCIDENTS.matches_path(Key.parse(item.key).path)


def _words(item: "Item") -> str:
    """An incident as the overview tells it, other values as JSON."""
    if _is_incident(item):
        try:
            told = incident_row(Incident.from_value(item.value))
        except MessageError:  # shown as it is
            pass
        else:
            return " · ".join(filter(None, (told["target"], told["where"], told["reason"], told["said"])))
    return json.dumps(brief(item.value), ensure_ascii=False)


def is_of_the_trail(item: "Item") -> bool:
    """Whether it says what somebody did: for operators only."""
    return _AUDITED.matches_path(Key.parse(item.key).path)


def row(place: int, item: "Item") -> dict[str, Any]:
    """An item for the table; what is long is told by its size."""
    text = _words(item)
    return {
        "id": place,
        "time": clock(item.event_time),
        "key": item.key,
        "value": text if len(text) <= _TEXT else text[:_TEXT] + "…",
    }
