"""Small messages of the stream, as bytes."""

from typing import Any

from dataplane.p4runtime.arbitration import DEFAULT_ROLE, ArbitrationUpdate
from dataplane.p4runtime.status import SPACE, Refused
from p4rt import p4runtime

_MOST_ECHOED = 1 << 14
"""Bytes of a request that are sent back with its error: answers wait in memory."""
_LOW = (1 << 64) - 1
_TEXT = {0: "you are primary", 5: "there is no primary", 6: "another controller is primary"}


def number(election_id: Any) -> int:
    """A Uint128 message as a number; unset = 0."""
    return int(election_id.high << 64 | election_id.low)


def arbitration(device_id: int, notice: ArbitrationUpdate) -> bytes:
    """A MasterArbitrationUpdate for one client."""
    response = p4runtime.StreamMessageResponse()
    update = response.arbitration
    update.device_id = device_id
    if notice.role != DEFAULT_ROLE:
        update.role.name = notice.role
    if notice.election_id is not None:
        update.election_id.SetInParent()
        update.election_id.high, update.election_id.low = notice.election_id >> 64, notice.election_id & _LOW
    update.status.SetInParent()
    update.status.code, update.status.message = notice.code, _TEXT[notice.code]
    return bytes(response.SerializeToString())


def stream_error(error: Refused, request: Any) -> bytes:
    """A StreamError for a packet-out, a digest acknowledgement or another message."""
    response = p4runtime.StreamMessageResponse()
    answer = response.error
    answer.canonical_code, answer.message, answer.space = error.code, str(error), SPACE
    kind = request.WhichOneof("update") if request.ByteSize() <= _MOST_ECHOED else None
    if kind == "packet":
        answer.packet_out.packet_out.CopyFrom(request.packet)
    elif kind == "digest_ack":
        answer.digest_list_ack.digest_list_ack.CopyFrom(request.digest_ack)
    else:
        answer.other.SetInParent()
    return bytes(response.SerializeToString())
