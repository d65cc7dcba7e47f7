"""Machine Assets: a fleet of emulated Ultimaker 3 printers, each behind a REST interface of its own."""
