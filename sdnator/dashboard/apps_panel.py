"""Apps: who is here and how they are, and who gets what from whom."""

from typing import Any

from nicegui import ui

from sdnator.dashboard.board import Board
from sdnator.dashboard.charts import flow_chart
from sdnator.dashboard.texts import number

_COLUMNS = [
    {"name": name, "label": label, "field": name, "align": align}
    for name, label, align in (
        ("app", "app", "left"),
        ("state", "state", "left"),
        ("process", "process", "left"),
        ("written", "written", "right"),
        ("received", "received", "right"),
        ("silent", "silent for", "right"),
        ("health", "health", "left"),
    )
]
_FAULTS = (
    "lost",
    "gaps",
    "dropped_slow",
    "callback_errors",
    "set_aside",
    "set_aside_lost",
    "undecodable",
    "away",
)


class AppsPanel:
    """One browser's view of the apps."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._seen = -1
        with ui.element("div").classes("board"):
            with ui.element("div").classes("panel wide"):
                ui.label("Who gets what from whom").classes("panel-title")
                ui.label(
                    "▲ items written, ▼ items received a second; point at an arrow for its keys and their rates"
                ).classes("quiet")
                self._chart = ui.echart(flow_chart((), (), {}, {}), renderer="svg").style(
                    "height: 380px; width: 100%"
                )
                self._chart.classes("flow")
            with ui.element("div").classes("panel wide"):
                ui.label("Instances").classes("panel-title")
                self._fault = ui.label("").classes("fault")
                self._table = ui.table(rows=[], columns=_COLUMNS, row_key="id").props("flat dense")
                self._table.classes("plain instances")

    def refresh(self) -> None:
        """Send what has changed since the last time."""
        board = self._board
        with board.lock:
            if board.versions["apps"] == self._seen:
                return
            self._seen = board.versions["apps"]
            here = board.present()
            names = {app["app_id"] for app in here}
            options = flow_chart(here, board.flow, board.rates, board.rates_by_key())
            rows = [self._row(one) for one in board.instances if one["app_id"] in names]
            fault = board.coordinator
        self._chart.options.clear()
        self._chart.options.update(options)
        self._chart.update()
        self._table.rows = rows
        self._fault.set_text(fault)

    def _row(self, one: dict[str, Any]) -> dict[str, Any]:
        return {
            "id": one["instance_id"],
            "app": one["app_id"],
            "state": one["state"],
            "process": f"{one['pid']} on {one['host']}",
            "written": f"{one['written']:,}",
            "received": f"{one['received']:,}",
            "silent": f"{one['silent_s']:.1f} s",
            "health": faults_in(self._board.health.get(one["app_id"], {})),
        }


def faults_in(health: Any) -> str:
    """What of an engine's counters tells of trouble, as text."""
    if not health:
        return "-"
    engine = health.get("engine", {})
    counters = {**engine.get("updates", {}), **engine.get("receiving", {}), **engine.get("archive", {})}
    found = [f"{name.replace('_', ' ')} {number(counters[name])}" for name in _FAULTS if counters.get(name)]
    return ", ".join(found) or "well"
