"""Overview: one sentence of health, incidents, scores, what is blocked and why, traffic, what is asked of switches."""

import asyncio
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from nicegui import ui

from sdnator.dashboard.charts import Point, score_chart, score_points, threshold, top
from sdnator.dashboard.overview import asked_rows, health, port_rows, talker_rows, timeline
from sdnator.dashboard.switch_reading import read_traffic
from sdnator.dashboard.texts import alert_row, decision_row, incident_row, number
from sdnator.model_words import headline, model_lines

if TYPE_CHECKING:
    from nicegui.events import GenericEventArguments

    from sdnator.dashboard.operator_actions import OperatorActions
    from sdnator.dashboard.page_backend import PageBackend

_SHOWN = 50
_PAGE = 8
"""Rows of a list that are on show at once."""
_LONG = 4
"""The same for alerts, each of which is a paragraph."""
_LISTS_SECONDS = 1.0
"""Lists change no more often: people read them, and press buttons in them."""
_ENTRY = """
<q-tr :props="props"><q-td colspan="100%"><div class="entry">
  <div :class="'mark ' + (props.row.action || 'alert')"></div>
  <div class="text">
    <div><b>{{ props.row.target }}</b> <span class="quiet">{{ props.row.word ?? props.row.action }}</span></div>
    <div class="second">{{ props.row.where }}</div>
    <div class="second">{{ props.row.reason }}</div>
    <div class="second" v-if="props.row.said">{{ props.row.said }}</div>
    <details class="second" v-if="props.row.timeline && props.row.timeline.length"><summary>Timeline</summary>
      <div v-for="one in props.row.timeline">{{ one }}</div></details>
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


@contextmanager
def _panel(title: str, *, wide: bool = False) -> Iterator[None]:
    with ui.element("section").classes("panel wide" if wide else "panel").props(f'aria-label="{title}"'):
        ui.label(title).classes("panel-title").props('role="heading" aria-level="2"')
        yield


def _table(name: str, *labels: str) -> ui.table:
    """A table whose columns are found in rows by the labels' first words."""
    fields = {
        "forwarded/s": "forwarded",
        "bits/s": "bits",
        "dropped/s": "dropped",
        "dropped in all": "total",
        "packets/s": "packets",
        "share": "share",
    }
    columns = [
        {
            "name": label,
            "label": label,
            "field": fields.get(label, label),
            "align": "right" if label in fields else "left",
        }
        for label in labels
    ]
    table = ui.table(rows=[], columns=columns, row_key="id", pagination=_PAGE)
    table.classes(f"plain {name}").props("flat dense hide-pagination rows-per-page-label=rows")
    return table


def _fill(table: ui.table, rows: list[dict[str, Any]], page: int = _PAGE) -> None:
    """Show these rows, and a way to turn pages only where there are some."""
    if table.rows == rows:
        return
    table.rows = rows
    if len(rows) > page:
        table.props(remove="hide-pagination")
    else:
        table.props("hide-pagination")


