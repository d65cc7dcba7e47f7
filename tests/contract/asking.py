"""Frames and entries of the feature program, and what comes of requests that fail."""

import struct

import grpc
import pytest

from sdnator.testing.p4runtime_client import insert, update_errors


def frame(what=0, *, a=0, b=0, c=0, d=0, e=0):
    """A frame of the feature program's test type."""
    return bytes(range(12)) + b"\x88\xb5" + struct.pack(">BBBHIQH", what, a, b, c, d, e, 0) + bytes(40)


def ip_frame(destination):
    header = struct.pack(">BBHHHBBHII", 0x45, 0, 20, 1, 0, 64, 17, 0, 0x0A000001, destination)
    return bytes(12) + b"\x08\x00" + header + bytes(30)


def codes(call):
    """Canonical codes of the updates of a batch that fails."""
    with pytest.raises(grpc.RpcError) as caught:
        call()
    assert caught.value.code() == grpc.StatusCode.UNKNOWN
    return [error.canonical_code for error in update_errors(caught.value)]


def status_of(call):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    return caught.value.code().value[0]


def route(names, address, prefix, port=2, **fields):
    return names.entry("I.route", {"h.ip.dst": (address, prefix)}, "I.counted", [port], **fields)


def flow(names, **fields):
    match = {"h.test.c": (1, 9), "h.test.d": (0x100, 0xF00), "h.test.a": 4}
    return names.entry("I.flows", match, "I.metered", [2], **{"priority": 3, **fields})


def forward(names, controller, port_in=1, port_out=2):
    controller.write(insert(names.entry("I.ports", {"sm.ingress_port": port_in}, "I.forward", [port_out])))


def entries(names, table, **fields):
    return names.entry(table, {}, **fields)
