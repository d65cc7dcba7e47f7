"""However two streams of one switch interleave, every frame is told once, in order, a copy before a digest."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from apps.p4runtime_ctrl.southbound.sequence_merge import PacketRows, SequenceMerger

BIT = 255
WRAP = 1 << 32


def rows(numbers, whole=True, mark=0):
    numbers = np.asarray(list(numbers), dtype=np.uint64)
    queries = np.zeros((len(numbers), 32), dtype=np.uint8)
    queries[:, 0] = 0x80
    columns = {"sequence": numbers, "mark": np.full(len(numbers), mark)}
    return PacketRows(columns, queries, np.broadcast_to(np.asarray(whole, dtype=np.bool_), numbers.shape))


def told(found):
    return [int(number) for each in found for number in each.matching(BIT)["sequence"]]


def test_covered_digests_wait_for_nothing():
    merger = SequenceMerger()
    assert told(merger.digests(rows(range(1, 6)))) == [1, 2, 3, 4, 5]
    assert (len(merger), merger.waits_for) == (0, 0)


def test_a_frame_that_came_as_a_copy_only_takes_its_place():
    merger = SequenceMerger()
    assert told(merger.digests(rows([1, 2, 3, 5, 6]))) == [1, 2, 3]
    assert merger.waits_for == 4
    assert told(merger.packets(rows([4]))) == [4, 5, 6]
    assert merger.copies == 1


def test_a_copy_stands_for_a_digest_that_does_not_say_all():
    merger = SequenceMerger()
    assert told(merger.digests(rows([1, 2, 3], whole=[True, False, True]))) == [1]
    found = merger.packets(rows([2], mark=1))
    assert told(found) == [2, 3]
    assert [each["mark"].tolist() for each in (f.matching(BIT) for f in found)] == [[1, 0]]


def test_a_lost_copy_is_not_waited_for_when_its_stream_has_passed():
    merger = SequenceMerger()
    assert told(merger.digests(rows([1, 2, 3, 4], whole=[True, False, True, False]))) == [1]
    assert told(merger.packets(rows([4]))) == [2, 3, 4]


def test_what_waits_is_told_when_nothing_more_comes():
    merger = SequenceMerger()
    assert not merger.digests(rows([5, 6]))
    assert told(merger.flush()) == [5, 6]
    assert not merger.packets(rows([5]))
    assert not merger.digests(rows([8, 10]))
    assert told(merger.flush()) == [8, 10]
    assert merger.skipped == 2


def test_a_switch_that_counts_from_one_again():
    merger = SequenceMerger()
    assert told(merger.digests(rows([1, 2, 4]))) == [1, 2]
    assert told(merger.digests(rows([5, 1, 2]))) == [4, 5, 1, 2]
    assert told(merger.packets(rows([3]))) == [3]
    assert not merger.digests(rows([0, 0]))


@given(
    kinds=st.lists(st.sampled_from(["digest", "copy", "both", "unread", "lost"]), max_size=60),
    turns=st.lists(st.tuples(st.booleans(), st.integers(1, 9)), max_size=60),
)
def test_any_interleaving_tells_the_same(kinds, turns):
    streams = {True: [], False: []}
    for number, kind in enumerate(kinds, start=1):
        if kind in ("digest", "both", "unread"):
            streams[True].append((number, kind != "unread"))
        if kind in ("copy", "both", "unread"):
            streams[False].append((number, True))
    merger, got = SequenceMerger(), []
    everything = [*turns, *[(True, 60), (False, 60)]]
    for digests, count in everything:
        taken, streams[digests] = streams[digests][:count], streams[digests][count:]
        if taken:
            numbers, whole = zip(*taken, strict=True)
            take = merger.digests if digests else merger.packets
            got += told(take(rows(numbers, whole=list(whole))))
    got += told(merger.flush())
    assert got == [number for number, kind in enumerate(kinds, start=1) if kind != "lost"]
    assert len(merger) == 0


def test_behind_another_controller_the_next_number_waits_for_nothing():
    merger = SequenceMerger()
    merger.follow(5_000)
    assert told(merger.digests(rows([5_001, 5_002]))) == [5_001, 5_002]
    merger.begin_anew()
    merger.follow(9_000)
    assert told(merger.digests(rows([9_001, 9_002]))) == [9_001, 9_002]


def test_numbers_that_the_controller_before_may_have_told_are_not_called_skipped():
    merger = SequenceMerger()
    assert not merger.digests(rows([5_010, 5_011]))
    merger.follow(5_000)
    assert told(merger.flush()) == [5_010, 5_011]
    assert merger.skipped == 0
    assert not merger.digests(rows([5_014]))
    assert told(merger.flush()) == [5_014]
    assert merger.skipped == 2


def test_numbers_that_wrap_around_are_no_restart():
    """A copy of a frame before the wrap may come after digests of frames behind it."""
    merger = SequenceMerger()
    merger.follow(WRAP - 6)
    assert told(merger.digests(rows([WRAP - 5, WRAP - 4]))) == [WRAP - 5, WRAP - 4]
    assert told(merger.digests(rows([WRAP - 2, WRAP - 1, 1, 2, 4]))) == []
    assert merger.waits_for == WRAP - 3
    found = told(merger.packets(rows([WRAP - 3]))) + told(merger.digests(rows([5])))
    found += told(merger.packets(rows([3]))) + told(merger.digests(rows([6])))
    assert found == [WRAP - 3, WRAP - 2, WRAP - 1, 1, 2, 3, 4, 5, 6]
    assert told(merger.digests(rows([7, 8]))) == [7, 8]
    assert (len(merger), merger.skipped, merger.copies) == (0, 0, 2)
    assert told(merger.digests(rows([1, 2]))) == [1, 2]


def test_a_stream_without_copies_waits_for_nothing_at_the_wrap():
    merger = SequenceMerger()
    merger.follow(WRAP - 3)
    assert told(merger.digests(rows([WRAP - 2, WRAP - 1]))) == [WRAP - 2, WRAP - 1]
    assert told(merger.digests(rows([1, 2]))) == [1, 2]
    assert told(merger.digests(rows([3]))) == [3]
    assert merger.waits_for == 0


def test_copies_that_begin_again_after_a_whole_round_are_not_dropped():
    merger = SequenceMerger()
    merger.follow(WRAP - 3)
    merger._passed["packet"] = 10
    merger.digests(rows([WRAP - 2, WRAP - 1]))
    merger.digests(rows(range(1, 21)))
    assert told(merger.packets(rows([21]))) == [21]
