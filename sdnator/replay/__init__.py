"""Replay of a capture: feeding, packet accounting, summary."""
