"""`sdnator up`: a whole pipeline that runs until it is told to end."""

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from sdnator import running
from sdnator.errors import BadInput, PipelineError, SdnatorError
from sdnator.running import shown
from sdnator.up_plan import Given, plan_for

if TYPE_CHECKING:
    from sdnator.standing_pipeline import StandingPipeline
    from sdnator.standing_plan import StandingPlan

_LOOK_SECONDS = 0.25


class _Stopped(BaseException):
    """SIGINT or SIGTERM came, or SIGHUP where there is a terminal."""


def up(
    *,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Configuration; default: ./sdnator.toml, else $XDG_CONFIG_HOME/sdnator/sdnator.toml.",
            metavar="FILE",
            show_default=False,
        ),
    ] = None,
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
        str, typer.Option(help="embedded, bmv2, or HOST:PORT of a P4Runtime switch; default: embedded.")
    ] = "",
    device_id: Annotated[int | None, typer.Option(help="P4Runtime device id of the switch.", min=1)] = None,
    updates: Annotated[
        str,
        typer.Option(help="Data Updates, redis:// or unix://; default: an embedded server.", metavar="URL"),
    ] = "",
    archive: Annotated[
        str, typer.Option(help="Data Archives, mongodb:// or sqlite:///; default: a file.", metavar="URL")
    ] = "",
    train: Annotated[
        int | None, typer.Option(help="Packets that Kitsune trains on; default: 55,000.", min=11)
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="Trained model: used if it exists, written otherwise.", metavar="FILE")
    ] = None,
    no_mitigate: Annotated[bool, typer.Option("--no-mitigate", help="Decide, but block nothing.")] = False,
    quota: Annotated[
        float | None,
        typer.Option(
            help="GiB that the embedded archive may take; the oldest items go first; default: 10.", min=0.01
        ),
    ] = None,
    engine: Annotated[
        str,
        typer.Option(
            help="What runs queries' operators on the host: numpy, or spark (extra `spark`); default: numpy."
        ),
    ] = "",
    spark_master: Annotated[
        str,
        typer.Option(
            help="Where Spark runs: local[N] or spark://HOST:PORT; default: local[2].", metavar="URL"
        ),
    ] = "",
    no_dashboard: Annotated[bool, typer.Option("--no-dashboard", help="Serve no page.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Say where everything is as one JSON line.")
    ] = False,
) -> None:
    """Run the whole pipeline until Ctrl-C, SIGTERM or `sdnator down`.

    Without options everything is embedded. What the command line says goes before SDNATOR_… variables,
    and these before the configuration file. A part that dies is started again; the death of a switch,
    whose clock all timers follow, ends the pipeline. Only one runs per user.
    SIGHUP: started from a terminal, the pipeline ends with it; as a service it reads the configuration
    again, starts the parts anew whose settings have changed, and says what it cannot take up.
    Exit codes: 0 stopped, 1 a part failed or one runs already, 2 misuse.

    Example: sdnator up --port 1=veth:eth1 --port 2=veth:eth2
    """
    given = Given(
        config=config,
        ports=tuple(port or ()),
        wires=tuple(wire or ()),
        switch=switch,
        device_id=device_id,
        updates=updates,
        archive=archive,
        train=train,
        model=model,
        mitigate=not no_mitigate,
        quota=quota,
        dashboard=not no_dashboard,
        engine=engine,
        spark_master=spark_master,
    )
    with _stop_signals() as reloads:
        state = running.state_folder()
        plan = plan_for(given, state)
        with running.claimed(state):
            _keep_up(plan, given, reloads, as_json=as_json)


def _keep_up(plan: "StandingPlan", given: Given, reloads: list[int], *, as_json: bool) -> None:
    from sdnator.p4_program import P4ProgramError
    from sdnator.standing_pipeline import StandingPipeline

    started = time.time_ns()
    try:
        with StandingPipeline(plan, _tell) as pipeline:
            _announce(_note(pipeline, given, started), as_json=as_json)
            while True:
                time.sleep(_LOOK_SECONDS)
                changed = pipeline.watch()
                if reloads:
                    reloads.clear()
                    _reload(pipeline, given)
                    changed = True
                if changed:
                    _note(pipeline, given, started)
    except P4ProgramError as error:
        raise PipelineError(str(error)) from None
    except _Stopped:
        _tell("stopped; nothing was left running")


