"""Which operators run in the switch and which on the host."""
