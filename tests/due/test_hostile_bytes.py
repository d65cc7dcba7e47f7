"""Whatever the bytes, a decoder returns a value or raises `DecodeError`; what writers make, readers take."""

import struct
from contextlib import suppress

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.hostile_due import KILLER, TARGETS
from due import arrays, codec
from due.codec import (
    MAX_DEPTH,
    MAX_EPOCH,
    MAX_ITEMS,
    MAX_NUMBER,
    Frame,
    checked_time,
    decode_frame,
    decode_value,
    encode_frame,
    encode_single,
    encode_value,
)
from due.errors import DecodeError, UnsupportedValue
from due.messages import RecordBatch

ARRAY, BATCH = 3, 4
SEEDS = tuple(dict.fromkeys(seed for target in TARGETS for seed in target.seeds))


def _frame(values=(1,), **fields):
    standard = {"epoch": 1, "sequence": 1, "before": 0, "event_times": None}
    return Frame(
        "a.b", "app", "i", timestamps=[5] * len(values), values=list(values), **{**standard, **fields}
    )


def _single(value):
    return encode_single(Frame("a.b", "app", "i", 1, 1, 0, [5], None, []), value)


def _only_decode_errors(payload):
    for target in TARGETS:
        with suppress(*target.errors):
            target.decode(payload)


def test_the_frame_that_ended_the_dispatcher_is_refused():
    with pytest.raises(DecodeError):
        decode_frame(KILLER)


@given(
    st.sampled_from(SEEDS),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 7)), min_size=1, max_size=6),
)
def test_flipped_bits(payload, flips):
    damaged = bytearray(payload)
    for at, bit in flips:
        damaged[at % len(damaged)] ^= 1 << bit
    _only_decode_errors(bytes(damaged))


@given(st.sampled_from(SEEDS), st.sampled_from(SEEDS), st.integers(0, 2000), st.integers(0, 2000))
def test_cut_and_spliced_frames(one, other, end, begin):
    _only_decode_errors(one[: end % len(one)] + other[begin % len(other) :])


plain = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=4)
wild = st.recursive(
    plain
    | st.binary(max_size=9)
    | st.builds(msgspec.msgpack.Ext, st.integers(-128, 127), st.binary(max_size=24)),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=3) | st.integers(0, 9), inner, max_size=3)
    ),
    max_leaves=12,
)


@given(st.lists(wild, max_size=12))
def test_any_msgpack_in_place_of_a_frame(fields):
    _only_decode_errors(codec.MAGIC + b"\x01" + msgspec.msgpack.encode(fields))


DTYPES = (
    "<i8",
    "|b1",
    "<M8[ns]",
    "<U2",
    "|O",
    "<i8,<f4",
    "i8, (",
    "{'names':['a']}",
    "|V0",
    "|S99999999",
    "",
    "\x00",
)
heads = st.recursive(
    plain | st.sampled_from(DTYPES),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=10,
)


def _extension(code, head, data=b"", padding=0):
    text = msgspec.msgpack.encode(head)
    return msgspec.msgpack.encode(
        msgspec.msgpack.Ext(code, struct.pack("<IB", len(text), padding) + text + bytes(padding) + data)
    )


@given(
    st.sampled_from((ARRAY, BATCH)),
    st.tuples(heads, heads) | heads,
    st.binary(max_size=40),
    st.integers(0, 255),
)
def test_any_head_of_an_array(code, head, data, padding):
    with suppress(DecodeError):
        decode_value(_extension(code, head, data, padding))


def _nested_fields(levels):
    return "<i8" if not levels else [["a", _nested_fields(levels - 1)]]


