"""`sdnator demo …`: shows that need no data."""

from pathlib import Path
from typing import Annotated

import typer

from sdnator.syn_flood_command import syn_flood_command

demos = typer.Typer()
demos.command("syn-flood")(syn_flood_command)


@demos.callback(invoke_without_command=True)
def demo(
    context: typer.Context,
    *,
    folder: Annotated[Path, typer.Option(help="Where capture and report go.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Of the generated capture.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Make a capture of an infected home network, replay it, and see the attack blocked.

    Example: sdnator demo --folder demo
    """
    if context.invoked_subcommand is not None:
        return
    from sdnator.replay_command import run_demo

    run_demo(folder, seed, as_json=as_json)
