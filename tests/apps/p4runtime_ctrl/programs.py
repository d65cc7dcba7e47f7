"""The program under control, and packet-ins as it would send them."""

from functools import cache
from pathlib import Path

from apps.p4runtime_ctrl.p4info import Program
from apps.p4runtime_ctrl.session import Pipeline
from apps.p4runtime_ctrl.values import canonical
from p4rt import p4runtime

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = ROOT / "p4" / "sdnator.json"
P4INFO = ROOT / "p4" / "sdnator.p4info.txtpb"
EVERY_PACKET = 1 << 255


@cache
def program() -> Program:
    return Program.from_text(P4INFO.read_text(encoding="utf-8"))


def without(digest: str) -> Program:
    """A program of one's own that does not have this digest."""
    message = type(program().message)()
    message.CopyFrom(program().message)
    kept = [each for each in message.digests if each.preamble.name != digest]
    del message.digests[:]
    message.digests.extend(kept)
    message.type_info.structs.pop(digest, None)
    return Program(message)


def pipeline() -> Pipeline:
    return Pipeline(b"{}", program().message)


def packet_in(
    sequence,
    *,
    arrival=None,
    port=1,
    timestamp=0,
    frame=b"\x00" * 60,
    length=None,
    queries=EVERY_PACKET,
    reason=0,
):
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
