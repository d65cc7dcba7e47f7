"""The operator's commands as a program: `python -m tests.end_to_end.operator_app up`, errors as the product tells them."""

import sys

import typer

from sdnator import coordinator_commands, doctor, due_commands, switch_commands, up_command
from sdnator.errors import SdnatorError

COMMANDS = (
    up_command.up,
    up_command.status,
    up_command.down,
    due_commands.observe,
    due_commands.get,
    coordinator_commands.apps,
    coordinator_commands.keys,
    coordinator_commands.flow,
    switch_commands.tables,
    switch_commands.counters,
    doctor.doctor,
)
app = typer.Typer(pretty_exceptions_enable=False)
for command in COMMANDS:
    app.command(command.__name__)(command)


def main() -> None:
    try:
        app()
    except SdnatorError as error:
        print(f"sdnator: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
