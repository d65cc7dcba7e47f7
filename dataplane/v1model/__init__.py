"""The switch itself: program, tables, externs, packets."""
