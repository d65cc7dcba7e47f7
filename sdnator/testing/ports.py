"""Ports for servers of tests and benchmarks."""

import socket


def free_port() -> int:
    """A TCP port of 127.0.0.1 on which nobody is listening."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
