"""From command line and configuration to the plan of `sdnator up`; errors are reported before anything starts."""

import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from sdnator import app_catalogue, training
from sdnator.config import config_file
from sdnator.config.planned_switches import PlannedSwitch, planned, require_compiler
from sdnator.config.switch_security import check_security
from sdnator.errors import BadInput
from sdnator.up import running
from sdnator.up.plan import StandingPlan

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sdnator.config.config_file import Config
    from sdnator.config.up_settings import SwitchPlan, UpSettings

TOKEN = "SDNATOR_DASHBOARD_TOKEN"  # noqa: S105 - a variable's name
_GIB = 1 << 30


@dataclass(frozen=True, kw_only=True)
class Given:
    """Options of the command line; empty or None: not given."""

    config: Path | None = None
    ports: tuple[str, ...] = ()
    wires: tuple[str, ...] = ()
    switch: str = ""
    device_id: int | None = None
    listen: str = ""
    insecure: bool = False
    updates: str = ""
    archive: str = ""
    train: int | None = None
    model: Path | None = None
    mitigate: bool = True
    quota: float | None = None
    dashboard: bool = True
    engine: str = ""
    spark_master: str = ""

    def file(self) -> Path | None:
        """The configuration that holds."""
        return self.config.absolute() if self.config is not None else config_file.find()


def plan_for(given: Given, state: Path) -> StandingPlan:
    """The plan; raises BadInput naming what is wrong.  Makes the data folder and the dashboard's token."""
    config = config_file.load(given.file())
    own: UpSettings = config.struct("up")
    archive = given.archive or own.archive
    settings = {"p4runtime_ctrl": config.section("p4runtime_ctrl"), "sonata_adapter": _adapter(config, given)}
    settings["coordinator"] = _coordinator(config, given.quota or own.quota, embedded=not archive)
    switches = tuple(_planned(each, settings["p4runtime_ctrl"]) for each in _switches(config, given))
    settings["kitsune"] = (
        _kept(_kitsune(config, given), switches, state) if own.keep_model else _kitsune(config, given)
    )
    settings["firewall"] = _firewall(config, given)
    installed = app_catalogue.to_run(config.struct("firewall").enforcers)
    settings |= {name: config.section(name) for name in installed if name not in settings}
    log, metrics = config.struct("log"), config.struct("metrics")
    return StandingPlan(
        state=state,
        updates=given.updates or own.updates,
        archive=_checked_archive(archive) if archive else _own_archive(),
        grants=tuple(config.grants()),
        switches=switches,
        settings=settings,
        apps=installed,
        processes=_processes(own.processes, settings),
        engine=config.section("due"),
        log_level=log.level,
        log_format=log.format,
        metrics_host=metrics.host,
        metrics_token_file=_checked_token(metrics.token_file),
        metrics_targets=metrics.targets,
        dashboard=_dashboard(config, state) if given.dashboard else None,
        supervisor=config.struct("supervisor"),
    )


def _processes(
    wanted: "Mapping[str, int]", settings: "Mapping[str, Mapping[str, Any]]"
) -> "Mapping[str, int]":
    """Checked; raises BadInput for an app that does not run, or of which all processes but one would only wait."""
    for name, count in wanted.items():
        if name not in settings or name == "coordinator":
            raise BadInput(f"up.processes: the pipeline runs no app {name!r}")
        if count > 1 and settings[name].get("instances") != "sharded":
            raise BadInput(
                f"up.processes: {name} = {count}, but only instances that divide the switches all work: "
                f'set instances = "sharded" in [{name}], if it can do so'
            )
        for number in range(2, count + 1):
            if f"{name}-{number}" in settings:
                raise BadInput(
                    f"up.processes: {name} = {count}: there is an app {name}-{number} already; rename it"
                )
    return wanted


def _coordinator(config: "Config", quota: float, *, embedded: bool) -> dict[str, Any]:
    from sdnator.up.lasting_keys import LASTING_KEYS

    limit = {"retain_bytes": int(quota * _GIB)} if embedded else {}
    return {"lasting_keys": list(LASTING_KEYS)} | limit | config.section("coordinator")


def _adapter(config: "Config", given: Given) -> dict[str, Any]:
    """The adapter's settings; an engine that cannot run is reported now, not in its log."""
    said = {"engine": given.engine, "spark_master": given.spark_master}
    settings = config.section("sonata_adapter") | {name: value for name, value in said.items() if value}
    engine = settings.get("engine", "numpy")
    if engine not in ("numpy", "spark"):
        raise BadInput(f"--engine {engine}: give numpy or spark")
    if given.spark_master and engine != "spark":
        raise BadInput(f"--spark-master {given.spark_master}: only with --engine spark")
    if engine == "spark":
        from apps.sonata_adapter.host.spark import SparkMissing, require_spark

        try:
            require_spark()
        except SparkMissing as error:
            raise BadInput(str(error)) from None
    return settings


