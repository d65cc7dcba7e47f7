"""`sdnator up`: run a whole pipeline until it is stopped."""

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from sdnator.errors import BadInput, PipelineError, SdnatorError
from sdnator.northbound import without_user
from sdnator.redaction import redacted
from sdnator.rights.sign_in_link import new_link
from sdnator.up import running
from sdnator.up.planning import Given, plan_for
from sdnator.up.running import shown

if TYPE_CHECKING:
    from sdnator.up.pipeline import StandingPipeline
    from sdnator.up.plan import StandingPlan
    from sdnator.up.run_report import UpReport

_LOOK_SECONDS = 0.25
_REPORT_SECONDS = 5.0


class _Stopped(BaseException):
    """SIGINT or SIGTERM arrived, or SIGHUP with a terminal."""


def up(
    *,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Configuration; default: ./sdnator.toml, else that in $XDG_CONFIG_HOME/sdnator.",
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
            help="Port forwarding in both directions; default: two ports are joined; `none`: no forwarding.",
            metavar="N-M",
        ),
    ] = None,
    switch: Annotated[
        str, typer.Option(help="embedded, bmv2, or HOST:PORT of a P4Runtime switch; default: embedded.")
    ] = "",
    grpc: Annotated[
        str,
        typer.Option(
            help="Address on which the switch serves P4Runtime; default: a Unix socket (embedded).",
            metavar="HOST:PORT",
        ),
    ] = "",
    insecure: Annotated[
        bool,
        typer.Option("--insecure", help="Use P4Runtime over TCP without TLS for the switch (for a lab)."),
    ] = False,
    device_id: Annotated[int | None, typer.Option(help="P4Runtime device id of the switch.", min=1)] = None,
    updates: Annotated[
        str,
        typer.Option(
            help="Data Updates, redis://, redis+sentinel:// or unix://; default: an embedded server.",
            metavar="URL",
        ),
    ] = "",
    archive: Annotated[
        str, typer.Option(help="Data Archives, mongodb:// or sqlite:///; default: a file.", metavar="URL")
    ] = "",
    train: Annotated[
        int | None, typer.Option(help="Packets that Kitsune trains on; default: 55,000.", min=11)
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Trained model: used if it exists, written otherwise; default: kept in the state folder.",
            metavar="FILE",
        ),
    ] = None,
    no_mitigate: Annotated[bool, typer.Option("--no-mitigate", help="Decide, but block nothing.")] = False,
    quota: Annotated[
        float | None,
        typer.Option(
            help="Size limit of the embedded archive, GiB; the oldest items are deleted first, what is in force last; default: 10.",
            min=0.01,
        ),
    ] = None,
    engine: Annotated[
        str,
        typer.Option(help="Engine of host operators: numpy, or spark (extra `spark`); default: numpy."),
    ] = "",
    spark_master: Annotated[
        str,
        typer.Option(
            help="Where Spark runs: local[N] or spark://HOST:PORT; default: local[2].", metavar="URL"
        ),
    ] = "",
    no_dashboard: Annotated[bool, typer.Option("--no-dashboard", help="Do not serve the dashboard.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print all addresses as one JSON line.")] = False,
) -> None:
    """Run the whole pipeline until Ctrl-C, SIGTERM or `sdnator down`.

    Without options everything is embedded. Options override SDNATOR_… variables, which override the
    configuration file. A part that dies or hangs is restarted, without limit: after three deaths in a row
    `sdnator status` calls it degraded. Only one pipeline runs per user.

    SIGHUP: started from a terminal, the pipeline ends with it. As a service it reads the configuration
    again, restarts the parts whose settings have changed, and names changes that need a restart of all.
    Exit codes: 0 stopped, 1 a part did not start or one runs already, 2 misuse.

    Example: sdnator up --port 1=veth:eth1 --port 2=veth:eth2
    """
    given = Given(
        config=config,
        ports=tuple(port or ()),
        wires=tuple(wire or ()),
        switch=switch,
        device_id=device_id,
        listen=grpc,
        insecure=insecure,
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
    from sdnator.up.pipeline import StandingPipeline
    from sdnator.up.run_report import UpReport

    started = time.time_ns()
    try:
        with StandingPipeline(plan, _tell) as pipeline, ExitStack() as stack:
            report = UpReport(pipeline, str(given.file() or ""), started, stack)
            _announce(report.write(), pipeline.uncontrolled, as_json=as_json)
            _watch(pipeline, report, given, reloads)
    except P4ProgramError as error:
        raise PipelineError(str(error)) from None
    except _Stopped:
        _tell("stopped; all processes have ended")


def _watch(pipeline: "StandingPipeline", report: "UpReport", given: Given, reloads: list[int]) -> NoReturn:
    written = time.monotonic()
    while True:
        pipeline.wait(_LOOK_SECONDS)
        changed = pipeline.watch()
        if reloads:
            reloads.clear()
            _reload(pipeline, given)
            changed = True
        # log sizes change all the time, and need not be current
        if changed or time.monotonic() - written > _REPORT_SECONDS:
            written = time.monotonic()
            _try_to_write(report)


def _try_to_write(report: "UpReport") -> None:
    """A full disk must not end the pipeline."""
    try:
        report.write()
    except (OSError, BadInput) as error:
        _tell(f"the run file cannot be written, so `sdnator status` shows old figures: {error}")


def _reload(pipeline: "StandingPipeline", given: Given) -> None:
    """A wrong configuration changes nothing."""
    try:
        plan = plan_for(given, pipeline.plan.state)
    except SdnatorError as error:
        _tell(f"the new configuration was not applied: {error}")
        return
    pipeline.reload(plan)


def _announce(found: running.Running, uncontrolled: str, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"ready": True, "uncontrolled": uncontrolled, **shown(found)}), flush=True)
        return
    updates, archive = redacted(found.updates), redacted(found.archive)
    lines = [
        ("Data Updates", updates),
        ("Data Archives", archive),
        ("Coordinator", without_user(found.coordinator)),
        *(("switch", _switch_line(one)) for one in found.switches),
        ("logs", found.logs),
    ]
    if found.config:
        lines.append(("configuration", found.config))
    if found.model:
        lines.append(("model", found.model))
    if found.dashboard:
        lines += [("dashboard", found.dashboard), ("", _way_in(found))]
    for name, where in lines:
        print(f"{name:<14}{where}")
    print(f"for your own apps: export DUE_UPDATES={quote(updates)} DUE_ARCHIVE={quote(archive)}")
    if (updates, archive) != (found.updates, found.archive):
        print("where … stands for user and password, which are not shown")
    if uncontrolled:
        print(f"NOT under control: {uncontrolled}")
        print("The apps run, and the controller tries again; Ctrl-C or `sdnator down` ends them.", flush=True)
        return
    print("The pipeline runs; Ctrl-C or `sdnator down` ends it.", flush=True)


