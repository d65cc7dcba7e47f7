"""Half-open connections as the kernel lists them."""

import socket

from sdnator.demos.syn_flood.hosts import _address, half_open


def test_addresses_of_the_kernel():
    """Words in the machine's order, both IP versions."""
    assert _address("0100000A") == "10.0.0.1"
    assert _address("000000FD000000000000000001000000") == "fd00::1"


def test_established_and_listening_are_not_half_open():
    """Only what waits for its last ACK."""
    with socket.create_server(("127.0.0.1", 0)) as service:
        port = service.getsockname()[1]
        # connected on one side is not yet established on the other
        with socket.create_connection(("127.0.0.1", port)), service.accept()[0]:
            assert half_open(port) == {}
