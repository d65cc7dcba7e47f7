"""Losses are counted exactly: gaps, restarts and wrap-around of one stream, and numbers shared by two."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.p4runtime_ctrl.southbound.loss_tracker import LossTracker

WRAP = 1 << 32


def note(progress, numbers, source="packets"):
    sequence = np.array(numbers, dtype=np.uint64)
    getattr(progress, source)(sequence, sequence, sequence.astype(np.int64))


@pytest.mark.parametrize(
    ("fresh", "batches", "lost", "restarts"),
    [
        (True, [[1, 2, 3], [4]], 0, 0),
        (True, [[3, 4]], 2, 0),
        (False, [[5000, 5001]], 0, 0),  # the controller came later than the switch
        (False, [[5000, 5003], [5010]], 2 + 6, 0),
        (False, [[900, 901], [1, 2]], 0, 1),
        (False, [[900, 901, 1, 2]], 0, 1),
        (False, [[900, 901], [4]], 3, 1),
        (False, [[9], [3, 1], [2]], 2, 2),
        (False, [[WRAP - 2, WRAP - 1, 1, 2], [5000], [2_000_000]], 4_997 + 1_994_999, 0),
        (False, [[WRAP - 2], [WRAP - 1], [3]], 2, 0),
        (False, [[WRAP - 3], [2]], 3, 0),
        (False, [[3_000_000_000], [1, 2], [4]], 1, 1),
    ],
)  # fmt: skip
def test_one_stream(fresh, batches, lost, restarts):
    progress = LossTracker()
    if fresh:
        progress.expect_first()
    for batch in batches:
        note(progress, batch)
    assert (progress.lost, progress.restarts) == (lost, restarts)
    assert progress.received == sum(map(len, batches))


@given(
    st.sets(st.integers(1, 60), min_size=1),
    st.sets(st.integers(1, 60), min_size=1),
    st.lists(st.integers(1, 7), min_size=1),
)
def test_two_streams_share_their_numbers(packets, digests, steps):
    progress = LossTracker()
    progress.expected = frozenset(("packet", "digest"))
    progress.expect_first()
    streams = {"packets": sorted(packets), "digests": sorted(digests)}
    turn = 0
    while any(streams.values()):
        source = list(streams)[turn % 2]
        step = steps[turn % len(steps)]
        note(progress, streams[source][:step], source)
        streams[source] = streams[source][step:]
        turn += 1
    for source in streams:
        note(progress, [61], source)
    missing = set(range(1, 61)) - packets - digests
    assert progress.lost == len(missing)
    assert (progress.received, progress.reported) == (len(packets) + 1, len(digests) + 1)


def test_a_silent_stream_is_not_waited_for_for_ever():
    progress = LossTracker()
    progress.expected = frozenset(("packet", "digest"))
    note(progress, [1], "digests")
    note(progress, [2, 4])
    assert progress.lost == 0
    note(progress, [100_000])
    assert progress.lost > 0


def test_digests_without_a_number_are_no_gap():
    progress = LossTracker()
    note(progress, [0, 0, 0], "digests")
    note(progress, [1, 2])
    note(progress, [0, 3, 0], "digests")
    note(progress, [4])
    assert (progress.lost, progress.restarts, progress.reported) == (0, 0, 6)


def test_the_time_is_never_ahead_of_the_arrival_number():
    """Kitsune closes a second once the time has left it and all packets up to that number are scored."""
    seen = []

    class Watched(LossTracker):
        def __setattr__(self, name, value):
            super().__setattr__(name, value)
            if name == "time_us" and value:
                seen.append((value, self.arrival))

    progress = Watched()
    for numbers in ([1, 2], [3], [7, 8]):
        note(progress, numbers, "digests")
    assert seen == [(2, 2), (3, 3), (8, 8)]


@pytest.mark.parametrize(
    ("lists", "newest"),
    [
        ([("digests", [1, 2, 5]), ("packets", [3, 4])], 5),
        ([("packets", [3]), ("digests", [1, 2, 4])], 4),
        ([("digests", [(1 << 32) - 2, (1 << 32) - 1]), ("digests", [1, 2]), ("packets", [(1 << 32) - 1])], 2),
        ([("digests", [(1 << 31) + 9])], (1 << 31) + 9),
        ([("digests", [900]), ("digests", [1, 2])], 2),  # the switch counts from 1 again
    ],
)
def test_the_arrival_number_is_the_newest_of_both_streams(lists, newest):
    """A copy of an earlier frame may come after digests: what Kitsune has scored last is the newest."""
    progress = LossTracker()
    for source, numbers in lists:
        note(progress, numbers, source)
    assert progress.arrival == newest


@pytest.mark.parametrize("told_first", [True, False])
def test_behind_another_controller_what_neither_saw_is_counted_apart(told_first):
    progress = LossTracker()
    if told_first:
        progress.follow(100)
    note(progress, [105, 106, 108])
    if not told_first:
        progress.follow(100)
    assert (progress.unaccounted, progress.lost, progress.sequence) == (4, 1, 108)


def test_what_another_controller_received_meanwhile_is_no_loss():
    progress = LossTracker()
    note(progress, [1, 2, 4])
    progress.rest()
    progress.follow(5_000)
    note(progress, [5_001, 5_003])
    assert (progress.lost, progress.unaccounted, progress.restarts) == (2, 0, 0)


@pytest.mark.parametrize("before", [5_000, 3_000_000_000])
def test_a_switch_that_counts_from_one_again_behind_another_controller_has_nothing_unaccounted(before):
    progress = LossTracker()
    progress.follow(before)
    note(progress, [1, 2])
    assert (progress.lost, progress.unaccounted) == (0, 0)


def test_two_streams_wrap_around_one_after_the_other():
    progress = LossTracker()
    progress.expected = frozenset(("packet", "digest"))
    note(progress, [WRAP - 5, WRAP - 4, WRAP - 2], "digests")
    note(progress, [WRAP - 1, 2, 4], "digests")
    note(progress, [WRAP - 3, 1])
    note(progress, [5])
    note(progress, [6], "digests")
    assert (progress.lost, progress.restarts, progress.sequence) == (1, 0, 6)


def test_behind_another_controller_the_numbers_may_wrap_around():
    progress = LossTracker()
    progress.follow(WRAP - 3)
    note(progress, [2, 3])
    assert (progress.unaccounted, progress.lost, progress.sequence) == (4, 0, 3)


def test_a_stream_that_was_silent_for_long_goes_on_where_the_other_one_is():
    progress = LossTracker()
    progress.expected = frozenset(("packet", "digest"))
    note(progress, [1])
    note(progress, [1], "digests")
    for number in range(1 << 23, 3 << 30, 1 << 23):
        note(progress, [number], "digests")
    lost = progress.lost
    note(progress, [(3 << 30) - (1 << 23) + 1])
    assert progress.restarts == 0
    assert progress.lost - lost < 1 << 16, "of the last gap, what the silent stream was still waited for"
