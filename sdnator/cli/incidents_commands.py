"""`sdnator incidents …`: what happened, one row each, from Data Archives."""

import json
import time
from typing import Annotated

import typer

from sdnator.cli.due_commands import Archive
from sdnator.cli.plain_table import fitted
from sdnator.errors import BadInput
from sdnator.incidents.incident_rows import as_json, as_text, row
from sdnator.incidents.incidents_archive import archived_incidents, incident_of
from sdnator.notation import instant_ns

incidents = typer.Typer(help="Incidents: list them, show one.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="JSON on standard output.")]


@incidents.command("list")
def list_incidents(
    *,
    since: Annotated[
        str,
        typer.Option(
            help="Only those reported on since 1h or 7d ago, or since a local time such as 2024-05-01T12:00."
        ),
    ] = "",
    only_open: Annotated[bool, typer.Option("--open", help="Only open incidents.")] = False,
    archive: Archive = "",
    as_json_list: JsonOption = False,
) -> None:
    """List incidents, oldest first: time, kind, attacker, victims, remedy, packets stopped.

    Example: sdnator incidents list --since 24h
    """
    start = instant_ns(since, time.time_ns(), "--since") if since else 0
    found = archived_incidents(archive, start)
    found = [each for each in found if each.state == "open"] if only_open else found
    if as_json_list:
        typer.echo(json.dumps([as_json(each) for each in found]))
    elif not found:
        typer.echo("no incident is open" if only_open else "no incidents")
    else:
        for one in map(row, found):
            typer.echo(
                fitted(f"{one['id']}  {one['time']}  {one['kind']}: {one['attacker']} → {one['victims']}")
            )
            packets = "" if one["stopped"] == "0" else f" ({one['stopped']} packets stopped)"
            typer.echo(fitted(f"    {one['state']}: {one['done']}{packets}"))


@incidents.command("show")
def show_incident(
    name: Annotated[str, typer.Argument(metavar="ID", help="ID of an incident, or of a decision in one.")],
    *,
    archive: Archive = "",
    as_json_object: JsonOption = False,
) -> None:
    """Show everything about one incident: evidence, decisions, packets stopped.

    Example: sdnator incidents show 1f0c2a9be771
    """
    found = incident_of(archive, name)
    if found is None:
        raise BadInput(
            f"no incident, and no decision in one, has the id {name}; see `sdnator incidents list`"
        )
    typer.echo(json.dumps(as_json(found)) if as_json_object else "\n".join(map(fitted, as_text(found))))
