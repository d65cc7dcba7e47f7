"""Digest lists read by the C library are what protobuf reads; damaged ones are counted, never read beyond their end."""

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.p4runtime_ctrl.southbound import digest_rows
from apps.p4runtime_ctrl.southbound.digest_rows import (
    ReceivedDigests,
    load_digest_rows,
    read_lists,
    sound_rows,
)
from apps.p4runtime_ctrl.southbound.rows import RowLayout
from p4rt import p4runtime

LAYOUT = RowLayout([("timestamp", 48), ("port", 9), ("address", 128), ("map", 256)])
members = st.lists(st.one_of(st.binary(max_size=6), st.binary(max_size=40)), max_size=5)
samples = st.lists(st.one_of(members, st.tuples(*[st.binary(max_size=2)] * 4)), max_size=8)


def digest_list(rows):
    found = p4runtime.DigestList(digest_id=7, list_id=2**64 - 1, timestamp=9)
    for row in rows:
        data = found.data.add().struct
        for value in row:
            data.members.add(bitstring=value)
    return found


def received(digests):
    return ReceivedDigests.of(p4runtime.StreamMessageResponse(digest=digests).SerializeToString())


def by_protobuf(digests, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(digest_rows, "load_digest_rows", lambda: None)
        return sound_rows(LAYOUT, digests)


@pytest.fixture(autouse=True)
def _library():
    assert load_digest_rows() is not None, "build it: python setup.py build_ext --inplace"


@settings(max_examples=200)
@given(samples)
def test_rows_are_those_of_protobuf(rows):
    """Any members: the same rows, and as many left out."""
    found, malformed = sound_rows(LAYOUT, received(digest_list(rows)))
    with pytest.MonkeyPatch.context() as patch:
        expected, left_out = by_protobuf(digest_list(rows), patch)
    assert (found.tobytes(), malformed) == (expected.tobytes(), left_out)


@settings(max_examples=300)
@given(samples, st.data())
def test_damaged_lists_give_rows_or_none(rows, data):
    """Whatever the bytes, no row is made of what protobuf would refuse to see in its place."""
    body = bytearray(digest_list(rows).SerializeToString())
    for _ in range(data.draw(st.integers(0, 3))):
        if body:
            body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(body[: data.draw(st.integers(0, len(body)))])
    found, malformed = sound_rows(LAYOUT, ReceivedDigests(7, 1, cut, len(cut)))
    assert malformed >= 0
    try:
        parsed = p4runtime.DigestList.FromString(cut)
    except DecodeError:
        return
    assert len(found) + malformed == len(parsed.data)


def test_numbers_of_a_list_are_read_without_its_samples():
    found = received(digest_list([[b"\1", b"\2", b"\3", b"\4"]]))
    assert (found.digest_id, found.list_id, len(found.data)) == (7, 2**64 - 1, 1)
    assert found.SerializeToString() == digest_list([[b"\1", b"\2", b"\3", b"\4"]]).SerializeToString()


@settings(max_examples=200)
@given(st.binary(max_size=40))
def test_other_bytes_are_no_list_or_one_as_long_as_they_say(data):
    for message in (data, b"\x1a" + data):
        found = ReceivedDigests.of(message)
        assert found is None or len(found.SerializeToString()) <= len(message) - 2


def test_times_that_no_clock_shows_are_left_out():
    late = [b"\1", b"", b"", b""], [b"\1" + bytes(6), b"", b"", b""], [b"\1" + bytes(5), b"", b"", b""]
    found, malformed = read_lists(LAYOUT, [digest_list(late), digest_list(late[:1])])
    assert (len(found), malformed) == (3, 1)
    assert found["timestamp"].astype(np.int64).tolist() == [1, 1 << 40, 1]


def test_rows_of_several_lists_are_laid_out_as_those_of_one():
    alone = digest_list([[b"\1", b"\2", b"\3", b"\4"]])
    found, malformed = read_lists(LAYOUT, [alone, alone, digest_list([])])
    assert (found.dtype, malformed) == (LAYOUT.dtype, 0)
    assert found.tobytes() == 2 * sound_rows(LAYOUT, alone)[0].tobytes()
    assert read_lists(LAYOUT, [])[0].dtype == LAYOUT.dtype
