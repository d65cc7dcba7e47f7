"""Kitsune alone on a capture or an interface."""
