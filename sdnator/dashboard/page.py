"""The page: header, tabs, and the clock that brings them up to date."""

from typing import TYPE_CHECKING

from nicegui import app, ui

from sdnator.dashboard.access_control import KEY, SIGN_IN
from sdnator.dashboard.apps_panel import AppsPanel
from sdnator.dashboard.archive_panel import ArchivePanel
from sdnator.dashboard.operator_actions import OperatorActions
from sdnator.dashboard.overview_panel import OverviewPanel
from sdnator.dashboard.queries_panel import QueriesPanel
from sdnator.dashboard.style import STYLE
from sdnator.dashboard.switches_panel import SwitchesPanel

if TYPE_CHECKING:
    from sdnator.dashboard.page_backend import PageBackend


def build(service: "PageBackend") -> None:
    """One browser's page."""
    ui.add_css(STYLE)
    ui.colors(primary="#2f6fb3")
    session = str(app.storage.browser.get(KEY, ""))
    acting = OperatorActions(service, session)
    degraded = _header(acting)
    tabs, places = _tabs()
    with ui.tab_panels(tabs, value="Overview", animated=False).classes("w-full").props("keep-alive"):
        with ui.tab_panel(places["Overview"]).classes("q-pa-none"):
            overview = OverviewPanel(service, acting)
        with ui.tab_panel(places["Machinery"]).classes("q-pa-none"):
            apps = AppsPanel(service.board)
        with ui.tab_panel(places["Queries"]).classes("q-pa-none"):
            queries = QueriesPanel(service)
        with ui.tab_panel(places["Switches"]).classes("q-pa-none"):
            switches = SwitchesPanel(service)
        with ui.tab_panel(places["Archive"]).classes("q-pa-none"):
            archive = ArchivePanel(service, acting)

    quick = {"Overview": overview.refresh, "Machinery": apps.refresh, "Queries": queries.refresh}

    def refresh() -> None:
        """Only what is on show costs anything, and only who may still look is shown it."""
        if not acting.may_look:
            ui.navigate.to(SIGN_IN)
            return
        if degraded.text != service.board.degraded:
            degraded.set_text(service.board.degraded)
        if tabs.value in quick:
            quick[tabs.value]()

    async def refresh_slowly() -> None:
        """What has to be asked for."""
        if not acting.may_look:
            return
        if tabs.value == "Switches":
            await switches.refresh()
        elif tabs.value == "Overview":
            await overview.refresh_traffic()
        elif tabs.value == "Archive":
            await archive.open()

    overview.refresh()  # who opens the page is not told for a moment that nothing is blocked
    ui.timer(1 / service.settings.frames, refresh)
    ui.timer(3.0, refresh_slowly)
    tabs.on_value_change(refresh_slowly)


def _header(acting: OperatorActions) -> ui.label:
    """The header; returns its place for what is degraded."""
    with ui.header(elevated=False).classes("items-center bar"):
        ui.label("SDNator").classes("text-weight-medium text-subtitle1")
        degraded = ui.label("").classes("degraded")
        ui.space()
        _dark_button()
        acting.sign_out_button()
    return degraded


def _tabs() -> tuple[ui.tabs, dict[str, ui.tab]]:
    names = {
        "Overview": "monitor_heart",
        "Machinery": "hub",
        "Queries": "functions",
        "Switches": "lan",
        "Archive": "manage_search",
    }
    with ui.tabs().props("dense align=left no-caps inline-label").classes("w-full") as tabs:
        places = {name: ui.tab(name, icon=icon) for name, icon in names.items()}
    tabs.set_value("Overview")
    return tabs, places


def _dark_button() -> None:
    """Follows the browser until it is pressed."""
    dark = ui.dark_mode(None)

    async def turn() -> None:
        now = dark.value
        if now is None:
            now = await ui.run_javascript("matchMedia('(prefers-color-scheme: dark)').matches", timeout=5)
        dark.set_value(not now)

    button = ui.button(icon="contrast", on_click=turn).props("flat dense round color=white")
    button.props('aria-label="light or dark"')
