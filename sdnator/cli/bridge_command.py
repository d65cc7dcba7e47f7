"""`sdnator bridge`: joins two sites that each have a pipeline of their own."""

import tempfile
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from due.bridge.bridged_keys import BridgedKeys
from due.bridge.service import Settings, main
from due.config import Options
from due.errors import InvalidKey, InvalidOption
from sdnator.errors import BadInput


def bridge(
    near: Annotated[Path, typer.Option(metavar="FILE", help="Credential of the bridge at this site.")],
    far: Annotated[Path, typer.Option(metavar="FILE", help="Its credential at the other site.")],
    to_far: Annotated[
        list[str], typer.Option(metavar="KEY", help="Key pattern that may cross to the other site.")
    ] = [],  # noqa: B006
    to_near: Annotated[
        list[str], typer.Option(metavar="KEY", help="Key pattern that may cross to this site.")
    ] = [],  # noqa: B006
    name: Annotated[str, typer.Option(metavar="NAME", help="App id of the bridge at both sites.")] = "bridge",
    metrics: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Serve /metrics and /healthz there.")
    ] = "",
) -> None:
    """Join this site with another one, until Ctrl-C or SIGTERM.

    Each site keeps its own Data Updates and Coordinator. Of the keys that may cross, only those cross that somebody at
    the other site wants. A cut link loses nothing reliable; best-effort items are lost meanwhile and counted. Enrol the
    bridge at both sites under the same NAME: it observes there what it takes away, and publishes what it brings.

    Exit codes: 0 ended by a signal, 1 a site cannot be reached or a part of the bridge failed, 2 bad input.

    Example: sdnator bridge --near near.json --far far.json --to-far 'network.anomaly.**'
    """
    try:
        keys = BridgedKeys(to_far), BridgedKeys(to_near)
        if not any(one.allowed for one in keys):
            raise BadInput("nothing may cross: name keys with --to-far or --to-near")
        keys[0].check_apart(keys[1])
        for file in (near, far):
            if not Options.of_credential(str(file)).updates:
                raise BadInput(f"{file} names no Data Updates: write it with `sdnator app enrol`")
    except (InvalidKey, InvalidOption) as error:
        raise BadInput(str(error)) from None
    settings = Settings(far=str(far.absolute()), to_far=tuple(to_far), to_near=tuple(to_near))
    with tempfile.TemporaryDirectory(prefix="sdnator-bridge-") as folder:
        file = Path(folder) / "settings.json"
        file.write_bytes(msgspec.json.encode(settings))
        arguments = [
            "--engine",
            str(near),
            "--settings",
            str(file),
            "--archive",
            f"memory://{name}",
            "--stay",
        ]
        code = main([*arguments, *(("--metrics", metrics) if metrics else ())], name=name)
    raise typer.Exit(code)