def _reload(pipeline: "StandingPipeline", given: Given) -> None:
    """A configuration that is wrong changes nothing."""
    try:
        plan = plan_for(given, pipeline.plan.state)
    except SdnatorError as error:
        _tell(f"the configuration was not taken up: {error}")
        return
    pipeline.reload(plan)


def _note(pipeline: "StandingPipeline", given: Given, started: int) -> running.Running:
    from sdnator.metrics_targets import write_targets

    plan = pipeline.plan
    switches = [
        {
            "name": one.name,
            "address": pipeline.switch_addresses[one.name],
            "device_id": one.device_id,
            "target": one.kind,
            "ports": {str(number): kind for number, kind in one.ports.items()},
            "forward": {str(number): egress for number, egress in one.forward.items()},
        }
        for one in plan.switches
    ]
    metrics = {
        "coordinator": pipeline.coordinator.removeprefix("http://"),
        **pipeline.endpoints("metrics"),
    }
    found = running.Running(
        pid=os.getpid(),
        started=started,
        updates=pipeline.updates,
        archive=plan.archive,
        coordinator=pipeline.coordinator,
        switch=switches[0],
        switches=switches,
        parts=pipeline.pids(),
        logs=str(plan.state / "logs"),
        dashboard=pipeline.dashboard,
        token_file=str((plan.dashboard or {}).get("token_file", "")),
        metrics=metrics,
        config=str(given.file() or ""),
    )
    running.write(plan.state, found)
    write_targets(plan.metrics_targets, metrics)
    return found


def _announce(found: running.Running, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"ready": True, **shown(found)}), flush=True)
        return
    lines = [
        ("Data Updates", found.updates),
        ("Data Archives", found.archive),
        ("Coordinator", found.coordinator),
        *(("switch", _switch_line(one)) for one in found.switches),
        ("logs", found.logs),
    ]
    if found.config:
        lines.append(("configuration", found.config))
    if found.dashboard:
        lines += [("dashboard", found.dashboard), ("", f"sign in with the token in {found.token_file}")]
    for name, where in lines:
        print(f"{name:<14}{where}")
    print(f"apps of yours export DUE_UPDATES={quote(found.updates)} DUE_ARCHIVE={quote(found.archive)}")
    print("The pipeline runs; Ctrl-C or `sdnator down` ends it.", flush=True)


def _switch_line(switch: object) -> str:
    assert isinstance(switch, dict)  # noqa: S101 - made by _note
    ports = ", ".join(f"{number}={kind}" for number, kind in switch["ports"].items()) or "no ports"
    return f"{switch['name']} at {switch['address']} ({switch['target']}; {ports})"


def _tell(text: str) -> None:
    print(f"sdnator: {text}", file=sys.stderr, flush=True)


def _has_terminal() -> bool:
    """Whether a terminal controls this process, also where its input and output go elsewhere."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return False
    return True


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """The first signal raises _Stopped, later ones let the end that it began come to its end.

    Yields the list that takes SIGHUPs which mean: read the configuration again.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    reloads: list[int] = []
    hangup = signal.getsignal(signal.SIGHUP)

    def stop(*_: object) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        raise _Stopped

    if hangup is not signal.SIG_IGN:  # nohup
        if _has_terminal():
            numbers.append(signal.SIGHUP)
        else:
            signal.signal(signal.SIGHUP, lambda number, _: reloads.append(number))
    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield reloads
    except _Stopped:
        _tell("stopped before everything had started")
    finally:
        for number, handler in {**before, signal.SIGHUP: hangup}.items():
            signal.signal(number, handler)


__all__ = ["BadInput", "up"]
