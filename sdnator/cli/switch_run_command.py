"""`sdnator switch`: one embedded switch alone, for work on controllers and on the data plane."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from sdnator.cli.plain_table import plain_table
from sdnator.errors import PipelineError
from sdnator.supervisor.child import how_ended

_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_STOP_SECONDS = 10.0
_FORMS = "N=veth:INTERFACE, N=pcap:IN.pcap,OUT.pcap (either may be empty), N=capture:SOCKET, N=null"


def switch(
    *,
    ports: Annotated[
        list[str] | None,
        typer.Option("--port", "--ports", help=f"A port, one option each: {_FORMS}.", metavar="N=KIND"),
    ] = None,
    grpc: Annotated[
        str,
        typer.Option(
            help="Address on which P4Runtime is served: HOST:PORT (port 0: any free one) with certificates or "
            "--insecure, or unix:/PATH; default: a Unix socket that only its user can reach.",
            metavar="ADDRESS",
        ),
    ] = "",
    device_id: Annotated[int, typer.Option(help="P4Runtime device id.", min=1)] = 1,
    cpu_port: Annotated[
        int, typer.Option(help="Number of the port to the controller.", min=1, max=510)
    ] = 510,
    tls_cert: Annotated[str, typer.Option(help="PEM certificate of the server.", metavar="FILE")] = "",
    tls_key: Annotated[str, typer.Option(help="PEM private key of the server.", metavar="FILE")] = "",
    tls_client_ca: Annotated[
        str, typer.Option(help="PEM certificates of the CAs that sign clients' certificates.", metavar="FILE")
    ] = "",
    tls_rights: Annotated[
        list[str] | None,
        typer.Option(
            help="Rights of clients by the name of their certificate: some of tables, packet-out and pipeline; "
            "default: controller all, operator all but pipeline, viewer read only.",
            metavar="NAME=RIGHTS",
        ),
    ] = None,
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure",
            help="HOST:PORT without certificates, for a lab: anyone who reaches it controls the switch.",
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON line when it is ready, one with the counters at the end.")
    ] = False,
) -> None:
    """Run one embedded switch until Ctrl-C; a controller loads its program.

    Exit codes: 0 ended by Ctrl-C or SIGTERM, 1 the switch failed, 2 a wrong option.

    Example: sdnator switch --port 1=veth:eth1 --port 2=veth:eth2
    """
    command = ["--device-id", str(device_id), "--cpu-port", str(cpu_port)]
    command += ["--grpc", grpc] if grpc else []
    command += ["--insecure"] if insecure else []
    command += [part for each in tls_rights or () for part in ("--tls-rights", each)]
    command += ["--state-json", "-"]
    for port in ports or []:
        command += ["--port", port]
    for option, value in (("cert", tls_cert), ("key", tls_key), ("client-ca", tls_client_ca)):
        command += [f"--tls-{option}", value] if value else []
    raise typer.Exit(_run(command, ports or [], as_json=as_json))


def _run(command: Sequence[str], ports: Sequence[str], *, as_json: bool) -> int:
    running: list[subprocess.Popen[str]] = []
    stops: list[int] = []

    def stop(number: int, _frame: object) -> None:
        stops.append(number)
        for each in running:
            each.terminate()

    before = {number: signal.signal(number, stop) for number in _STOPS}
    process = subprocess.Popen(
        [sys.executable, "-m", "dataplane", *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C reaches this process only, which then ends the switch
        env=os.environ | {"DUE_PARENT": str(os.getpid())},
    )
    running.append(process)
    if stops:
        process.terminate()
    try:
        assert process.stdout is not None  # noqa: S101 - opened as a pipe above
        for line in process.stdout:
            _show(json.loads(line), ports, as_json=as_json)
        return _ended(process.wait(_STOP_SECONDS))
    finally:
        process.kill()
        process.wait()
        for number, handler in before.items():
            signal.signal(number, handler)


def _ended(code: int) -> int:
    if code < 0:
        raise PipelineError(f"the switch {how_ended(code)}")
    return code


def _show(said: Mapping[str, Any], ports: Sequence[str], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(said), flush=True)
    elif said.get("ready"):
        print(f"P4Runtime on {said['grpc']}, process {said['pid']}; Ctrl-C ends it", flush=True)
        for port in ports:
            print(f"  port {port}", flush=True)
    else:
        rows = [(number, *map(str, counts.values())) for number, counts in said["ports"].items()]
        names = next((tuple(counts) for counts in said["ports"].values()), ())
        print(plain_table(("port", *names), rows), flush=True)
