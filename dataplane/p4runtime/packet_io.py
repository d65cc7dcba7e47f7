"""Packet-ins as bytes on the wire, and packet-outs as frames for the CPU port.

A Python gRPC stream carries some 17,000 messages a second, so what is added to each packet-in counts.
The header's layout is fixed when the pipeline is set; an encoder made for it then writes the
StreamMessageResponse directly:

    0x12 <len> ┌ PacketIn                                                     (field `packet`)
               │ 0x0a <len> payload
               └ 0x12 <len> 0x08 <metadata id> 0x12 <len> value               (for each header field)

tests/dataplane compare it with the same message made by protobuf.
"""

from collections.abc import Callable, Sequence
from typing import Any

from dataplane.compiler.samples import varint
from dataplane.p4runtime import bytestrings
from dataplane.p4runtime.schema import MetadataField
from dataplane.p4runtime.status import InvalidArgument, Refused

MAX_PAYLOAD = 65_535
"""Bytes of a packet-out."""
_CACHED_BITS = 10

Piece = Callable[[bytes, int], bytes]


_VARINTS = tuple(varint(value) for value in range(1 << 14))


class PacketInEncoder:
    """Makes StreamMessageResponse bytes out of what the switch sent to the CPU port.

    fields: the packet_in header of the p4info; without any, frames travel bare
    """

    def __init__(self, fields: Sequence[MetadataField]) -> None:
        bits = sum(field.width for field in fields)
        self.header_bytes = bits // 8
        self._pieces: list[Piece] = []
        start = 0
        for field in fields:
            self._pieces.append(_piece(field, start, bits))
            start += field.width

    def encode(self, frame: bytes) -> bytes:
        """One packet-in; `frame` begins with the packet_in header.

        Raises InvalidArgument where the frame is shorter than that header.
        """
        length = self.header_bytes
        if len(frame) < length:
            raise InvalidArgument(
                f"packet-in of {len(frame)} bytes is shorter than its header of {length} bytes"
            )
        header = int.from_bytes(frame[:length], "big")
        metadata = b"".join([piece(frame, header) for piece in self._pieces])
        size = len(frame) - length
        size_text = _VARINTS[size] if size < 1 << 14 else varint(size)
        body = 1 + len(size_text) + size + len(metadata)
        body_text = _VARINTS[body] if body < 1 << 14 else varint(body)
        return b"".join((b"\x12", body_text, b"\x0a", size_text, frame[length:], metadata))


def metadata_piece(metadata_id: int, value: bytes) -> bytes:
    """One PacketMetadata within a PacketIn."""
    inner = b"\x08" + varint(metadata_id) + b"\x12" + varint(len(value)) + value
    return b"\x12" + varint(len(inner)) + inner


def _piece(field: MetadataField, start: int, bits: int) -> Piece:
    if field.width <= _CACHED_BITS:
        return _cached_piece(field, bits - start - field.width)
    longest = (field.width + 7) // 8
    prefixes = [metadata_piece(field.id, bytes(size))[:-size] for size in range(1, longest + 1)]
    if start % 8 == 0 and field.width % 8 == 0:
        return _whole_bytes_piece(prefixes, start // 8, (start + field.width) // 8)
    shift, mask = bits - start - field.width, (1 << field.width) - 1

    def shifted(_frame: bytes, header: int) -> bytes:
        value = bytestrings.encode(header >> shift & mask)
        return prefixes[len(value) - 1] + value

    return shifted


def _cached_piece(field: MetadataField, shift: int) -> Piece:
    mask = (1 << field.width) - 1
    ready = [metadata_piece(field.id, bytestrings.encode(value)) for value in range(mask + 1)]

    def cached(_frame: bytes, header: int) -> bytes:
        return ready[header >> shift & mask]

    return cached


def _whole_bytes_piece(prefixes: Sequence[bytes], first: int, end: int) -> Piece:
    def whole(frame: bytes, _header: int) -> bytes:
        value = frame[first:end].lstrip(b"\0") or b"\0"
        return prefixes[len(value) - 1] + value

    return whole


class PacketOutDecoder:
    """Makes the frame that enters at the CPU port out of a p4.v1.PacketOut."""

    def __init__(self, fields: Sequence[MetadataField]) -> None:
        self._fields = {field.id: field for field in fields}
        self._shifts: dict[int, int] = {}
        bits = sum(field.width for field in fields)
        self._header_bytes = bits // 8
        for field in fields:
            bits -= field.width
            self._shifts[field.id] = bits

    def decode(self, packet: Any) -> bytes:
        """The packet_out header and the payload behind it.

        Raises InvalidArgument where the metadata is not exactly that of the p4info.
        """
        if len(packet.payload) > MAX_PAYLOAD:
            raise InvalidArgument(
                f"packet-out of {len(packet.payload)} bytes; at most {MAX_PAYLOAD} are sent"
            )
        header, seen = 0, set()
        for metadata in packet.metadata:
            field = self._fields.get(metadata.metadata_id)
            if field is None or field.id in seen:
                problem = "unknown" if field is None else "given twice"
                raise InvalidArgument(f"packet-out metadata {metadata.metadata_id} is {problem}")
            seen.add(field.id)
            try:
                value = bytestrings.decode(metadata.value, field.width, f"packet-out metadata {field.name}")
            except Refused as error:
                raise InvalidArgument(str(error)) from error
            header |= value << self._shifts[field.id]
        absent = [field.name for field in self._fields.values() if field.id not in seen]
        if absent:
            raise InvalidArgument(f"packet-out lacks metadata {', '.join(absent)}")
        return header.to_bytes(self._header_bytes, "big") + bytes(packet.payload)
