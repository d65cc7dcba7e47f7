"""`sdnator app …`: credentials for apps that the pipeline does not start."""

import json
from pathlib import Path
from typing import Annotated

import typer

from due.drivers.redis_rights import Rights
from due.errors import InvalidKey
from due.keys import Key
from sdnator.config import config_file
from sdnator.errors import BadInput
from sdnator.private_files import write_private_json
from sdnator.rights.granting import OPERATOR, is_dangerous
from sdnator.rights.identities import Identities, credential_file
from sdnator.up import running

app = typer.Typer(help="Apps that the pipeline does not start: their credentials.", no_args_is_help=True)


@app.command("enrol")
def enrol(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Its app id.")],
    publish: Annotated[list[str], typer.Option(metavar="KEY", help="Key pattern that it may publish.")] = [],  # noqa: B006
    observe: Annotated[list[str], typer.Option(metavar="KEY", help="Key pattern that it may observe.")] = [],  # noqa: B006
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The credential file; default: NAME.credential.json.")
    ] = None,
    *,
    command: Annotated[
        bool, typer.Option("--command", help="Also grant keys that command switches and apps.")
    ] = False,
) -> None:
    """Give an app of yours a credential, with rights for these keys; enrol it again to change them.

    The app reads the file that $DUE_CREDENTIAL names, or takes it as `--engine FILE`. A running pipeline knows the
    credential within a second or two.

    Exit codes: 0 written, 2 a key is malformed, commands something, or the file cannot be written.

    Example: sdnator app enrol my_detector --publish 'network.anomaly.my_detector.**' --observe 'network.packets.**'
    """
    rights = Rights(app=name, publish=_checked(publish), observe=_checked(observe))
    for key in () if command else rights.publish:
        if is_dangerous(key, name):
            raise BadInput(f"--publish {key}: that commands something, or is another part's; add --command")
    identities = Identities(running.state_folder())
    with identities.changing():
        known = identities.all.get(name)
        if name == OPERATOR or (known is not None and not known.enrolled):
            raise BadInput(f"{name} is an app of the pipeline: choose another name")
        made = identities.put(name, rights, enrolled=True)
    path = (out or Path(f"{name}.credential.json")).absolute()
    try:
        write_private_json(path, credential_file(identities.url(_server(), name), "", made))
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror}") from None
    typer.echo(f"{name} may publish {_shown(rights.publish)} and observe {_shown(rights.observe)}")
    typer.echo(f"its credential: {path}; start it with DUE_CREDENTIAL={path}")


@app.command("list")
def list_apps(
    *, as_json: Annotated[bool, typer.Option("--json", help="JSON on standard output.")] = False
) -> None:
    """Show who has a credential, and for what.

    Example: sdnator app list
    """
    rows = {
        name: one for name, one in sorted(Identities(running.state_folder()).all.items()) if name != OPERATOR
    }
    if as_json:
        shown = {
            name: {"enrolled": one.enrolled, "publish": one.rights.publish, "observe": one.rights.observe}
            for name, one in rows.items()
        }
        typer.echo(json.dumps(shown))
        return
    for name, one in rows.items():
        kind = "enrolled" if one.enrolled else "started by the pipeline"
        typer.echo(f"{name} ({kind})")
        typer.echo(f"  publishes {_shown(one.rights.publish)}")
        typer.echo(f"  observes  {_shown(one.rights.observe)}")
    if not rows:
        typer.echo("no app has a credential: `sdnator up` makes those of its apps")


@app.command("remove")
def remove(name: Annotated[str, typer.Argument(metavar="NAME", help="Its app id.")]) -> None:
    """Take an enrolled app's credential away; its connections end within a second or two.

    Exit codes: 0 removed, 2 no such app is enrolled.

    Example: sdnator app remove my_detector
    """
    identities = Identities(running.state_folder())
    with identities.changing():
        known = identities.all.get(name)
        if known is None or not known.enrolled:
            raise BadInput(f"no app {name} is enrolled: see `sdnator app list`")
        identities.remove(name)
    typer.echo(f"{name} has no credential any more")


def _checked(patterns: list[str]) -> tuple[str, ...]:
    try:
        return tuple(Key.parse(pattern).path for pattern in patterns)
    except InvalidKey as error:
        raise BadInput(str(error)) from None


def _shown(patterns: tuple[str, ...]) -> str:
    return ", ".join(patterns) or "nothing"


def _server() -> str:
    """The Data Updates server of the running pipeline, of the configuration, or the embedded one to be."""
    given = str(config_file.load(config_file.find()).struct("up").updates)
    link, found = running.updates_link(running.state_folder()), running.find()
    if found is None:
        return given or f"unix://{link}"
    embedded = link.is_symlink() and found.updates.endswith(f"@{link.readlink()}")
    return f"unix://{link}" if embedded else found.updates
