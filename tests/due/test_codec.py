"""What goes in comes out with its type; damaged and foreign bytes are told apart; nothing is copied on the way in."""

import datetime as dt
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due.codec import (
    MAGIC,
    VERSION,
    Frame,
    decode_frame,
    decode_value,
    encode_frame,
    encode_single,
    encode_value,
    freeze,
    pack,
    unpack,
)
from due.errors import DecodeError, NewerVersion, UnsupportedValue
from due.messages import Item, RecordBatch

plain = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(allow_nan=False),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.binary(max_size=50),
    st.datetimes(),
    st.datetimes(timezones=st.just(dt.UTC)),
)
nested = st.recursive(
    plain, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("ab"), inner, max_size=3)
)


def _head() -> Frame:
    return Frame("a.b", "app", "i", 1, 1, 0, [5], None, [])


@given(nested)
def test_values_come_back_equal_and_of_the_same_type(value):
    back = decode_value(encode_value(value))
    assert back == value
    assert type(back) is type(value)
    assert decode_frame(encode_single(_head(), value)).values == [value]
    frozen = Frame("a.b", "app", "i", 1, 1, 0, [5], None, [freeze(value)])
    assert decode_frame(encode_frame(frozen)).values == [value]


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12, dtype=">i4").reshape(3, 4)[:, ::2],
        np.array([1.5, np.nan]),
        np.zeros(0),
        np.array(7),
        np.array(["ab", "c"]),
        np.array([b"x", b"yz"]),
        np.array(["2026-01-01"], "datetime64[ns]"),
        np.zeros(3, [("port", "u2"), ("at", "<f8", (2,))]),
        np.array([True, False]),
    ],
    ids=lambda a: f"{a.dtype}{a.shape}",
)
def test_arrays_keep_dtype_shape_and_content(array):
    for value in (array, [array], {"a": array}):
        back = decode_value(encode_value(value))
        back = back if value is array else back[0] if isinstance(back, list) else back["a"]
        assert back.dtype == array.dtype
        assert back.shape == array.shape
        np.testing.assert_array_equal(back, array)


def test_a_record_batch_is_a_view_of_the_payload():
    batch = RecordBatch(
        {"time_us": np.arange(1000), "port": np.arange(1000, dtype="u2"), "flag": np.ones(1000, "?")}
    )
    payload = encode_single(_head(), batch)
    back = decode_frame(payload).values[0]
    assert back == batch
    whole = np.frombuffer(payload, np.uint8)
    assert all(np.shares_memory(back[name], whole) for name in batch)
    assert all(back[name].flags.aligned and not back[name].flags.writeable for name in batch)


def test_scalars_of_numpy():
    assert decode_value(encode_value(np.float32(1.5))) == 1.5
    back = decode_value(encode_value([np.datetime64(5, "ns"), np.int8(-3), np.bool_(True)]))
    assert back == [np.datetime64(5, "ns"), -3, True]
    assert isinstance(back[0], np.datetime64)


@pytest.mark.parametrize(
    "value", [{1, 2}, {1: 2}, 2**64, object(), dt.date(2026, 1, 1), np.array([object()]), "\ud800", [1 + 2j]]
)
def test_what_cannot_travel_is_refused_at_once(value):
    with pytest.raises(UnsupportedValue):
        freeze(value)


def test_a_list_that_contains_itself_is_refused():
    endless: list[object] = []
    endless.append(endless)
    with pytest.raises(UnsupportedValue):
        encode_value(endless)


@given(st.binary(max_size=80))
def test_garbage_is_never_a_crash(data):
    for payload in (data, MAGIC + bytes([VERSION]) + data):
        with suppress(DecodeError):
            decode_frame(payload)
    with suppress(DecodeError):
        decode_value(data)


@given(st.data())
def test_damaged_frames_are_never_a_crash(data):
    payload = bytearray(encode_single(_head(), RecordBatch({"a": np.arange(20), "b": np.zeros(20, "S3")})))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(4, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(DecodeError):
        decode_frame(bytes(payload))


def test_a_newer_version_is_told_apart():
    payload = encode_frame(_head())
    with pytest.raises(NewerVersion):
        decode_frame(MAGIC + bytes([VERSION + 1]) + payload[4:])


def test_items_survive_packing():
    items = [Item("a.b", {"n": n}, 10 + n, 5 - n, "app", "inst", 7 + n) for n in range(3)]
    frame = pack(items)
    assert unpack(frame) == items
    assert (frame.sequence, frame.count) == (7, 3)
    assert (frame.first_timestamp, frame.last_timestamp) == (10, 12)
    assert (frame.first_event_time, frame.last_event_time) == (3, 5)


def test_frames_do_not_share_memory_whatever_was_encoded_before():
    def frame(values):
        return Frame("a.b", "app", "inst", 0, 1, 0, list(range(len(values))), None, values)

    kinds = [[b"x" * 5000] * 3, [1], [2**64], [b""], [b"y" * 300_000], ["z"]]
    payloads = []
    for values in kinds:
        with suppress(UnsupportedValue):
            payloads.append((values, encode_frame(frame(values))))
    assert len(payloads) == 5, "one does not fit into 64 bits"
    assert all(decode_frame(payload).values == values for values, payload in payloads)


def test_items_are_the_same_one_by_one_and_together():
    for events in (None, [5, 6, 7]):
        frame = Frame("a.b", "app", "inst", 0, 4, 3, [1, 2, 3], events, ["x", "y", "z"])
        assert list(frame.stream()) == frame.items()
        assert [item.sequence for item in frame.stream()] == [4, 5, 6]
        assert [item.event_time for item in frame.stream()] == (events or [1, 2, 3])
