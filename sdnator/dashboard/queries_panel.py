"""Queries: what the Sonata adapter runs, and for one key where each operator is, why, and what it costs."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from nicegui import ui

from due.errors import DueError
from sdnator.dashboard.texts import clock, number
from sdnator.errors import BadInput
from sdnator.notation import brief, typed_key

if TYPE_CHECKING:
    from nicegui.events import GenericEventArguments

    from sdnator.dashboard.page_backend import PageBackend


def _columns(*names: str) -> list[dict[str, Any]]:
    return [{"name": name, "label": name, "field": name, "align": "left"} for name in names]


class QueriesPanel:
    """One browser's view of queries."""

    def __init__(self, service: "PageBackend") -> None:
        self._service = service
        self._seen = -1
        self._told: list[Mapping[str, Any]] = []
        """The last two answers about the chosen key; the engine's thread adds them."""
        self._shown: Mapping[str, Any] | None = None
        self._end: Callable[[], None] = lambda: None
        with ui.element("div").classes("board"):
            with ui.element("div").classes("panel wide"):
                ui.label("Queries that somebody wants").classes("panel-title")
                self._queries = ui.table(
                    rows=[], columns=_columns("query", "runs", "tuples"), row_key="query"
                )
                self._queries.props("flat dense").classes("plain queries")
                self._queries.add_slot("no-data", '<div class="nothing">nobody wants a query</div>')
                self._queries.on("rowClick", self._on_row)
            with ui.element("div").classes("panel wide"):
                with ui.element("div").classes("form"):
                    self._key = ui.input("Key of a query", value="network.traffic_query.sonata.new_tcp")
                    self._key.props("outlined dense").style("flex: 1 1 280px").classes("query-key")
                    button = ui.button("Explain", icon="help_outline", on_click=self._explain)
                    button.props("unelevated no-caps").classes("explain-now")
                    self._key.on("keydown.enter", self._explain)
                self._said = ui.label("").classes("quiet plan-said")
                self._operators = ui.table(
                    rows=[], columns=_columns("operator", "runs", "why"), row_key="id"
                ).props("flat dense hide-pagination :rows-per-page-options=[0]")
                self._operators.classes("plain operators")
                self._operators.add_slot("no-data", '<div class="nothing">no plan has been asked for</div>')
        ui.context.client.on_disconnect(self._stop)

    def refresh(self) -> None:
        """Send what has changed since the last time."""
        board = self._service.board
        with board.lock:
            version = board.versions["health"]
            health = board.health.get("sonata_adapter", {}).get("app", {}) if version != self._seen else None
        if health is not None:
            self._seen = version
            rows = query_rows(health)
            if rows != self._queries.rows:
                self._queries.rows = rows
        told = self._told
        if told and told[-1] is not self._shown:
            self._shown = told[-1]
            self._said.set_text(plan_text(told))
            rows = operator_rows(told[-1])
            if rows != self._operators.rows:
                self._operators.rows = rows

    def _on_row(self, event: "GenericEventArguments") -> None:
        self._key.set_value(event.args[1]["query"])
        self._explain()

    def _explain(self) -> None:
        self._stop()
        self._told, self._shown, self._operators.rows = [], None, []
        told = self._told

        def hear(answer: Mapping[str, Any]) -> None:
            told.append(answer)
            del told[:-2]

        try:
            self._end = self._service.explain(typed_key(str(self._key.value or "").strip()), hear)
        except (BadInput, DueError) as error:
            self._said.set_text(str(error))
            return
        self._said.set_text("asking the adapter …")

    def _stop(self) -> None:
        self._end()
        self._end = lambda: None


def query_rows(health: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The queries that run, from the adapter's health."""
    tuples = health.get("tuples", {})
    return [
        {"query": name, "runs": place, "tuples": number(int(tuples.get(name, 0)))}
        for name, place in sorted(health.get("queries", {}).items())
    ]


def operator_rows(plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Where each operator of a plan runs."""
    return [
        {"id": place, "operator": one["text"].removeprefix("    "), "runs": one["place"], "why": one["why"]}
        for place, one in enumerate(plan.get("operators", ()))
    ]


def plan_text(told: list[Mapping[str, Any]]) -> str:
    """What an answer tells besides its operators; with two, what comes a second."""
    first, last = told[0], told[-1]
    if last["state"] in ("refused", "follows"):
        return f"{last['state']}: {last['reason']}"
    if last["state"] != "running":
        return f"Nobody wants it; this is where it would run, beside {last['others']} other queries."
    seconds = last["monotonic_s"] - first["monotonic_s"]
    came, before = last["came"], first.get("came", last["came"])
    rate = (came["tuples"] - before["tuples"]) / seconds if seconds > 0 else 0.0
    parts = [
        "In force",
        f"{number(came['reports'])} reports and {number(came['copies'])} copies, {number(rate)} a second",
        f"{number(last['results'])} results"
        + (f", the last at {clock(last['last_result'])}" if last["results"] else ""),
    ]
    if last["reason"]:
        parts.append(f"on the host, because {brief(last['reason'])}")
    return " · ".join(parts)
