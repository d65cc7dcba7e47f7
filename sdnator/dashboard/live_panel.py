"""Live: figures, the plot of scores, incidents, what is blocked and why, alerts."""

import time
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sdnator.dashboard.charts import score_chart, score_points, threshold, top
from sdnator.dashboard.texts import alert_row, decision_row, incident_row, number
from sdnator.model_words import model_lines

if TYPE_CHECKING:
    from nicegui.events import GenericEventArguments

    from sdnator.dashboard.acting import Acting
    from sdnator.dashboard.page_backend import PageBackend

_SHOWN = 50
_LISTS_SECONDS = 1.0
"""Lists change no more often: people read them, and press buttons in them."""
_ENTRY = """
<q-tr :props="props"><q-td colspan="100%"><div class="entry">
  <div :class="'mark ' + (props.row.action || 'alert')"></div>
  <div class="text">
    <div><b>{{ props.row.target }}</b> <span class="quiet">{{ props.row.action || '' }}</span></div>
    <div class="second">{{ props.row.where }}</div>
    <div class="second">{{ props.row.reason }}</div>
    <div class="second" v-if="props.row.said">{{ props.row.said }}</div>
  </div>
  <div class="side">BUTTONS</div>
</div></q-td></q-tr>
"""
_BUTTON = """<q-btn SHOWN flat dense no-caps size="sm" color="primary" icon="ICON" LABEL
  class="NAME" @click="() => $parent.$emit('NAME', props.row)" />"""


def _button(name: str, label: str, icon: str, shown: str = "") -> str:
    made = _BUTTON
    for word, text in (("SHOWN", shown), ("ICON", icon), ("LABEL", label), ("NAME", name)):
        made = made.replace(word, text)
    return made


