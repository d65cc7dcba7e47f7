"""Switches: connection, tables and counters."""

import asyncio
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sdnator.dashboard.switch_reading import read_switch
from sdnator.dashboard.texts import number

if TYPE_CHECKING:
    from sdnator.dashboard.page_backend import PageBackend


def _columns(*named: tuple[str, str]) -> list[dict[str, Any]]:
    """Numbers are aligned right, and grouped by thousands as everywhere else."""
    return [
        {
            "name": name,
            "label": name,
            "field": name,
            "align": align,
            "sortable": True,
            **({":format": "(value) => value.toLocaleString('en')"} if align == "right" else {}),
        }
        for name, align in named
    ]


class SwitchesPanel:
    """One browser's view of the switches."""

    def __init__(self, service: "PageBackend") -> None:
        self._board = service.board
        self._places = {place.name: place for place in service.settings.switches}
        first = next(iter(self._places), None)
        with ui.element("div").classes("board"):
            with ui.element("div").classes("panel wide"):
                with ui.element("div").classes("form"):
                    self._chosen = ui.select(list(self._places), value=first, label="switch").props(
                        "outlined dense"
                    )
                    self._chosen.classes("choice")
                    self._chosen.on_value_change(self.refresh)
                    self._state = ui.label("").classes("quiet")
                self._fault = ui.label("").classes("fault")
            with ui.element("div").classes("panel"):
                ui.label("Counters of entries").classes("panel-title")
                columns = _columns(
                    ("packets", "right"), ("bytes", "right"), ("entry", "left"), ("action", "left")
                )
                self._counters = ui.table(rows=[], columns=columns, row_key="id", pagination=12)
                self._counters.props("flat dense rows-per-page-label=rows").classes("plain counters")
                self._counters.add_slot("no-data", '<div class="nothing">nothing is counted</div>')
            with ui.element("div").classes("panel"):
                ui.label("Tables").classes("panel-title")
                columns = _columns(
                    ("table", "left"), ("entries", "right"), ("size", "right"), ("keys", "left")
                )
                self._tables = ui.table(rows=[], columns=columns, row_key="table", pagination=12)
                self._tables.props("flat dense rows-per-page-label=rows").classes("plain tables")

    async def refresh(self) -> None:
        """Read the chosen switch."""
        place = self._places.get(str(self._chosen.value))
        if place is None:
            self._fault.set_text("no switch is known")
            return
        try:
            tables, counters = await asyncio.to_thread(read_switch, place)
        except OSError as error:
            self._fault.set_text(str(error))
            return
        self._fault.set_text("")
        self._state.set_text(self._said(place.name))
        if self._tables.rows != tables:
            self._tables.rows = tables
        if self._counters.rows != counters:
            self._counters.rows = counters

    def _said(self, name: str) -> str:
        with self._board.lock:
            state = self._board.switches.get(name, {})
            owner = next(
                (
                    f" · controller: {one['pid']} on {one['host']}"
                    for one in self._board.instances
                    if one["instance_id"] == state.get("owner")
                ),
                "",
            )
        if not state:
            return "its controller has not reported yet"
        rank = "primary" if state.get("primary") else "backup"
        joined = f"connected, {rank}" if state.get("connected") else "not connected"
        sent, lost = number(int(state.get("packet_in", 0))), number(int(state.get("lost", 0)))
        return f"{joined} · {state.get('program', '')} · {sent} packet-ins, {lost} lost{owner}"
