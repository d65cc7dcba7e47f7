"""`sdnator app …`: credentials for apps that the pipeline does not start."""

import json
from pathlib import Path
from typing import Annotated

import typer

from due.drivers.redis_rights import Rights
from due.errors import InvalidKey
from due.keys import Key
from due.private_files import write_private_json
from sdnator.config import config_file
from sdnator.errors import BadInput
from sdnator.rights.audit_trail import note
from sdnator.rights.granting import OPERATOR, is_dangerous
from sdnator.rights.identities import Identities, credential_file
from sdnator.rights.keeping import keeps_archives
from sdnator.up import running

app = typer.Typer(help="Apps that the pipeline does not start: their credentials.", no_args_is_help=True)


@app.command("enrol")
def enrol(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Its app id.")],
    publish: Annotated[list[str], typer.Option(metavar="KEY", help="Key pattern that it may publish.")] = [],  # noqa: B006
    observe: Annotated[list[str], typer.Option(metavar="KEY", help="Key pattern that it may observe.")] = [],  # noqa: B006
    read: Annotated[
        list[str], typer.Option(metavar="KEY", help="Key pattern that it may read from the archive.")
    ] = [],  # noqa: B006
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Credential file to write; default: NAME.credential.json."),
    ] = None,
    *,
    command: Annotated[
        bool, typer.Option("--command", help="Also grant keys that command switches and apps.")
    ] = False,
) -> None:
    """Give an app of yours a credential, with rights for these keys; enrol it again to change them.

    The app reads the file that $DUE_CREDENTIAL names, or takes it as `--engine FILE`. A running pipeline knows the
    credential within a second or two. From the archive it reads what it wrote itself, and the keys of --read: from
    MongoDB itself, otherwise by GET /get of the Coordinator, with its password as token.

    Exit codes: 0 written, 2 a key is malformed, commands something, or the file cannot be written.

    Example: sdnator app enrol my_detector --publish 'network.anomaly.my_detector.**' --observe 'network.packets.**'
    """
    rights = Rights(app=name, publish=_checked(publish), observe=_checked(observe), read=_checked(read))
    for key in () if command else rights.publish:
        if is_dangerous(key, name):
            raise BadInput(
                f"--publish {key}: this key commands something or belongs to another part; add --command to grant it"
            )
    identities = Identities(running.state_folder())
    with identities.changing():
        known = identities.all.get(name)
        if name == OPERATOR or (known is not None and not known.enrolled):
            raise BadInput(f"{name} is an app of the pipeline: choose another name")
        made = identities.put(name, rights, enrolled=True)
    path = (out or Path(f"{name}.credential.json")).absolute()
    try:
        write_private_json(
            path, credential_file(identities.url(_server(), name), _archive(identities, name), made)
        )
    except OSError as error:
        raise BadInput(
            f"{path}: cannot be written ({error.strerror}); name another file with --out"
        ) from None
    granted = (
        f"publish {_shown(rights.publish)}; observe {_shown(rights.observe)}; read {_shown(rights.read)}"
    )
    note(f"enrolled app {name}: {granted}")
    typer.echo(f"{name} may {granted}")
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
            name: {
                "enrolled": one.enrolled,
                "publish": one.rights.publish,
                "observe": one.rights.observe,
                "read": one.rights.read,
            }
            for name, one in rows.items()
        }
        typer.echo(json.dumps(shown))
        return
    for name, one in rows.items():
        kind = "enrolled" if one.enrolled else "started by the pipeline"
        typer.echo(f"{name} ({kind})")
        typer.echo(f"  publishes {_shown(one.rights.publish)}")
        typer.echo(f"  observes  {_shown(one.rights.observe)}")
        typer.echo(f"  reads     {_shown(one.rights.read)}")
    if not rows:
        typer.echo("no app has a credential; `sdnator up` creates those of its own apps")


@app.command("remove")
def remove(name: Annotated[str, typer.Argument(metavar="NAME", help="Its app id.")]) -> None:
    """Revoke an enrolled app's credential; its connections end within a second or two.

    Exit codes: 0 removed, 2 no such app is enrolled.

    Example: sdnator app remove my_detector
    """
    identities = Identities(running.state_folder())
    with identities.changing():
        known = identities.all.get(name)
        if known is None or not known.enrolled:
            raise BadInput(f"no app {name} is enrolled: see `sdnator app list`")
        identities.remove(name)
    note(f"revoked the credential of app {name}")
    typer.echo(f"{name}: its credential is revoked")


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


def _archive(identities: Identities, name: str) -> str:
    """The archive of the running pipeline, where it knows apps; empty: the app has one of its own."""
    found = running.find()
    if found is None or not keeps_archives(found.archive):
        return ""
    from due.drivers.mongodb_apps import has_app  # pymongo is an extra
    from sdnator.rights.mongo_keeper import apps_url

    return apps_url(found.archive, identities, name) if has_app(found.archive) else ""
