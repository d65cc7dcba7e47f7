"""The product's compiled switch program, and packet-ins as a switch with it sends them."""

from functools import cache

from apps.p4runtime_ctrl.southbound.p4info import ProgramInfo
from apps.p4runtime_ctrl.southbound.session import CompiledProgram
from apps.p4runtime_ctrl.southbound.values import canonical
from p4rt import p4runtime
from sdnator.p4_program import PROGRAM as _NAME
from sdnator.p4_program import folder

PROGRAM = folder() / f"{_NAME}.json"
"""What p4c made for BMv2."""
P4INFO = folder() / f"{_NAME}.p4info.txtpb"
EVERY_PACKET = 1 << 255
"""The query map of a packet that the query of bit 255 wants."""


@cache
def program() -> ProgramInfo:
    """The program's tables, actions and headers by name."""
    return ProgramInfo.from_text(P4INFO.read_text(encoding="utf-8"))


def without(digest: str) -> ProgramInfo:
    """The program as somebody might have it who took a digest out of it.

    Args:
        digest: name in the p4info.
    """
    message = type(program().message)()
    message.CopyFrom(program().message)
    kept = [each for each in message.digests if each.preamble.name != digest]
    del message.digests[:]
    message.digests.extend(kept)
    message.type_info.structs.pop(digest, None)
    return ProgramInfo(message)


def pipeline() -> CompiledProgram:
    """The p4info with a program that no switch could run: for stand-ins that do not look at it."""
    return CompiledProgram(b"{}", program().message)


def packet_in(
    sequence: int,
    *,
    arrival: int | None = None,
    port: int = 1,
    timestamp: int = 0,
    frame: bytes = b"\x00" * 60,
    length: int | None = None,
    queries: int = EVERY_PACKET,
    reason: int = 0,
) -> p4runtime.PacketIn:
    """A packet-in with the program's header.

    Args:
        sequence: number of the packet-in, from 1.
        arrival: number of the packet at the switch, from 0; None: that before `sequence`.
        port: of ingress.
        timestamp: µs of the switch's clock.
        frame: bytes that were copied.
        length: bytes on the wire; None: those of `frame`.
        queries: map of the queries that want it, 256 bits.
        reason: 0: a query wanted it.
    """
    values = {
        "ingress_port": port,
        "reason": reason,
        "timestamp": timestamp,
        "length": len(frame) if length is None else length,
        "sequence": sequence,
        "arrival": max(0, sequence - 1) if arrival is None else arrival,
        "query_map": queries,
    }
    packet = p4runtime.PacketIn(payload=frame)
    for field in program().headers["packet_in"]:
        packet.metadata.add(metadata_id=field.id, value=canonical(values[field.name]))
    return packet
