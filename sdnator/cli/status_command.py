"""`sdnator status` and `down`: show and stop the running pipeline."""

import json
import os
import signal
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from sdnator.cli.plain_table import plain_table
from sdnator.errors import PipelineError
from sdnator.model_words import model_lines, model_of
from sdnator.northbound import without_user
from sdnator.plurals import counted
from sdnator.redaction import redacted
from sdnator.up import running
from sdnator.up.running import shown

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def status(*, as_json: Json = False) -> None:
    """Show what runs: parts, addresses, app states.

    Exit codes: 0 all parts run, 1 nothing runs or a part is missing.

    Example: sdnator status --json
    """
    found = running.find()
    if found is None:
        holder = running.holder(running.state_folder())
        if as_json:
            print(json.dumps({"running": False, "pid": holder}))
        elif holder is None:
            print("no pipeline is running: start one with `sdnator up`")
        else:
            print(f"a pipeline is starting or stopping (process {holder})")
        raise typer.Exit(1)
    parts = {
        name: {"pid": pid, "alive": _alive(pid), **found.health.get(name, {})}
        for name, pid in found.parts.items()
    }
    apps = _states(found.coordinator)
    health = _health(found.coordinator) if apps is not None else None
    processes = _processes(found.coordinator) if apps is not None else {}
    control = controlled(health) if health is not None else None
    incidents = open_incidents(health) if health is not None else None
    model = model_of(health) if health is not None else None
    damaged = damaged_by_app(health or {})
    away = [name for name, one in found.health.items() if one["state"] != "running"]
    well = all(part["alive"] for part in parts.values()) and apps is not None and not away
    if as_json:
        print(
            json.dumps(
                {
                    "running": True,
                    "well": well,
                    **shown(found),
                    "parts": parts,
                    "apps": apps,
                    "control": control,
                    "incidents_open": incidents,
                    "training": model,
                    "damaged": damaged,
                }
            )
        )
    else:
        _show_status(found, parts, apps)
        wired = {str(one["name"]) for one in found.switches if one.get("forward")}
        for line in (*control_lines(control, wired, processes), *damage_lines(damaged)):
            print(line)
        for number, line in enumerate(model_lines(model) if model is not None else ()):
            print(line if number else f"model: {line}")
        if incidents is not None:
            more = "; see `sdnator incidents list --open`" if incidents else ""
            print(f"{counted(incidents, 'incident')} open{more}")
    raise typer.Exit(0 if well else 1)


def _show_status(
    found: running.Running, parts: Mapping[str, Mapping[str, Any]], apps: Mapping[str, str] | None
) -> None:
    print(f"running for {_age(found.started)} as process {found.pid}; logs in {found.logs}")
    where = {
        "updates": redacted(found.updates),
        "coordinator": without_user(found.coordinator),
        "dashboard": found.dashboard,
    }
    single = len(found.switches) == 1
    where |= {"switch" if single else f"switch-{one['name']}": one["address"] for one in found.switches}
    where |= {name: f"metrics at {at}" for name, at in found.metrics.items() if not where.get(name)}
    rows = []
    for name, part in parts.items():
        rows.append((name, str(part["pid"]), _state(name, part, apps or {}), where.get(name, "")))
    print(plain_table(("part", "process", "state", "where"), rows))
    for line in trouble_lines(found.health):
        print(line)
    print(f"logs take {sum(one['log_bytes'] for one in found.health.values()) / 1e6:.1f} MB")
    if found.dashboard:
        print(f"sign in to the dashboard: `sdnator user link`, or the token in {found.token_file}")
    if apps is None:
        print(f"the Coordinator at {without_user(found.coordinator)} does not answer")


def _state(name: str, part: Mapping[str, Any], apps: Mapping[str, str]) -> str:
    supervised = part.get("state", "running")
    if supervised != "running":
        return str(supervised).upper()
    return apps.get(name, "runs") if part["alive"] else "DEAD"


