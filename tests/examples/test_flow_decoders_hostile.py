"""Whatever arrives, a decoder returns records or raises its one error, and its work is bounded by the datagram."""

import struct

import pytest
from flow_records.columns import read_flows
from flow_records.decoding.errors import FlowDecodeError
from flow_records.decoding.exporter import MOST_DOMAINS, Exporter
from flow_records.decoding.sflow5 import MOST_SAMPLES
from flow_records.decoding.templated import MOST_SETS
from flow_records.decoding.templates import MOST_FIELDS, MOST_TEMPLATES
from flow_records.packet_rows import packet_groups, single_packets
from hypothesis import given
from hypothesis import strategies as st

from apps.packets import PACKET_COLUMNS, read_columns
from sdnator.testing.query_traffic import tcp
from tests.examples.flow_datagrams import (
    expanded_sample,
    flow_sample,
    flow_set,
    ipfix,
    ipfix_options,
    netflow5,
    netflow9,
    raw_header,
    sflow5,
    structure,
    template,
    v5_record,
    v9_options,
)

LARGEST = 65_507
"""Bytes of the largest UDP datagram over IPv4."""
FRAME = tcp("192.0.2.1", "198.51.100.1", 40_000, 443, 2)
FIELDS = ((8, 4), (12, 4), (7, 2), (11, 2), (4, 1), (6, 1), (2, 4), (1, 4), (22, 4), (21, 4), (48, 1))
GENUINE = (
    netflow5(v5_record(), v5_record("203.0.113.7")),
    netflow9(
        flow_set(0, template(256, *FIELDS)),
        flow_set(1, v9_options(257, [(1, 4)], [(48, 1), (50, 4)])),
        flow_set(257, struct.pack("!IBI", 1, 1, 10)),
        flow_set(256, bytes(range(62))),
    ),
    ipfix(
        flow_set(2, template(256, *FIELDS, (82, 65_535), (100, 4, 29_305))),
        flow_set(3, ipfix_options(257, 1, (302, 4), (305, 4), (306, 4), (160, 8))),
        flow_set(257, struct.pack("!IIIQ", 1, 1, 99, 1_700_000_000_000)),
        flow_set(256, bytes(31) + b"\x05hello" + bytes(4) + bytes(31) + b"\x00" + bytes(4)),
    ),
    sflow5(flow_sample(raw_header(FRAME)), structure(2, bytes(24)), expanded_sample(structure(3, bytes(32)))),
)
ELEMENTS = st.sampled_from(
    [1, 2, 4, 6, 7, 8, 11, 12, 21, 22, 23, 27, 28, 32, 34, 48, 50, 56, 58, 80, 150, 152, 154, 156, 158, 160, 176, 302,
     305, 306, 309, 310]
) | st.integers(0, 65_535)  # fmt: skip
SPECIFIERS = st.lists(
    st.tuples(ELEMENTS, st.sampled_from([1, 2, 3, 4, 8, 16, 65_535]) | st.integers(0, 65_535)), max_size=6
)
SETS = st.lists(
    st.one_of(
        st.builds(lambda fields: flow_set(0, template(256, *fields)), SPECIFIERS),
        st.builds(lambda fields: flow_set(2, template(256, *fields)), SPECIFIERS),
        st.builds(lambda fields: flow_set(1, v9_options(257, fields[:1], fields[1:])), SPECIFIERS),
        st.builds(lambda fields: flow_set(3, ipfix_options(257, 1, *fields)), SPECIFIERS),
        st.builds(flow_set, st.sampled_from([256, 257]), st.binary(max_size=80)),
    ),
    max_size=6,
)
TEMPLATED = st.one_of(
    st.builds(lambda sets: netflow9(*sets), SETS), st.builds(lambda sets: ipfix(*sets), SETS)
)


@st.composite
def mutated(draw):
    """A genuine datagram with some bytes changed, and perhaps cut."""
    datagram = bytearray(draw(st.sampled_from(GENUINE)))
    for place in draw(st.lists(st.integers(0, len(datagram) - 1), max_size=6)):
        datagram[place] = draw(st.sampled_from([0, 1, 255]) | st.integers(0, 255))
    return bytes(datagram[: draw(st.integers(0, len(datagram)))] if draw(st.booleans()) else datagram)


