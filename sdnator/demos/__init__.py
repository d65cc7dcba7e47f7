"""Demonstrations on this machine alone."""
