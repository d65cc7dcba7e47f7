"""`sdnator up`, `status` and `down`: a whole pipeline that runs until it is told to end."""

import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdnator import running
from sdnator.errors import BadInput, PipelineError
from sdnator.plain_table import plain_table

if TYPE_CHECKING:
    from sdnator.standing_pipeline import StandingPipeline, StandingPlan

TRAIN_SHARE = 11
"""`--train N` gives one packet in eleven to the feature map, as in `sdnator replay`."""
_LOOK_SECONDS = 0.25
_GIB = 1 << 30
_PORTS = range(511)

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


class _Stopped(BaseException):
    """SIGINT, SIGTERM or SIGHUP came."""


def up(
    *,
    port: Annotated[
        list[str] | None,
        typer.Option(help="Port of the switch: veth:INTERFACE or null.", metavar="N=veth:NAME"),
    ] = None,
    wire: Annotated[
        list[str] | None,
        typer.Option(
            help="Ports joined both ways; of exactly two ports by itself; `none`: only listen.", metavar="N-M"
        ),
    ] = None,
    switch: Annotated[
        str, typer.Option(help="embedded, bmv2, or HOST:PORT of a P4Runtime switch.")
    ] = "embedded",
    device_id: Annotated[int, typer.Option(help="P4Runtime device id of the switch.", min=1)] = 1,
    updates: Annotated[
        str,
        typer.Option(help="Data Updates, redis:// or unix://; default: an embedded server.", metavar="URL"),
    ] = "",
    archive: Annotated[
        str, typer.Option(help="Data Archives, mongodb:// or sqlite:///; default: a file.", metavar="URL")
    ] = "",
    train: Annotated[int, typer.Option(help="Packets that Kitsune trains on.", min=TRAIN_SHARE)] = 55_000,
    model: Annotated[
        Path | None, typer.Option(help="Trained model: used if it exists, written otherwise.", metavar="FILE")
    ] = None,
    no_mitigate: Annotated[bool, typer.Option("--no-mitigate", help="Decide, but block nothing.")] = False,
    quota: Annotated[
        float,
        typer.Option(help="GiB that the embedded archive may take; the oldest items go first.", min=0.01),
    ] = 10.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say where everything is as one JSON line.")
    ] = False,
) -> None:
    """Run the whole pipeline until Ctrl-C, SIGTERM or `sdnator down`.

    Without options everything is embedded. A part that dies is started again; the death of the switch,
    whose clock all timers follow, ends the pipeline. Only one runs per user.
    Exit codes: 0 stopped, 1 a part failed or one runs already, 2 misuse.

    Example: sdnator up --port 1=veth:eth1 --port 2=veth:eth2
    """
    ports = parse_ports(port or [], switch)
    settings = {
        "coordinator": {} if archive else {"retain_bytes": int(quota * _GIB)},
        "kitsune": kitsune_settings(train, model),
        "firewall": {"rules": {"dry_run": no_mitigate}},
    }
    state = running.state_folder()
    with _stop_signals(), running.claimed(state):
        from sdnator.standing_pipeline import StandingPlan

        plan = StandingPlan(
            state=state,
            updates=updates,
            archive=_checked_archive(archive) if archive else _own_archive(),
            switch=switch,
            device_id=device_id,
            ports=ports,
            forward=parse_wires(wire, ports, switch),
            settings=settings,
        )
        _keep_up(plan, as_json=as_json)


def _keep_up(plan: "StandingPlan", *, as_json: bool) -> None:
    from sdnator.p4_program import P4ProgramError
    from sdnator.standing_pipeline import StandingPipeline

    started = time.time_ns()
    try:
        with StandingPipeline(plan, _tell) as pipeline:
            found = _note(plan, pipeline, started)
            _announce(found, as_json=as_json)
            while True:
                time.sleep(_LOOK_SECONDS)
                if pipeline.watch():
                    _note(plan, pipeline, started)
    except P4ProgramError as error:
        raise PipelineError(str(error)) from None
    except _Stopped:
        _tell("stopped; nothing was left running")


def _note(plan: "StandingPlan", pipeline: "StandingPipeline", started: int) -> running.Running:
    from sdnator.standing_pipeline import SWITCH_NAME

    found = running.Running(
        pid=os.getpid(),
        started=started,
        updates=pipeline.updates,
        archive=plan.archive,
        coordinator=pipeline.coordinator,
        switch={
            "name": SWITCH_NAME,
            "address": pipeline.switch_address,
            "device_id": plan.device_id,
            "target": plan.switch,
            "ports": {str(number): kind for number, kind in plan.ports.items()},
            "forward": {str(number): egress for number, egress in plan.forward.items()},
        },
        parts=pipeline.pids(),
        logs=str(pipeline.logs),
    )
    running.write(plan.state, found)
    return found


def _announce(found: running.Running, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"ready": True, **shown(found)}), flush=True)
        return
    ports = ", ".join(f"{number}={kind}" for number, kind in found.switch["ports"].items()) or "no ports"
    lines = {
        "Data Updates": found.updates,
        "Data Archives": found.archive,
        "Coordinator": found.coordinator,
        "switch": f"{found.switch['name']} at {found.switch['address']} ({found.switch['target']}; {ports})",
        "logs": found.logs,
    }
    for name, where in lines.items():
        print(f"{name:<14}{where}")
    print(f"apps of yours export DUE_UPDATES={quote(found.updates)} DUE_ARCHIVE={quote(found.archive)}")
    print("The pipeline runs; Ctrl-C or `sdnator down` ends it.", flush=True)


