"""An outlet numbers items without a gap, cuts frames by bytes and mode, and sends big values alone."""

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


def _outlet(frame_bytes=1000, single_bytes=300):
    sent = []
    dirty: list[KeyWriter] = []
    outlet = KeyWriter(
        Key("a.b"),
        "app",
        "inst",
        frame_bytes=frame_bytes,
        single_bytes=single_bytes,
        sink=lambda _outlet, parts, mode: sent.extend((decode_frame(part), mode) for _, part in parts),
        dirty=dirty.append,
    )
    return outlet, sent, dirty


values = st.one_of(
    st.binary(max_size=500), st.integers(-(2**63), 2**64 - 1), st.text("aä", max_size=50), st.none()
)
writes = st.lists(
    st.tuples(values, st.sampled_from([BOTH, PUBLISH, ARCHIVE]), st.none() | st.integers(0, 99)), max_size=60
)


@given(writes)
def test_everything_comes_out_once_in_order_and_numbered(writes):
    outlet, sent, _ = _outlet()
    for now, (value, mode, event_time) in enumerate(writes):
        outlet.put(value, mode, event_time, now)
    outlet.cut()
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
    outlet, sent, dirty = _outlet(frame_bytes=1000)
    for now in range(30):
        outlet.put(b"x" * 88, BOTH, None, now)
    assert [len(frame.values) for frame, _ in sent] == [10, 10, 10]
    assert len(dirty) == 3


def test_big_values_go_alone_and_at_once():
    outlet, sent, _ = _outlet()
    batch = RecordBatch({"a": np.arange(3)})
    for n, value in enumerate((b"small", b"x" * 300, batch, np.zeros(100))):
        outlet.put(value, BOTH, None, n * SECOND)
    assert [len(frame.values) for frame, _ in sent] == [1, 1, 1, 1]
    assert sent[2][0].values[0] == batch


def test_big_values_that_follow_each_other_closely_go_together():
    """The first at once, the next when they fill a frame or somebody cuts; each has a frame of its own."""
    outlet, _, dirty = _outlet(frame_bytes=900)
    handed = []
    outlet._sink = lambda _outlet, parts, _mode: handed.append(len(parts))
    for n in range(6):
        outlet.put(b"x" * 300, BOTH, None, n)
    assert handed == [1, 3]
    assert not outlet.idle
    assert len(dirty) == 2
    outlet.put(b"small", BOTH, None, 7)
    outlet.cut()
    assert handed == [1, 3, 2, 1]


def test_big_values_do_not_wait_for_others_where_it_would_save_nothing():
    outlet, sent, _ = _outlet(frame_bytes=1000)
    outlet.reliable = True
    outlet.put(b"x" * 300, BOTH, None, 0)
    outlet.put(b"x" * 300, BOTH, None, 1)
    assert len(sent) == 2, "each entry of a stream is sent by itself"
    outlet.reliable = False
    outlet.put(b"x" * 300, BOTH, None, 2, stays=False)
    assert len(sent) == 3, "the writer does not want to wait"


def test_a_changed_value_does_not_change_what_was_written():
    outlet, sent, _ = _outlet()
    value = {"a": [1]}
    outlet.put(value, BOTH, None, 1)
    value["a"].append(2)
    outlet.cut()
    assert sent[0][0].values == [{"a": [1]}]


def test_a_refused_value_takes_no_number():
    outlet, sent, _ = _outlet()
    for wrong in ({1, 2}, np.array([object()] * 100), RecordBatch({"a": np.array([object()])})):
        with pytest.raises(UnsupportedValue):
            outlet.put(wrong, BOTH, None, 1)
    outlet.put(1, BOTH, None, 1)
    outlet.cut()
    assert (sent[0][0].sequence, sent[0][0].before) == (1, 0)
