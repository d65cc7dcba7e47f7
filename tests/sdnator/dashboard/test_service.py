"""The dashboard listens where it is told to, or beside it."""

import socket

from sdnator.dashboard.service import CAPABILITIES, INTERESTS, listening


def test_a_taken_port_means_a_free_one():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with listening("127.0.0.1", port) as found:
            assert found.getsockname()[1] != port


def test_it_makes_nothing_but_instructions():
    """Everything else is for looking."""
    assert [one.key for one in CAPABILITIES] == ["network.instruction.dashboard.firewall"]
    assert "network.anomaly.kitsune.score" in {one.key for one in INTERESTS}