def trouble_lines(health: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Text: a line for each part that was restarted, or whose log lines were suppressed."""
    for name, one in health.items():
        if one["restarts"]:
            times = "once" if one["restarts"] == 1 else f"{one['restarts']} times"
            cause = f"; the last death: {redacted(one['cause'])}" if one["cause"] else ""
            yield f"{name} was restarted {times}{cause}"
        if one["suppressed_lines"]:
            yield f"{name} logged too much: {one['suppressed_lines']:,} lines were suppressed"
        if one.get("out_of_range"):
            times = counted(one["out_of_range"], "time")
            yield f"the program of {name} reached beyond the end of an array {times}: it is damaged, or not the product's own"


def _age(started: int) -> str:
    seconds = max(0, (time.time_ns() - started) // 10**9)
    minutes, hours = seconds // 60, seconds // 3_600
    return f"{hours} h {minutes % 60} min" if hours else f"{minutes} min {seconds % 60} s"


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return True


def _states(coordinator: str) -> dict[str, str] | None:
    """By app: the states of its instances; None where the Coordinator does not answer."""
    from sdnator.northbound import ask

    try:
        return {app["app_id"]: ", ".join(app["states"]) for app in ask(coordinator, "/apps")}
    except PipelineError:
        return None


def _processes(coordinator: str) -> dict[str, str]:
    """By instance: its process in words; empty where the Coordinator does not answer."""
    from sdnator.northbound import ask

    try:
        found = ask(coordinator, "/instances")
    except PipelineError:
        return {}
    return {one["instance_id"]: f"process {one['pid']} on {one['host']}" for one in found}


def _health(coordinator: str) -> Mapping[str, Any] | None:
    """What the Coordinator says of all apps; None if it does not answer."""
    from sdnator.northbound import ask

    try:
        found: Mapping[str, Any] = ask(coordinator, "/health")
    except PipelineError:
        return None
    return found


def open_incidents(health: Mapping[str, Any]) -> int | None:
    """From the Coordinator's /health: how many incidents are open; None if no firewall says."""
    told = health.get("apps", {}).get("firewall", {}).get("health", {}).get("app", {})
    count = told.get("incidents_open")
    return count if isinstance(count, int) else None


def damaged_by_app(health: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """From the Coordinator's /health: damaged rows that an app met in the archive, and its damaged spools."""
    found = {}
    for app, told in health.get("apps", {}).items():
        engine = told.get("health", {}).get("engine", {})
        counts = {
            "rows": int(engine.get("damaged_rows", 0)),
            "spools": int(engine.get("archive", {}).get("damaged_spools", 0)),
        }
        if any(counts.values()):
            found[app] = counts
    return found


def damage_lines(damaged: Mapping[str, Mapping[str, int]]) -> Iterator[str]:
    """Text: a line for each app with damage."""
    for app, counts in damaged.items():
        if counts["rows"]:
            yield f"{app} left {counted(counts['rows'], 'damaged row')} of the archive out of its answers"
        if counts["spools"]:
            yield f"{app} set {counted(counts['spools'], 'damaged piece')} of its spool aside"


def controlled(health: Mapping[str, Any]) -> dict[str, Any] | None:
    """From the Coordinator's /health: whether the watchdog runs, and each switch's state and failure mode."""
    told = health.get("apps", {}).get("p4runtime_ctrl", {}).get("health", {}).get("app", {})
    if "switches" not in told:
        return None
    names = ("connected", "primary", "owner", "fail", "learnt")
    switches = {one["switch"]: {name: one[name] for name in names if name in one} for one in told["switches"]}
    return {"watchdog": bool(told.get("watchdog")), "switches": switches}


def control_lines(
    control: Mapping[str, Any] | None, wired: Collection[str], processes: Mapping[str, str] | None = None
) -> Iterator[str]:
    """Text: a line for each switch; the watchdog covers those that are `wired`, and `processes` are instances in words."""
    for name, one in (control or {"switches": {}})["switches"].items():
        # of several controllers that divide the switches any one may have told
        owner = one.get("owner", "")
        has = one.get("connected") and (one.get("primary") or owner)
        by = f" of {_named(owner, processes or {})}" if owner else ""
        state = f"under control{by}" if has else "NOT under control"
        if one.get("fail") == "closed":
            watch = "a watchdog runs" if control and control["watchdog"] else "but NO watchdog runs"
            fails = f"fails closed, {watch if name in wired else 'and has no port forwarding'}"
        else:
            fails = "fails open: port forwarding stays without a controller"
        learnt = f"; {counted(one['learnt'], 'MAC address')} learnt" if "learnt" in one else ""
        yield f"switch {name} is {state}; it {fails}{learnt}"


def _named(instance: str, processes: Mapping[str, str]) -> str:
    """An instance in words."""
    return "another instance" if instance == "another" else processes.get(instance, f"instance {instance}")


def down(
    *,
    timeout: Annotated[float, typer.Option(help="Seconds to wait until it has ended.", min=0)] = 30.0,
    as_json: Json = False,
) -> None:
    """Stop the pipeline of `sdnator up` and wait until it has ended.  No error if none is running.

    Exit codes: 0 nothing runs any more, 1 it did not end in time.

    Example: sdnator down
    """
    pid = running.holder(running.state_folder())
    if pid is not None:
        _end(pid, timeout)
    if as_json:
        print(json.dumps({"stopped": pid}))
    else:
        print(f"stopped (process {pid})" if pid is not None else "no pipeline was running")


def _end(pid: int, timeout: float) -> None:
    try:
        os.kill(pid, signal.SIGTERM)
    except ProcessLookupError:
        return
    except PermissionError:
        raise PipelineError(f"process {pid} is another user's: stop it as that user") from None
    deadline = time.monotonic() + timeout
    while running.holder(running.state_folder()) == pid:
        if time.monotonic() > deadline:
            raise PipelineError(
                f"process {pid} has not ended within {timeout:g} s: see {running.state_folder() / 'logs'}, "
                f"or kill -9 {pid}"
            )
        time.sleep(0.05)
