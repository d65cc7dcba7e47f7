"""DNS questions and payload patterns by column, against the naive reading of each frame."""

import random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.host.payload import FrameBytes
from sdnator.testing.oracles import payload_measures, sonata
from sdnator.testing.query_traffic import dns, ethernet, tcp, udp

labels = st.text("abcXYZ019-", min_size=1, max_size=63)
names = st.lists(labels, min_size=1, max_size=5).map(".".join)


def columns(frames):
    cut = [frame[:256] for frame in frames]
    return FrameBytes(np.array(cut, dtype="V256"), np.array([len(frame) for frame in cut]))


def tagged(frame):
    return frame[:12] + b"\x81\x00\x00\x05" + frame[12:]


@given(
    st.lists(
        st.tuples(names, st.integers(0, 65535), st.booleans(), st.integers(0, 3)), min_size=1, max_size=8
    )
)
def test_dns_questions(questions):
    """IPv4, IPv6 and tagged; names cut at 256 bytes; equal names in any case have equal hashes."""
    frames = []
    for name, qtype, response, shape in questions:
        source, target = ("2001:db8::1", "2001:db8::2") if shape == 1 else ("10.0.0.1", "10.0.0.2")
        frame = udp(source, target, 53, 999, dns(name, qtype, response=response, extra=9))
        frames.append(tagged(frame) if shape == 2 else frame)
    response, qtype, hashes = columns(frames).dns()
    naive = [sonata.question(sonata.read(0, len(frame), frame).payload) for frame in frames]
    assert response.tolist() == [r for r, _, _ in naive]
    assert qtype.tolist() == [t for _, t, _ in naive]
    for one in range(len(frames)):
        for other in range(one):
            assert (hashes[one] == hashes[other]) == (naive[one][2] == naive[other][2])


messages = st.one_of(
    st.tuples(names, st.integers(0, 65535)).map(lambda one: dns(*one, response=False)),
    st.binary(max_size=230),
    # a header that promises a question, and anything in its place
    st.binary(max_size=230).map(lambda rest: bytes(5) + b"\1" + bytes(6) + rest),
    st.tuples(names, st.integers(0, 60)).map(lambda one: dns(one[0], response=True)[: 12 + one[1]]),
)


@given(st.lists(st.tuples(messages, st.booleans()), min_size=1, max_size=8))
def test_names_are_measured_as_people_write_them(given_messages):
    """Length and entropy of whole, cut and malformed names equal those of a plain reading."""
    frames = [
        udp("2001:db8::1", "2001:db8::2", 53, 9, message)
        if six
        else udp("10.0.0.1", "10.0.0.2", 9, 53, message)
        for message, six in given_messages
    ]
    sizes, entropies = columns(frames).names()
    naive = [payload_measures.name_measures(sonata.read(0, len(frame), frame)) for frame in frames]
    assert list(zip(sizes.tolist(), entropies.tolist(), strict=True)) == naive


@given(st.lists(st.tuples(st.binary(max_size=400), st.integers(0, 3)), min_size=1, max_size=8))
def test_payloads_are_measured(payloads):
    """The length is the headers', also beyond the copied bytes; the entropy is that of the copied bytes."""
    frames = []
    for payload, shape in payloads:
        source, target = ("2001:db8::1", "2001:db8::2") if shape & 1 else ("10.0.0.1", "10.0.0.2")
        made = tcp(source, target, 5, 23, 24, payload) if shape & 2 else udp(source, target, 5, 23, payload)
        frames.append(made)
    wire = np.array([len(frame) for frame in frames])
    sizes, entropies = columns(frames).payloads(wire)
    assert sizes.tolist() == [payload_measures.payload_length(frame) for frame in frames]
    copied = [sonata.read(0, len(frame), frame).payload for frame in frames]
    assert entropies.tolist() == [payload_measures.entropy(data) for data in copied]


def test_padding_is_no_payload_and_a_tag_is_no_reason():
    """A padded ACK has an empty payload; other protocols have none at all."""
    frames = [
        tcp("10.0.0.1", "10.0.0.2", 5, 23, 16) + bytes(6),
        tagged(tcp("10.0.0.1", "10.0.0.2", 5, 23, 24, b"abcd")),
        ethernet("10.0.0.1", "10.0.0.2", 1, b"\x08\x00" + bytes(20)),
    ]
    sizes, entropies = columns(frames).payloads(np.array([60, 62, 60]))
    assert sizes.tolist() == [0, 4, -1]
    assert entropies.tolist() == [0, 2000, -1]


@given(st.lists(st.binary(max_size=120), min_size=1, max_size=8))
def test_garbage_is_read_without_harm(frames):
    """Whatever the bytes, there is an answer."""
    frames = [frame + b"\0" for frame in frames]
    response, qtype, hashes = columns(frames).dns()
    assert len(response) == len(qtype) == len(hashes) == len(frames)
    assert len(columns(frames).payload_contains(b"zorro")) == len(frames)
    wire = np.array([len(frame) for frame in frames])
    for sizes, entropies in (columns(frames).names(), columns(frames).payloads(wire)):
        assert len(sizes) == len(entropies) == len(frames)
        assert (sizes >= -1).all()
        assert ((entropies >= -1) & (entropies <= 8000)).all()


def test_pattern_counts_within_the_payload_only():
    """Not in headers, not in padding, not behind the copied bytes."""
    rng = random.Random(1)
    frames = [
        tcp("10.0.0.1", "10.0.0.2", 5, 23, 24, b"a zorro b"),
        tcp("10.0.0.1", "10.0.0.2", 5, 23, 24, b"zorr"),
        tcp("10.0.0.1", "10.0.0.2", 5, 23, 24) + b"zorro",
        udp("2001:db8::1", "2001:db8::2", 5, 23, b"zorro"),
        tcp("10.0.0.1", "10.0.0.2", 5, 23, 24, bytes(300) + b"zorro"),
        b"zorro" + rng.randbytes(60),
    ]
    assert columns(frames).payload_contains(b"zorro").tolist() == [True, False, False, True, False, False]