class LivePanel:
    """One browser's view of what happens now."""

    def __init__(self, service: "PageBackend", acting: "Acting") -> None:
        self._board = service.board
        self._acting = acting
        self._seen: dict[str, int] = {}
        self._listed = float("-inf")
        self._numbers: dict[str, ui.label] = {}
        with ui.element("div").classes("figures q-mb-sm"):
            for name in (
                "packets scored/s",
                "above the threshold",
                "open incidents",
                "alerts",
                "blocks and guards",
                "apps active",
                "switches",
            ):
                with ui.element("div").classes("figure"):
                    self._numbers[name] = ui.label("-").classes("number")
                    ui.label(name).classes("name")
        self._model = ui.label("").classes("quiet model q-mb-sm").style("white-space: pre-line")
        with ui.element("div").classes("board"):
            with ui.element("div").classes("panel wide"):
                ui.label("Anomaly scores").classes("panel-title")
                self._chart = ui.echart(score_chart()).style("height: 260px; width: 100%").classes("scores")
            with ui.element("div").classes("panel wide"):
                ui.label("Incidents").classes("panel-title")
                self._incidents = self._feed("incidents", "", "no incidents")
            with ui.element("div").classes("panel"):
                ui.label("Blocks and guards").classes("panel-title")
                undo = _button("undo", ':label="props.row.undo"', "undo", 'v-if="props.row.undo"')
                buttons = undo + _button("allow", 'label="Allow"', "verified_user", 'v-if="props.row.allow"')
                wrong = 'v-if="props.row.false_alarm"'
                buttons += _button("false_alarm", 'label="False alarm"', "school", wrong)
                self._decisions = self._feed("decisions", buttons, "nothing is blocked, guarded or limited")
                self._decisions.on("undo", self._undo)
                self._decisions.on("allow", self._allow)
                self._decisions.on("false_alarm", self._false_alarm)
            with ui.element("div").classes("panel"):
                ui.label("Alerts").classes("panel-title")
                self._alerts = self._feed("alerts", "", "no alerts")

    def _feed(self, name: str, buttons: str, nothing: str) -> ui.table:
        columns = [{"name": "target", "label": "", "field": "target", "align": "left"}]
        table = ui.table(rows=[], columns=columns, row_key="id", pagination=8)
        table.classes(f"feed {name}").props("flat dense hide-header rows-per-page-label=rows")
        table.add_slot("no-data", f'<div class="nothing">{nothing}</div>')
        table.add_slot("body", _ENTRY.replace("BUTTONS", buttons if self._acting.allowed else ""))
        return table

    async def _undo(self, event: "GenericEventArguments") -> None:
        await self._acting.instruct("unblock", str(event.args["id"]))

    async def _allow(self, event: "GenericEventArguments") -> None:
        await self._acting.instruct("allow", str(event.args["address"]))

    async def _false_alarm(self, event: "GenericEventArguments") -> None:
        await self._acting.instruct("false_alarm", str(event.args["id"]))

    def refresh(self) -> None:
        """Send what has changed since the last time."""
        board, now = self._board, time.time()
        line: float | None = None
        points: Any = None
        rows: dict[str, list[dict[str, Any]]] = {}
        with board.lock:
            if self._new("scores", "health"):
                points, line = score_points(board.scores.bins), board.line()
            if time.monotonic() - self._listed >= _LISTS_SECONDS:
                self._listed = time.monotonic()
                rows = self._rows()
            figures = self._figures(now)
            model = board.model()
        told = "\n".join(model_lines(model)) if model is not None else ""
        if self._model.text != told:
            self._model.set_text(told)
        if points is not None:
            self._draw(points, line)
        tables = {"incidents": self._incidents, "decisions": self._decisions, "alerts": self._alerts}
        for name, table in tables.items():
            if name in rows:
                table.rows = rows[name]
        for name, text in figures.items():
            if self._numbers[name].text != text:
                self._numbers[name].set_text(text)

    def _draw(self, points: tuple[list[list[float]], list[list[float]]], line: float | None) -> None:
        highest, mean = self._chart.options["series"]
        highest["data"], mean["data"] = points
        highest["markLine"] = threshold(line)
        self._chart.options["yAxis"]["max"] = top((score for _, score in points[0]), line)
        self._chart.update()

    def _rows(self) -> dict[str, list[dict[str, Any]]]:
        board = self._board
        rows = {}
        if self._new("incidents"):
            newest = sorted(board.incidents.values(), key=lambda one: -one.begun)[:_SHOWN]
            rows["incidents"] = [incident_row(each) for each in newest]
        if self._new("decisions"):
            rows["decisions"] = self._decision_rows()
        if self._new("alerts"):
            first = board.counts["alerts"]
            last = list(board.alerts)[: -_SHOWN - 1 : -1]
            rows["alerts"] = [alert_row(each, first - place) for place, each in enumerate(last)]
        return rows

    def _decision_rows(self) -> list[dict[str, Any]]:
        answers: dict[str, dict[str, str]] = {}
        for name, text in self._board.answers.items():
            decision, switch = name.split(" ", 1)
            answers.setdefault(decision, {})[switch] = text
        return [decision_row(each, answers.get(each.id, {})) for each in self._board.standing()[:_SHOWN]]

    def _figures(self, now: float) -> dict[str, str]:
        board = self._board
        here = board.present()
        active = sum("active" in app["states"] for app in here)
        connected = sum(bool(value.get("connected")) for value in board.switches.values())
        over = sum(each.over for each in board.scores.bins)
        return {
            "packets scored/s": number(board.scores.rate(now)),
            "above the threshold": number(over),
            "open incidents": number(board.open_incidents()),
            "alerts": number(board.counts["alerts"]),
            "blocks and guards": number(sum(not each.dry_run for each in board.standing())),
            "apps active": f"{active} of {len(here)}" if here else "-",
            "switches": f"{connected} of {len(board.switches)}" if board.switches else "-",
        }

    def _new(self, *topics: str) -> bool:
        now = {topic: self._board.versions[topic] for topic in topics}
        changed = any(self._seen.get(topic) != version for topic, version in now.items())
        self._seen |= now
        return changed
