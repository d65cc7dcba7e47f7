"""`sdnator status` and `down`: what runs, and its end."""

import json
import os
import signal
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from sdnator import running
from sdnator.errors import PipelineError
from sdnator.plain_table import plain_table
from sdnator.running import shown

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def status(*, as_json: Json = False) -> None:
    """What runs: parts, addresses, and what the Coordinator says of the apps.

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
    parts = {name: {"pid": pid, "alive": _alive(pid)} for name, pid in found.parts.items()}
    apps = _states(found.coordinator)
    control = _control(found.coordinator) if apps is not None else None
    well = all(part["alive"] for part in parts.values()) and apps is not None
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
                }
            )
        )
    else:
        _show_status(found, parts, apps)
        wired = {str(one["name"]) for one in found.switches if one.get("forward")}
        for line in control_lines(control, wired):
            print(line)
    raise typer.Exit(0 if well else 1)


def _show_status(
    found: running.Running, parts: Mapping[str, Mapping[str, Any]], apps: Mapping[str, str] | None
) -> None:
    print(f"runs for {_age(found.started)} as process {found.pid}; logs in {found.logs}")
    where = {"updates": found.updates, "coordinator": found.coordinator, "dashboard": found.dashboard}
    single = len(found.switches) == 1
    where |= {"switch" if single else f"switch-{one['name']}": one["address"] for one in found.switches}
    where |= {name: f"metrics at {at}" for name, at in found.metrics.items() if not where.get(name)}
    rows = []
    for name, part in parts.items():
        state = (apps or {}).get(name, "runs") if part["alive"] else "DEAD"
        rows.append((name, str(part["pid"]), state, where.get(name, "")))
    print(plain_table(("part", "process", "state", "where"), rows))
    if found.dashboard:
        print(f"sign in to the dashboard with the token in {found.token_file}")
    if apps is None:
        print(f"the Coordinator at {found.coordinator} does not answer")


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
    from sdnator.coordinator_commands import ask

    try:
        return {app["app_id"]: ", ".join(app["states"]) for app in ask(coordinator, "/apps")}
    except PipelineError:
        return None


def _control(coordinator: str) -> dict[str, Any] | None:
    """What the controller says of its switches; None where it says nothing."""
    from sdnator.coordinator_commands import ask

    try:
        return controlled(ask(coordinator, "/health"))
    except PipelineError:
        return None


def controlled(health: Mapping[str, Any]) -> dict[str, Any] | None:
    """Of the Coordinator's /health: whether the sentinel is there, and how each switch is and fails."""
    told = health.get("apps", {}).get("p4runtime_ctrl", {}).get("health", {}).get("app", {})
    if "switches" not in told:
        return None
    names = ("connected", "primary", "fail", "stations")
    switches = {one["switch"]: {name: one[name] for name in names if name in one} for one in told["switches"]}
    return {"sentinel": bool(told.get("sentinel")), "switches": switches}


def control_lines(control: Mapping[str, Any] | None, wired: Collection[str]) -> Iterator[str]:
    """For people: a line for each switch; a sentinel is there for those that are `wired`."""
    for name, one in (control or {"switches": {}})["switches"].items():
        state = "under control" if one.get("connected") and one.get("primary") else "NOT under control"
        if one.get("fail") == "closed":
            watch = "a sentinel watches" if control and control["sentinel"] else "but NO sentinel watches"
            fails = f"fails closed, {watch if name in wired else 'and has no wires'}"
        else:
            fails = "fails open: its wires stay while nobody controls it"
        learnt = f"; {one['stations']} stations learnt" if "stations" in one else ""
        yield f"switch {name} is {state}; it {fails}{learnt}"


def down(
    *,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for the orderly end.", min=0)] = 30.0,
    as_json: Json = False,
) -> None:
    """Stop the pipeline of `sdnator up` and wait until it has ended.  Fine where none runs.

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
