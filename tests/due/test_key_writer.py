"""A key writer numbers items without a gap, cuts frames by bytes and mode, and sends big values alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from due import RecordBatch
from due.codec import decode_frame
from due.errors import UnsupportedValue
from due.key_writer import ARCHIVE, BOTH, PUBLISH, KeyWriter
from due.keys import Key

SECOND = 10**9


def _writer(frame_bytes=1000, single_bytes=300):
    sent = []
    dirty: list[KeyWriter] = []
    writer = KeyWriter(
        Key("a.b"),
        "app",
        "inst",
        frame_bytes=frame_bytes,
        single_bytes=single_bytes,
        sink=lambda _writer, parts, mode: sent.extend((decode_frame(part), mode) for _, part in parts),
        dirty=dirty.append,
    )
    return writer, sent, dirty


values = st.one_of(
    st.binary(max_size=500), st.integers(-(2**63), 2**64 - 1), st.text("aä", max_size=50), st.none()
)
writes = st.lists(
    st.tuples(values, st.sampled_from([BOTH, PUBLISH, ARCHIVE]), st.none() | st.integers(0, 99)), max_size=60
)


@given(writes)
def test_everything_comes_out_once_in_order_and_numbered(writes):
    writer, sent, _ = _writer()
    for now, (value, mode, event_time) in enumerate(writes):
        writer.put(value, mode, event_time, now)
    writer.cut()
    items = [(item, mode) for frame, mode in sent for item in frame.items()]
    assert [(i.value, mode) for i, mode in items] == [(value, mode) for value, mode, _ in writes]
    assert [i.sequence for i, _ in items] == list(range(1, len(writes) + 1))
    assert [i.timestamp for i, _ in items] == list(range(len(writes)))
    assert [i.event_time for i, _ in items] == [
        now if event_time is None else event_time for now, (_, _, event_time) in enumerate(writes)
    ]
    published = 0
    for frame, mode in sent:
        if mode & PUBLISH:
            assert frame.before == published
            published += len(frame.values)


def test_a_frame_is_cut_by_its_bytes():
    writer, sent, dirty = _writer(frame_bytes=1000)
    for now in range(30):
        writer.put(b"x" * 88, BOTH, None, now)
    assert [len(frame.values) for frame, _ in sent] == [10, 10, 10]
    assert len(dirty) == 3


def test_big_values_go_alone_and_at_once():
    writer, sent, _ = _writer()
    batch = RecordBatch({"a": np.arange(3)})
    for n, value in enumerate((b"small", b"x" * 300, batch, np.zeros(100))):
        writer.put(value, BOTH, None, n * SECOND)
    assert [len(frame.values) for frame, _ in sent] == [1, 1, 1, 1]
    assert sent[2][0].values[0] == batch


def test_big_values_that_follow_each_other_closely_go_together():
    """The first at once, the next when they fill a frame or somebody cuts; each has a frame of its own."""
    writer, _, dirty = _writer(frame_bytes=900)
    handed = []
    writer._sink = lambda _writer, parts, _mode: handed.append(len(parts))
    for n in range(6):
        writer.put(b"x" * 300, BOTH, None, n)
    assert handed == [1, 3]
    assert not writer.idle
    assert len(dirty) == 2
    writer.put(b"small", BOTH, None, 7)
    writer.cut()
    assert handed == [1, 3, 2, 1]


def test_big_values_do_not_wait_for_others_where_it_would_save_nothing():
    writer, sent, _ = _writer(frame_bytes=1000)
    writer.reliable = True
    writer.put(b"x" * 300, BOTH, None, 0)
    writer.put(b"x" * 300, BOTH, None, 1)
    assert len(sent) == 2, "each entry of a stream is sent by itself"
    writer.reliable = False
    writer.put(b"x" * 300, BOTH, None, 2, stays=False)
    assert len(sent) == 3, "the writer does not want to wait"


def test_a_changed_value_does_not_change_what_was_written():
    writer, sent, _ = _writer()
    value = {"a": [1]}
    writer.put(value, BOTH, None, 1)
    value["a"].append(2)
    writer.cut()
    assert sent[0][0].values == [{"a": [1]}]


def test_a_refused_value_takes_no_number():
    writer, sent, _ = _writer()
    for wrong in ({1, 2}, np.array([object()] * 100), RecordBatch({"a": np.array([object()])})):
        with pytest.raises(UnsupportedValue):
            writer.put(wrong, BOTH, None, 1)
    writer.put(1, BOTH, None, 1)
    writer.cut()
    assert (sent[0][0].sequence, sent[0][0].before) == (1, 0)