def _way_in(found: running.Running) -> str:
    """A link for who sits here; none where the output may be kept in a file that others read."""
    if sys.stdout.isatty():
        with suppress(OSError):
            return f"open {new_link(running.state_folder(), found.dashboard)} to sign in (once)"
    return f"`sdnator user link` prints a link that signs in; the token is in {found.token_file}"


def _switch_line(switch: object) -> str:
    assert isinstance(switch, dict)  # noqa: S101 - made by _note
    ports = ", ".join(f"{number}={kind}" for number, kind in switch["ports"].items()) or "no ports"
    return f"{switch['name']} at {switch['address']} ({switch['target']}; {ports})"


def _tell(text: str) -> None:
    # a reader that has closed our output must not end the pipeline
    with suppress(OSError):
        print(f"sdnator: {redacted(text)}", file=sys.stderr, flush=True)


def _has_terminal() -> bool:
    """Whether a terminal controls this process, even if its input and output are redirected."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return False
    return True


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """The first signal raises _Stopped; later ones do not interrupt the shutdown.

    Yields the list of SIGHUPs that ask for a reload of the configuration.
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
        _tell("stopped before all parts had started")
    finally:
        for number, handler in {**before, signal.SIGHUP: hangup}.items():
            signal.signal(number, handler)


__all__ = ["BadInput", "up"]