def shown(found: running.Running) -> dict[str, Any]:
    """The run file's content for people's programs."""
    return {name: getattr(found, name) for name in found.__dataclass_fields__ if name != "schema"}


def _tell(text: str) -> None:
    print(f"sdnator: {text}", file=sys.stderr, flush=True)


@contextmanager
def _stop_signals() -> Iterator[None]:
    """The first signal raises _Stopped, later ones let the end that it began come to its end."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        numbers.append(signal.SIGHUP)

    def stop(*_: object) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        raise _Stopped

    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    except _Stopped:
        _tell("stopped before everything had started")
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
        raise BadInput(f"{folder}: {error.strerror}; set XDG_DATA_HOME to a folder of yours") from None
    return running.default_archive()


def kitsune_settings(train: int, model: Path | None) -> dict[str, Any]:
    """Settings of Kitsune; raises BadInput for a model that cannot be there."""
    fm_grace = train // TRAIN_SHARE
    settings: dict[str, Any] = {"fm_grace": fm_grace, "ad_grace": train - fm_grace, "mode": "bounded"}
    if model is not None:
        path = model.absolute()
        if not path.parent.is_dir():
            raise BadInput(f"--model {model}: there is no folder {path.parent}")
        # only a missing model is written: what a later run learns must not replace what was trained
        settings["load_model" if path.exists() else "save_model"] = str(path)
    return settings


def parse_ports(options: Sequence[str], switch: str) -> dict[int, str]:
    """`N=veth:NAME` or `N=null`, by number; raises BadInput naming the wrong one."""
    if switch not in ("embedded", "bmv2"):
        host, _, number = switch.rpartition(":")
        if not host or not number.isdecimal():
            raise BadInput(f"--switch {switch}: give embedded, bmv2 or HOST:PORT")
        if options:
            raise BadInput(f"--port: the ports of the switch at {switch} are its own; leave --port out")
    ports: dict[int, str] = {}
    for option in options:
        number, _, kind = option.partition("=")
        place = _port_number(number, f"--port {option}")
        name = kind.removeprefix("veth:")
        if kind != "null" and (name == kind or not name):
            raise BadInput(f"--port {option}: give N=veth:INTERFACE or N=null (captures: `sdnator replay`)")
        if kind == "null" and switch == "bmv2":
            raise BadInput(f"--port {option}: BMv2 has interfaces only; give N=veth:INTERFACE")
        if place in ports:
            raise BadInput(f"--port {option}: port {place} is given twice")
        if kind != "null" and not Path("/sys/class/net", name).exists():
            raise BadInput(f"--port {option}: there is no interface {name}; see `ip link`")
        ports[place] = kind
    return ports


def parse_wires(options: Sequence[str] | None, ports: Mapping[int, str], switch: str) -> dict[int, int]:
    """Ingress port to egress port, both ways; raises BadInput naming the wrong wire."""
    if not options:
        first, second, *more = [*ports, 0, 0]
        return {first: second, second: first} if len(more) == len(ports) == 2 else {}
    if list(options) == ["none"]:
        return {}
    forward: dict[int, int] = {}
    for option in options:
        ends = [_port_number(end, f"--wire {option}") for end in option.split("-")]
        if len(ends) != 2 or ends[0] == ends[1]:
            raise BadInput(f"--wire {option}: give two ports, such as 1-2, or none")
        for near, far in (ends, ends[::-1]):
            if near in forward:
                raise BadInput(f"--wire {option}: port {near} has a wire already")
            if switch in ("embedded", "bmv2") and near not in ports:
                raise BadInput(f"--wire {option}: there is no port {near}; add --port {near}=veth:INTERFACE")
            forward[near] = far
    return forward


def _port_number(text: str, option: str) -> int:
    if not text.isascii() or not text.isdecimal() or int(text) not in _PORTS[1:-1]:
        raise BadInput(f"{option}: ports are numbered from 1 to 509")
    return int(text)


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
    well = all(part["alive"] for part in parts.values()) and apps is not None
    if as_json:
        print(json.dumps({"running": True, "well": well, **shown(found), "parts": parts, "apps": apps}))
    else:
        _show_status(found, parts, apps)
    raise typer.Exit(0 if well else 1)


def _show_status(
    found: running.Running, parts: Mapping[str, Mapping[str, Any]], apps: Mapping[str, str] | None
) -> None:
    print(f"runs for {_age(found.started)} as process {found.pid}; logs in {found.logs}")
    where = {"updates": found.updates, "coordinator": found.coordinator, "switch": found.switch["address"]}
    rows = []
    for name, part in parts.items():
        state = (apps or {}).get(name, "runs") if part["alive"] else "DEAD"
        rows.append((name, str(part["pid"]), state, where.get(name, "")))
    print(plain_table(("part", "process", "state", "where"), rows))
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
