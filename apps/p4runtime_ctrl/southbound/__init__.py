"""P4Runtime towards the switch: connection, program, and its messages as columns."""
