"""What `sdnator up` is to keep running, and what of a changed plan can be taken up while it runs.  Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from sdnator.planned_switches import PlannedSwitch

APPS = ("p4runtime_ctrl", "kitsune", "sonata_adapter", "firewall")
_MODEL_FILES = ("load_model", "save_model")


@dataclass(frozen=True, kw_only=True)
class StandingPlan:
    """What to keep running."""

    state: Path
    """Folder for logs, settings, spools and the embedded Data Updates server."""
    updates: str = ""
    """Data Updates URL; empty: an embedded server."""
    archive: str
    """Data Archives URL."""
    switches: tuple[PlannedSwitch, ...] = (PlannedSwitch(),)
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of the coordinator and the apps, by name."""
    engine: Mapping[str, Any] = field(default_factory=dict)
    """Options of the DUE engine, for all."""
    log_level: str = "info"
    log_format: str = "console"
    metrics_host: str = ""
    """Address on which each app serves Prometheus metrics; empty: none does."""
    metrics_targets: str = ""
    """File for Prometheus' target list; empty: none."""
    dashboard: Mapping[str, Any] | None = None
    """Options of the dashboard; None: there is none."""

    def settings_of(self, name: str) -> Mapping[str, Any]:
        """As they stand in the plan; empty where it has none."""
        return self.settings.get(name, {})

    def parts(self) -> tuple[str, ...]:
        """Parts that are apps of DUE."""
        return ("coordinator", *APPS, *(("dashboard",) if self.dashboard is not None else ()))


@dataclass(frozen=True)
class Changes:
    """What follows from another plan: parts to start again, and what must wait for the next start."""

    again: tuple[str, ...] = ()
    waits: tuple[str, ...] = ()
    """Texts for people."""


def changes(old: StandingPlan, new: StandingPlan) -> Changes:
    """Settings of a part mean its restart; addresses, switches and training are for the next start."""
    waits = [
        f"{one.name}: takes effect when the pipeline is started again"
        for one in fields(StandingPlan)
        if one.name in _FOR_NEXT_START and getattr(old, one.name) != getattr(new, one.name)
    ]
    if (old.dashboard is None) != (new.dashboard is None):
        waits.append("dashboard.enabled: takes effect when the pipeline is started again")
    again = [part for part in old.parts() if part in new.parts() and _differs(part, old, new)]
    if "kitsune" in again and not new.settings_of("kitsune").get("load_model"):
        again.remove("kitsune")
        waits.append("kitsune: it would train anew; name a kitsune.load_model, or start the pipeline again")
    return Changes(tuple(again), tuple(waits))


_FOR_NEXT_START = ("updates", "archive", "switches", "metrics_host")


def _differs(part: str, old: StandingPlan, new: StandingPlan) -> bool:
    for_all = ("engine", "log_level", "log_format")
    if any(getattr(old, name) != getattr(new, name) for name in for_all):
        return True
    if part == "dashboard":
        return old.dashboard != new.dashboard
    return _without_models(old.settings_of(part)) != _without_models(new.settings_of(part))


def _without_models(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Which of the two is used follows from whether the file is there by now."""
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