def with_version(content):
    return st.builds(
        lambda version, rest: version + rest,
        st.sampled_from([b"\x00\x05", b"\x00\x09", b"\x00\x0a", b"\x00\x00\x00\x05", b""]),
        content,
    )


def try_all(datagrams):
    """Decode one after the other at one exporter; the records, checked as a reader checks them."""
    exporter = Exporter()
    rows = 0
    for place, datagram in enumerate(datagrams):
        try:
            found = exporter.decode(datagram, 2055, float(place), 1_700_000_000_000_000)
        except FlowDecodeError:
            continue
        for batch in found:
            assert read_flows(batch) == batch
            rows += len(batch)
            packets = single_packets(packet_groups(batch), 1000)
            assert read_columns(packets, PACKET_COLUMNS, "packets") == packets
        assert sum(map(len, found)) <= len(datagram) // 4
    health = exporter.health()
    assert health["templates"] <= MOST_TEMPLATES * MOST_DOMAINS
    assert health["datagrams"] == len(datagrams)
    return rows


@given(st.lists(with_version(st.binary(max_size=200)), max_size=4))
def test_any_bytes(datagrams):
    try_all(datagrams)


@given(st.lists(st.one_of(mutated(), st.sampled_from(GENUINE)), max_size=6))
def test_genuine_datagrams_with_changed_bytes(datagrams):
    try_all(datagrams)


@given(st.lists(TEMPLATED, max_size=4))
def test_any_templates_and_data(datagrams):
    try_all(datagrams)


def test_genuine_datagrams_hold_records():
    """Otherwise the mutations would try little."""
    for datagram in GENUINE:
        assert try_all([datagram]) == 2


def filled(datagram, piece):
    """So many pieces as there is room for."""
    return [piece] * ((LARGEST - len(datagram)) // len(piece))


def largest():
    """The datagrams that cost most: small records, many sets, many templates, many fields, many samples."""
    yield (
        "small records",
        ipfix(flow_set(2, template(256, (8, 4))), flow_set(256, bytes(LARGEST - 100 & ~3), pad=False)),
    )
    every = [(8, 4), *((element, 1) for element in range(50, 49 + MOST_FIELDS))]
    yield "many fields", netflow9(flow_set(0, template(256, *every)), flow_set(256, bytes(60_000)))
    short = [(82, 65_535)] * 8
    yield "variable length", ipfix(flow_set(2, template(256, (8, 4), *short)), flow_set(256, bytes(65_000)))
    sets = [flow_set(256, bytes(4))] * (MOST_SETS - 1)
    yield "many sets", ipfix(flow_set(2, template(256, (8, 4))), *sets)
    yield "empty sets", netflow9(*filled(netflow9(), struct.pack("!HH", 256, 4)))
    templates = b"".join(template(256 + place, (8, 4)) for place in range(8_000))
    yield "many templates", netflow9(flow_set(0, templates))
    again = b"".join(template(256, (8, 4)) for _ in range(8_000))
    yield "one template again and again", ipfix(flow_set(2, again))
    yield (
        "a sampler a record",
        netflow9(
            flow_set(1, v9_options(257, [(1, 1)], [(48, 2), (34, 1)])),
            flow_set(257, b"".join(struct.pack("!BHB", 1, place, 2) for place in range(16_000))),
        ),
    )
    yield "many samples", sflow5(*filled(sflow5(), flow_sample(raw_header(FRAME[:16])))[:MOST_SAMPLES])
    yield "too many samples", sflow5(*[structure(2, b"")] * 8_000)
    yield "many records of a sample", sflow5(flow_sample(*[structure(9, b"")] * MOST_SAMPLES))


@pytest.mark.parametrize(("datagram"), [each for _, each in largest()], ids=[name for name, _ in largest()])
def test_the_work_of_the_largest_datagrams_is_bounded(datagram):
    """Each is decoded, or refused, with at most a record for four of its bytes."""
    assert len(datagram) <= LARGEST + 100
    try_all([datagram, datagram])
