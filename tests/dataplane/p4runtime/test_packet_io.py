"""Packet-ins written byte by byte are what protobuf would write; packet-outs need exact metadata."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataplane.compiler.samples import varint
from dataplane.p4runtime.bytestrings import encode
from dataplane.p4runtime.packet_io import PacketInEncoder, PacketOutDecoder
from dataplane.p4runtime.schema import MetadataField
from dataplane.p4runtime.status import InvalidArgument
from p4rt import p4runtime

# the product's own packet_in header, and one with fields across byte borders
PRODUCT = [9, 7, 48, 32, 32, 32, 256]
CROOKED = [3, 13, 20, 1, 11]


def fields(widths):
    return [MetadataField(10 + n, f"f{n}", width) for n, width in enumerate(widths)]


def naive(widths, values, payload):
    message = p4runtime.StreamMessageResponse()
    message.packet.payload = payload
    for n, value in enumerate(values):
        message.packet.metadata.add(metadata_id=10 + n, value=encode(value))
    return message


def header(widths, values):
    number = 0
    for width, value in zip(widths, values, strict=True):
        number = number << width | value
    return number.to_bytes(sum(widths) // 8, "big")


def values_of(widths):
    return st.tuples(*(st.one_of(st.just(0), st.integers(0, (1 << width) - 1)) for width in widths))


@pytest.mark.parametrize("widths", [PRODUCT, CROOKED], ids=["product", "crooked"])
@given(data=st.data())
def test_encoder_equals_protobuf(widths, data):
    values, payload = data.draw(values_of(widths)), data.draw(st.binary(max_size=400))
    encoded = PacketInEncoder(fields(widths)).encode(header(widths, values) + payload)
    assert p4runtime.StreamMessageResponse.FromString(encoded) == naive(widths, values, payload)


def test_large_payloads_have_long_lengths():
    payload = bytes(20_000)
    encoded = PacketInEncoder(fields([8])).encode(b"\x05" + payload)
    assert p4runtime.StreamMessageResponse.FromString(encoded) == naive([8], [5], payload)


def test_a_program_without_header_sends_bare_frames():
    assert (
        p4runtime.StreamMessageResponse.FromString(PacketInEncoder([]).encode(b"abc")).packet.payload
        == b"abc"
    )


def test_a_frame_shorter_than_its_header_is_refused():
    with pytest.raises(InvalidArgument, match="shorter"):
        PacketInEncoder(fields(PRODUCT)).encode(bytes(51))


@given(st.data())
def test_packet_out_is_the_header_in_front(data):
    widths = CROOKED
    values, payload = data.draw(values_of(widths)), data.draw(st.binary(max_size=50))
    packet = naive(widths, values, payload).packet
    assert PacketOutDecoder(fields(widths)).decode(packet) == header(widths, values) + payload


@pytest.mark.parametrize(
    ("metadata", "text"),
    [
        ([(10, b"\x01")], "lacks metadata f1"),
        ([(10, b"\x01"), (11, b"\x01"), (99, b"\x01")], "99 is unknown"),
        ([(10, b"\x01"), (10, b"\x01")], "given twice"),
        ([(10, b"\x02\x00"), (11, b"\x00")], "f0"),
        ([(10, b""), (11, b"\x00")], "empty"),
    ],
)
def test_wrong_metadata_is_refused(metadata, text):
    packet = p4runtime.PacketOut(payload=b"x")
    for number, value in metadata:
        packet.metadata.add(metadata_id=number, value=value)
    with pytest.raises(InvalidArgument, match=text):
        PacketOutDecoder(fields([9, 7])).decode(packet)


@pytest.mark.parametrize(
    ("value", "expected"), [(0, b"\0"), (127, b"\x7f"), (300, b"\xac\x02"), (1 << 20, b"\x80\x80\x40")]
)
def test_varint(value, expected):
    assert varint(value) == expected