class OverviewPanel:
    """One browser's view of what happens now."""

    def __init__(self, service: "PageBackend", acting: "OperatorActions") -> None:
        self._board = service.board
        self._acting = acting
        self._history_s = service.settings.history_s
        self._places = service.settings.switches
        self._readings: dict[str, tuple[float, Mapping[str, Any]]] = {}
        """When each switch was read last, and its counters."""
        self._seen: dict[str, dict[str, int]] = {}
        self._listed = float("-inf")
        self._numbers: dict[str, ui.label] = {}
        self._health = ui.label("").classes("health q-mb-sm").props('role="status" aria-live="polite"')
        with ui.element("div").classes("figures q-mb-sm"):
            for name in (
                "packets scored/s",
                "at or above the threshold",
                "open incidents",
                "alerts",
                "blocks and guards",
            ):
                with ui.element("div").classes("figure"):
                    self._numbers[name] = ui.label("-").classes("number")
                    ui.label(self._spoken(name)).classes("name")
        with ui.element("div").classes("board"):
            with _panel("Incidents", wide=True):
                self._incidents = self._feed("incidents", "", "no incidents")
            with _panel("Anomaly scores; a gap is silence", wide=True):
                chart = ui.echart(score_chart(), renderer="svg").style("height: 260px; width: 100%")
                self._chart = chart.classes("scores")
            with ui.element("div").classes("stack"):
                self._decisions = self._list_of_decisions()
                with _panel("Traffic by port"):
                    names = ("port", "forwarded/s", "bits/s", "dropped/s", "dropped in all")
                    self._ports = _table("ports", *names)
                    self._ports.add_slot(
                        "no-data", '<div class="nothing">no switch forwards or drops by an entry yet</div>'
                    )
                with _panel("Requests to the switches"):
                    self._asked = self._feed("asked", "", "no switch has reported yet")
                with _panel("Training"):
                    self._progress = ui.linear_progress(0.0, show_value=False)
                    self._progress.props('aria-label="training"')
                    self._model = ui.label("").classes("quiet model").style("white-space: pre-line")
            with ui.element("div").classes("stack"):
                with _panel("Alerts"):
                    self._alerts = self._feed("alerts", "", "no alerts", _LONG)
                with _panel("Top talkers"):
                    self._talkers = _table("talkers", "sender", "from", "bits/s", "packets/s", "share")
                    self._talkers.add_slot(
                        "no-data", '<div class="nothing">no packet has been counted for ten seconds</div>'
                    )

    def _list_of_decisions(self) -> ui.table:
        with _panel("Blocks and guards"):
            undo = _button("undo", ':label="props.row.undo"', "undo", 'v-if="props.row.undo"')
            buttons = undo + _button("allow", 'label="Allow"', "verified_user", 'v-if="props.row.allow"')
            wrong = 'v-if="props.row.false_alarm"'
            buttons += _button("false_alarm", 'label="False alarm"', "school", wrong)
            decisions = self._feed("decisions", buttons, "nothing is blocked, guarded or limited")
            decisions.on("undo", self._undo)
            decisions.on("allow", self._allow)
            decisions.on("false_alarm", self._false_alarm)
        return decisions

    def _spoken(self, figure: str) -> str:
        """The name of a figure, with the time that it is about where it is no state of now."""
        return (
            f"{figure}, {self._history_s:.0f}\N{NO-BREAK SPACE}s"
            if figure == "at or above the threshold"
            else figure
        )

    def _feed(self, name: str, buttons: str, nothing: str, page: int = _PAGE) -> ui.table:
        columns = [{"name": "target", "label": "", "field": "target", "align": "left"}]
        table = ui.table(rows=[], columns=columns, row_key="id", pagination=page)
        table.classes(f"feed {name}").props("flat dense hide-header hide-pagination rows-per-page-label=rows")
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
        rows: dict[str, list[dict[str, Any]]] = {}
        points: Any = None
        with board.lock:
            if self._new("scores", "health") or now - self._drawn >= 1.0:
                points, limit = score_points(board.scores.bins, board.scores.width), board.threshold()
            if time.monotonic() - self._listed >= _LISTS_SECONDS:
                self._listed = time.monotonic()
                rows = self._rows()
                rows["talkers"] = talker_rows(board, time.monotonic())
            figures, told, model = self._figures(now), health(board), board.model()
        if self._health.text != told.text:
            self._health.set_text(told.text)
            self._health.classes(replace=f"health q-mb-sm {told.level}")
        self._show_model(model)
        if points is not None:
            self._drawn = now
            self._draw(points, limit, now)
        for name, found in rows.items():
            _fill(self._tables()[name], found, _LONG if name == "alerts" else _PAGE)
        for name, text in figures.items():
            if self._numbers[name].text != text:
                self._numbers[name].set_text(text)

    _drawn = 0.0

    def _tables(self) -> dict[str, ui.table]:
        return {
            "incidents": self._incidents,
            "decisions": self._decisions,
            "alerts": self._alerts,
            "asked": self._asked,
            "talkers": self._talkers,
        }

    def _show_model(self, model: Mapping[str, Any] | None) -> None:
        text = "\n".join(model_lines(model)) if model is not None else "no app has reported a model"
        if self._model.text == text:
            return
        self._model.set_text(text)
        done = model is not None and bool(model.get("done"))
        share = (
            int(model.get("packets", 0)) / max(1, int(model.get("wanted", 1))) if model is not None else 0.0
        )
        self._progress.set_value(1.0 if done else min(share, 0.99))
        self._progress.props(f'aria-valuetext="{headline(model) if model is not None else "unknown"}"')

    async def refresh_traffic(self) -> None:
        """Read the counters of the switches; rates are those since the last reading."""
        rows: list[dict[str, Any]] = []
        for place in self._places:
            then, before = self._readings.get(place.name, (0.0, None))
            try:
                now, found = time.monotonic(), await asyncio.to_thread(read_traffic, place)
            except OSError:  # the sentence of health says so
                self._readings.pop(place.name, None)
                continue
            self._readings[place.name] = now, found
            rows += port_rows(place.name, before, found, now - then)
        _fill(self._ports, rows)

    def _draw(self, points: tuple[list[Point], list[Point]], limit: float | None, now: float) -> None:
        highest, mean = self._chart.options["series"]
        highest["data"], mean["data"] = points
        highest["markLine"] = threshold(limit)
        self._chart.options["yAxis"]["max"] = top((each[1] or 0.0 for each in points[0]), limit)
        end = round(now * 1e3)
        self._chart.options["xAxis"] |= {"min": end - round(1e3 * self._history_s), "max": end}
        self._chart.update()

    def _rows(self) -> dict[str, list[dict[str, Any]]]:
        board = self._board
        rows = {}
        if self._new("incidents"):
            newest = sorted(board.incidents.values(), key=lambda one: -one.begun)[:_SHOWN]
            rows["incidents"] = [incident_row(each) | {"timeline": timeline(each)} for each in newest]
        if self._new("decisions"):
            rows["decisions"] = self._decision_rows()
        if self._new("alerts"):
            first = board.counts["alerts"]
            last = list(board.alerts)[: -_SHOWN - 1 : -1]
            rows["alerts"] = [alert_row(each, first - place) for place, each in enumerate(last)]
        if self._new("switches"):
            rows["asked"] = list(asked_rows(board))
        return rows

    def _decision_rows(self) -> list[dict[str, Any]]:
        answers: dict[str, dict[str, str]] = {}
        for name, text in self._board.answers.items():
            decision, switch = name.split(" ", 1)
            answers.setdefault(decision, {})[switch] = text
        return [decision_row(each, answers.get(each.id, {})) for each in self._board.standing()[:_SHOWN]]

    def _figures(self, now: float) -> dict[str, str]:
        board = self._board
        over = sum(each.over for each in board.scores.bins)
        return {
            "packets scored/s": number(board.scores.rate(now)),
            "at or above the threshold": number(over),
            "open incidents": number(board.open_incidents()),
            "alerts": number(board.counts["alerts"]),
            "blocks and guards": number(sum(not each.dry_run for each in board.standing())),
        }

    def _new(self, *topics: str) -> bool:
        now = {topic: self._board.versions[topic] for topic in topics}
        name = " ".join(topics)
        changed = self._seen.get(name) != now
        self._seen[name] = now
        return changed