@pytest.mark.parametrize(
    ("code", "head"),
    [
        (ARRAY, ["|O", [1]]),
        (ARRAY, ["<i8,<i8", [1]]),
        (ARRAY, ["<i8", [-1]]),
        (ARRAY, ["<i8", [2**62, 4]]),
        (ARRAY, ["<i8", [0, 2**62]]),
        (ARRAY, ["<i8", [2**31] * 40]),
        (ARRAY, ["|S9999999", [0]]),
        (ARRAY, [_nested_fields(arrays.MAX_NESTING + 1), [1]]),
        (ARRAY, [[[f"f{n}", "|u1"] for n in range(arrays.MAX_FIELDS + 1)], [0]]),
        (ARRAY, [[["a", "|u1"], ["a", "|u1"]], [1]]),
        (ARRAY, [[["a", "|u1", [-1]]], [1]]),
        (ARRAY, [[["a", "|u1", [2**40]]], [0]]),
        (BATCH, [2, []]),
        (BATCH, [-1, [["a", "<i8"]]]),
        (BATCH, [10**9, [["a", "<i8"]]]),
        (BATCH, [1, [["a", "|u1"], ["a", "|u1"]]]),
        (BATCH, [1, [[7, "|u1"]]]),
        (BATCH, [0, [[f"c{n}", "|u1"] for n in range(arrays.MAX_COLUMNS + 1)]]),
    ],
)
def test_heads_out_of_range(code, head):
    with pytest.raises(DecodeError):
        decode_value(_extension(code, head, bytes(64)))


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a", b"\xdd\x00\x00\x00\x01"])
def test_endless_nesting(opening):
    _only_decode_errors(codec.MAGIC + b"\x01" + opening * 200_000)
    with pytest.raises(DecodeError):
        decode_value(opening * 200_000 + b"\xc0")


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a"])
def test_readers_nest_no_deeper_than_writers(opening):
    """What is decoded near the end of the stack would exceed it in whatever walks through it later."""
    assert decode_value(opening * MAX_DEPTH + b"\xc0")
    with pytest.raises(DecodeError, match=f"over {MAX_DEPTH} levels"):
        decode_value(opening * (MAX_DEPTH + 1) + b"\xc0")
    for levels in (MAX_DEPTH, MAX_DEPTH + 1):
        frame = _frame([1, msgspec.Raw(opening * levels + b"\xc0")])
        if levels == MAX_DEPTH:
            assert decode_frame(encode_frame(frame)).values[0] == 1
        else:
            with pytest.raises(DecodeError, match=f"over {MAX_DEPTH} levels"):
                decode_frame(encode_frame(frame))


@pytest.mark.parametrize(
    "fields",
    [
        {"epoch": -1},
        {"epoch": MAX_EPOCH + 1},
        {"epoch": 2**62},
        {"sequence": -1},
        {"sequence": MAX_NUMBER},
        {"before": -1},
        {"before": 2**63},
        {"event_times": [2**63]},
        {"event_times": [1, 2]},
        {"values": []},
        {"values": [1] * (MAX_ITEMS + 1)},
        {"timestamps": [2**63]},
        {"key": "a" * 2000},
        {"app_id": "a" * 65},
        {"instance_id": "a" * 65},
    ],
    ids=lambda fields: next(iter(fields)),
)
def test_numbers_and_names_out_of_range(fields):
    frame = msgspec.structs.replace(_frame(), **fields)
    if "values" in fields:
        frame.timestamps = [5] * len(fields["values"])
    with pytest.raises(DecodeError):
        decode_frame(encode_frame(frame))


def test_too_much_is_refused_on_both_sides(monkeypatch):
    payload = encode_frame(_frame([b"x" * 3000]))
    monkeypatch.setattr(codec, "MAX_PAYLOAD", 2000)
    for decode in (decode_frame, decode_value):
        with pytest.raises(DecodeError, match="2000"):
            decode(payload)
    with pytest.raises(UnsupportedValue, match="in parts"):
        encode_frame(_frame([b"x" * 3000]))
    with pytest.raises(UnsupportedValue, match="in parts"):
        _single(b"x" * 3000)


def _deep(levels):
    return [] if levels == 1 else [_deep(levels - 1)]


@pytest.mark.parametrize(
    "value",
    [
        _deep(MAX_DEPTH + 2),
        np.zeros(1, [(f"f{n}", "u1") for n in range(arrays.MAX_FIELDS + 1)]),
        RecordBatch({"c" * (arrays.MAX_NAME + 1): np.zeros(1)}),
        np.zeros((0, 2**50), "u1"),
        np.array([1, object()]),
    ],
    ids=["nesting", "fields", "column name", "shape", "objects"],
)
def test_writers_are_refused_what_readers_would_refuse(value):
    with pytest.raises(UnsupportedValue):
        encode_value(value)


def test_what_is_just_allowed_travels():
    deep = _deep(MAX_DEPTH)
    assert decode_value(encode_value(deep)) == deep
    aligned = np.zeros(2, np.dtype([("a", "u1"), ("b", "<i4")], align=True))
    back = decode_value(encode_value(aligned))
    assert back.dtype.itemsize == aligned.dtype.itemsize
    np.testing.assert_array_equal(back["b"], aligned["b"])


@pytest.mark.parametrize("time", [2**63, -(2**63) - 1, 1.5, "now", None])
def test_event_times_that_cannot_travel(time):
    with pytest.raises(UnsupportedValue):
        checked_time(time)
