"""Streams of one switch become one, in the order of arrival, each packet once."""

import tracemalloc

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.sonata_adapter.host.merge import LONGEST_WAIT_S, SHORTEST_WAIT_S, Merger, patience
from due import RecordBatch


def batch(arrivals):
    numbers = np.array(arrivals, dtype=np.uint64)
    return RecordBatch({"arrival": numbers, "time_us": numbers.astype(np.int64) * 1000})


def numbers(released):
    return [] if released is None else released["arrival"].tolist()


@given(
    st.dictionaries(st.sampled_from("abc"), st.sets(st.integers(0, 60), min_size=1), min_size=1),
    st.integers(1, 9),
    st.randoms(use_true_random=False),
)
def test_interleaved_streams_come_out_sorted_and_once(streams, size, rng):
    """However the streams are cut and interleaved."""
    parts = {
        name: [sorted(found)[at : at + size] for at in range(0, len(found), size)]
        for name, found in streams.items()
    }
    merger = Merger()
    merger.expect(set(streams))
    out = []
    while any(parts.values()):
        name = rng.choice([name for name, rest in parts.items() if rest])
        out += numbers(merger.put(name, batch(parts[name].pop(0)), 0.0))
    out += numbers(merger.flush())
    assert out == sorted(set().union(*streams.values()))
    assert merger.disordered == 0


def test_one_stream_is_not_held():
    """What is alone goes on at once."""
    merger = Merger()
    merger.expect({"a"})
    assert numbers(merger.put("a", batch([1, 2]), 5.0)) == [1, 2]


def test_a_clock_that_is_set_back_is_followed():
    """What waits is released; after that, time has come as far as the streams say from then on."""
    merger = Merger()
    merger.expect({"a", "b"})
    assert not numbers(merger.put("a", batch([5000]), 5.0))
    assert numbers(merger.set_back()) == [5000]
    assert merger.horizon_us(5.2) is None
    later = RecordBatch({**batch([5001]), "time_us": np.array([7])})
    merger.put("a", later, 5.3)
    assert merger.horizon_us(5.5) == 7


def test_silence_lets_go():
    """When nothing comes any more, nothing is waited for."""
    merger = Merger()
    merger.expect({"a", "b"})
    assert not numbers(merger.put("a", batch([1, 2]), 5.0))
    assert not numbers(merger.release(5.05))
    merger.busy(5.06)
    assert not numbers(merger.release(5.12))
    assert numbers(merger.release(5.2)) == [1, 2]
    assert merger.horizon_us(5.2) == 2000


def test_a_silent_stream_holds_up_the_others_for_a_moment_only():
    """It is waited for until the others have brought much, and a while has passed."""
    merger = Merger()
    merger.expect({"a", "b"})
    out, now = [], 0.0
    for number in range(200):
        now += LONGEST_WAIT_S / 50
        out += numbers(merger.put("a", batch([number]), now))
    assert out == list(range(200))
    assert merger.horizon_us(now) == 199_000


def test_packets_behind_are_passed_on_once():
    """What comes after later ones were let go is still passed on, and counted."""
    merger = Merger()
    merger.expect({"a", "b"})
    merger.put("a", batch([5, 6]), 0.0)
    assert numbers(merger.release(1.0)) == [5, 6]
    assert numbers(merger.put("b", batch([4, 5]), 1.0)) == [4]
    assert merger.disordered == 1
    assert merger.twice == 1


def test_short_windows_do_not_wait_long():
    """What silent streams may hold up is a part of the shortest window."""
    assert patience(None) == patience(60_000_000) == LONGEST_WAIT_S
    assert patience(200_000) == 0.05
    assert patience(100_000) == SHORTEST_WAIT_S
    merger = Merger()
    merger.expect({"a", "b"})
    merger.hurry(patience(200_000))
    out, now = [], 0.0
    for number in range(20):
        now += 0.01
        out += numbers(merger.put("a", batch([number]), now))
    assert out == list(range(20))
    assert merger.horizon_us(now) == 19_000


def test_a_merger_without_packets_takes_next_to_no_memory():
    """Each switch has one for frames, which few queries want."""
    tracemalloc.start()
    try:
        merger = Merger()
        merger.expect({"a"})
        assert tracemalloc.get_traced_memory()[0] < 100_000
        assert numbers(merger.put("a", batch([1, 2]), 0.0)) == [1, 2]
        assert numbers(merger.put("a", batch([2, 3]), 0.0)) == [3]
    finally:
        tracemalloc.stop()
