"""The plan of `sdnator up`, and which changes of it can be applied while it runs."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from sdnator.app_catalogue import OURS
from sdnator.config.planned_switches import PlannedSwitch
from sdnator.config.up_settings import GrantPlan
from sdnator.supervisor.settings import SupervisorSettings

_MODEL_FILES = ("load_model", "save_model", "keep_model", "keep_for")


@dataclass(frozen=True, kw_only=True)
class StandingPlan:
    """A pipeline to keep running."""

    state: Path
    """Folder for logs, settings, spools and the embedded Data Updates server."""
    updates: str = ""
    """Data Updates URL; empty: an embedded server."""
    archive: str
    """Data Archives URL."""
    grants: tuple[GrantPlan, ...] = ()
    """Rights of apps that the configuration names."""
    switches: tuple[PlannedSwitch, ...] = (PlannedSwitch(),)
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of the coordinator and the apps, by name."""
    engine: Mapping[str, Any] = field(default_factory=dict)
    """Options of the DUE engine, for all."""
    log_level: str = "info"
    log_format: str = "console"
    metrics_host: str = ""
    """Address on which each app serves Prometheus metrics; empty: none does."""
    metrics_token_file: str = ""
    """File with what requests for metrics bring; empty: nothing."""
    metrics_targets: str = ""
    """File for Prometheus' target list; empty: none."""
    apps: tuple[str, ...] = OURS
    """Ids of the apps to run, in the order in which they are started."""
    processes: Mapping[str, int] = field(default_factory=dict)
    """How many processes run of an app; one of each that is not named."""
    dashboard: Mapping[str, Any] | None = None
    """Options of the dashboard; None: there is none."""
    supervisor: SupervisorSettings = field(default_factory=SupervisorSettings)

    def settings_of(self, name: str) -> Mapping[str, Any]:
        """As they stand in the plan; empty where it has none."""
        return self.settings.get(name, {})

    def ids(self) -> tuple[str, ...]:
        """Ids of all apps of DUE that run."""
        return ("coordinator", *self.apps, *(("dashboard",) if self.dashboard is not None else ()))

    def parts(self) -> tuple[str, ...]:
        """Parts that are apps of DUE; further processes of an app are ID-2, ID-3, …"""
        return tuple(self._apps())

    def app_of(self, part: str) -> str:
        """The app of which a part is a process.

        Args:
            part: one of `parts`.
        """
        return self._apps()[part]

    def _apps(self) -> dict[str, str]:
        counts = {name: self.processes.get(name, 1) for name in self.ids()}
        return {
            f"{name}-{number}" if number > 1 else name: name
            for name, count in counts.items()
            for number in range(1, count + 1)
        }


@dataclass(frozen=True)
class PlanChanges:
    """Effects of a changed plan: parts to restart, and changes that wait for the next start."""

    again: tuple[str, ...] = ()
    waits: tuple[str, ...] = ()
    """Messages about changes that wait."""


def changes(old: StandingPlan, new: StandingPlan) -> PlanChanges:
    """Settings of a part mean its restart; addresses, switches and training are for the next start."""
    waits = [
        f"{one.name}: takes effect when the pipeline is restarted"
        for one in fields(StandingPlan)
        if one.name in _FOR_NEXT_START and getattr(old, one.name) != getattr(new, one.name)
    ]
    if (old.dashboard is None) != (new.dashboard is None):
        waits.append("dashboard.enabled: takes effect when the pipeline is restarted")
    again = [part for part in old.parts() if part in new.parts() and _differs(part, old, new)]
    if "kitsune" in again and not _has_model(new.settings_of("kitsune")):
        again = [part for part in again if new.app_of(part) != "kitsune"]
        waits.append(
            "kitsune: a restart would train it again; set kitsune.load_model, or restart the pipeline"
        )
    return PlanChanges(tuple(again), tuple(waits))


def _has_model(settings: Mapping[str, Any]) -> bool:
    kept = settings.get("keep_model", "")
    return bool(settings.get("load_model")) or (bool(kept) and Path(kept).exists())


_FOR_NEXT_START = (
    "updates",
    "archive",
    "switches",
    "apps",
    "processes",
    "grants",
    "metrics_host",
    "metrics_token_file",
    "supervisor",
)


def _differs(part: str, old: StandingPlan, new: StandingPlan) -> bool:
    for_all = ("engine", "log_level", "log_format")
    if any(getattr(old, name) != getattr(new, name) for name in for_all):
        return True
    if part == "dashboard":
        return old.dashboard != new.dashboard
    app = old.app_of(part)
    return _without_models(old.settings_of(app)) != _without_models(new.settings_of(app))


def _without_models(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Whether the model is loaded or saved depends on whether the file exists now."""
    return {name: value for name, value in settings.items() if name not in _MODEL_FILES}


def taken_up(old: StandingPlan, new: StandingPlan, again: tuple[str, ...]) -> StandingPlan:
    """The plan that holds after the parts in `again` were started with the new one."""
    kept = {name: getattr(old, name) for name in _FOR_NEXT_START}
    settings = {
        name: new.settings_of(name) if name in again else old.settings_of(name)
        for name in old.settings.keys() | new.settings.keys()
    }
    return StandingPlan(
        state=old.state,
        **kept,
        settings=settings,
        engine=new.engine,
        log_level=new.log_level,
        log_format=new.log_format,
        metrics_targets=new.metrics_targets,
        dashboard=new.dashboard if "dashboard" in again else old.dashboard,
    )
