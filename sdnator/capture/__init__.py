"""Captures and live interfaces: reading, writing, labels."""