def _kitsune(config: "Config", given: Given) -> dict[str, Any]:
    settings = config.section("kitsune")
    if given.train is not None:
        fm_grace, ad_grace = training.split(given.train)
        settings |= {"fm_grace": fm_grace, "ad_grace": ad_grace}
    return settings | model_settings(given.model)


def _kept(settings: dict[str, Any], switches: tuple[PlannedSwitch, ...], state: Path) -> dict[str, Any]:
    """Kitsune's settings with the model of the state folder, unless they name one."""
    if any(settings.get(name) for name in ("load_model", "save_model", "keep_model")):
        return settings
    places = {
        one.name: [one.kind, *(f"{number}={kind}" for number, kind in sorted(one.ports.items()))]
        for one in switches
    }
    return {**settings, "keep_model": str(running.model_file(state)), "keep_for": places}


def model_settings(model: Path | None) -> dict[str, Any]:
    """Settings of Kitsune for a model file; raises BadInput for an impossible path."""
    if model is None:
        return {}
    path = model.absolute()
    if not path.parent.is_dir():
        raise BadInput(f"--model {model}: there is no folder {path.parent}")
    # only a missing model is written: a later run must not replace a trained model
    return {"load_model" if path.exists() else "save_model": str(path)}


def _firewall(config: "Config", given: Given) -> dict[str, Any]:
    settings = config.section("firewall")
    if not given.mitigate:
        settings["rules"] = {**settings.get("rules", {}), "dry_run": True}
    return settings


def _switches(config: "Config", given: Given) -> "list[SwitchPlan]":
    """Those of the configuration; options of the command line are about the only one."""
    switches: list[SwitchPlan] = config.switches()
    said: dict[str, Any] = {
        "kind": given.switch,
        "device_id": given.device_id,
        "ports": given.ports,
        "wires": given.wires,
        "listen": given.listen,
        "insecure": given.insecure,
    }
    changed = {name: value for name, value in said.items() if value}
    if changed and len(switches) > 1:
        option = {
            "kind": "switch",
            "ports": "port",
            "wires": "wire",
            "device_id": "device-id",
            "listen": "grpc",
            "insecure": "insecure",
        }
        raise BadInput(
            f"--{option[next(iter(changed))]}: {config.file} has {len(switches)} switches; set it there"
        )
    return [msgspec.structs.replace(switches[0], **changed)] if changed else switches


def _planned(plan: "SwitchPlan", controller: "Mapping[str, Any]") -> PlannedSwitch:
    try:
        made = planned(plan)
        if made.kind == "embedded":
            require_compiler()
        check_security(made, controller)
    except BadInput as error:
        raise BadInput(f"switch {plan.name}: {error}" if plan.name != "s1" else str(error)) from None
    return made


def _checked_token(file: str) -> str:
    """The same as an absolute path; raises BadInput for a file that cannot be a token's."""
    from due.errors import InvalidOption
    from due.status_server import metrics_token

    try:
        metrics_token(file)
    except InvalidOption as error:
        raise BadInput(f"metrics.token_file: {error}") from None
    return str(Path(file).absolute()) if file else ""


def _dashboard(config: "Config", state: Path) -> dict[str, Any] | None:
    options = config.struct("dashboard")
    if not options.enabled:
        return None
    settings = config.section("dashboard")
    named = Path(options.token_file).absolute() if options.token_file else state / "dashboard.token"
    if not options.token_file:
        _make_token(named)
    elif not named.is_file() and not os.environ.get(TOKEN):
        raise BadInput(
            f"dashboard.token_file {named}: there is no such file; write a long random text into it"
        )
    return {**settings, "token_file": str(named)}


def _make_token(path: Path) -> None:
    """Written once, so that a noted token stays valid."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return
    except OSError as error:
        raise BadInput(
            f"{path}: {error.strerror}; set XDG_STATE_HOME to a folder that you can write to"
        ) from None
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(secrets.token_urlsafe(24) + "\n")


def _checked_archive(url: str) -> str:
    from due.backends import open_archive
    from due.errors import InvalidOption

    try:
        open_archive(url).close()
    except InvalidOption as error:
        raise BadInput(f"--archive: {error}") from None
    return url


def _own_archive() -> str:
    folder = running.data_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(
            f"{folder}: {error.strerror}; set XDG_DATA_HOME to a folder that you can write to"
        ) from None
    return running.default_archive()
