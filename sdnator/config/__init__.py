"""`sdnator.toml`: model, parsing, and the switches in it."""
