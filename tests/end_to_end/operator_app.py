"""The operator's commands as a program: `python -m tests.end_to_end.operator_app up`, errors as the product tells them."""

from sdnator.cli import (
    coordinator_commands,
    doctor,
    due_commands,
    status_command,
    switch_commands,
    up_command,
)
from sdnator.cli.main import app, main

COMMANDS = (
    up_command.up,
    status_command.status,
    status_command.down,
    due_commands.observe,
    due_commands.get,
    coordinator_commands.apps,
    coordinator_commands.keys,
    coordinator_commands.flow,
    switch_commands.tables,
    switch_commands.counters,
    doctor.doctor,
)

__all__ = ["COMMANDS", "app"]

if __name__ == "__main__":
    main()
