"""`sdnator demo …`: demonstrations that need no input."""

from pathlib import Path
from typing import Annotated

import typer

from sdnator.cli.syn_flood_command import syn_flood_command

demos = typer.Typer()
demos.command("syn-flood")(syn_flood_command)


@demos.callback(invoke_without_command=True)
def demo(
    context: typer.Context,
    *,
    folder: Annotated[Path, typer.Option(help="Folder for capture and report.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Seed of the generated capture.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Generate a capture of an infected home network, replay it, and block the attack.

    Example: sdnator demo --folder demo
    """
    if context.invoked_subcommand is not None:
        return
    from sdnator.cli.replay_command import run_demo

    run_demo(folder, seed, as_json=as_json)
