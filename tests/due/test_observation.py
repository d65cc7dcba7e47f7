"""A tracker drops what came already, counts what is missing, and hears no replaced instance."""

import pytest
import reactivex.operators as ops
from hypothesis import given
from hypothesis import strategies as st

from due.codec import MAX_EPOCH, Frame
from due.errors import RefusedFrame
from due.keys import Key
from due.messages import Item
from due.observation import Observation, deliver
from due.tracker import CONFIRMED, FAR, KEPT, NumberRanges, Tracker


def _frame(before, count=2, *, instance="i", epoch=0, key="a.b"):
    return Frame(key, "app", instance, epoch, before + 1, before, [0] * count, None, [0] * count)


@given(st.lists(st.booleans(), min_size=1, max_size=30), st.integers(1, 5))
def test_lost_items_are_counted_exactly(arrives, count):
    tracker = Tracker(shared=False)
    admitted = sum(
        tracker.admit(_frame(n * count, count), reliable=False) for n, there in enumerate(arrives) if there
    )
    first = arrives.index(True) if True in arrives else len(arrives)
    last = len(arrives) - arrives[::-1].index(True) if True in arrives else first
    assert admitted == sum(arrives)
    assert tracker.gaps == count * arrives[first:last].count(False)


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(0, 5)), min_size=1, max_size=30))
def test_what_a_producer_sends_again_is_dropped_and_order_never_goes_back(steps):
    tracker = Tracker(shared=False)
    written, admitted, number = [], [], 0
    for step, again in steps:
        number += step
        written.append(number)
        came = written[-1 - again :]
        admitted += [n for n in came if tracker.admit(_frame(2 * n), reliable=True)]
    assert admitted == written
    assert tracker.refuted == 0


@given(st.lists(st.integers(0, 9), max_size=40))
def test_a_member_of_a_shared_group_takes_each_frame_once_in_any_order(order):
    tracker = Tracker(shared=True)
    admitted = [n for n in order if tracker.admit(_frame(2 * n), reliable=True)]
    assert sorted(admitted) == sorted(set(order))
    assert tracker.gaps == 0


def test_instances_and_keys_are_told_apart():
    tracker = Tracker(shared=False)
    assert all(
        tracker.admit(_frame(0, instance=i, key=k), reliable=False) for i in "xy" for k in ("a.b", "a.c")
    )


def test_an_older_epoch_under_the_same_path_is_fenced_off():
    tracker = Tracker(shared=False)
    assert tracker.admit(_frame(0, instance="old", epoch=1), reliable=True)
    assert tracker.admit(_frame(0, instance="new", epoch=2), reliable=True)
    assert not tracker.admit(_frame(2, instance="old", epoch=1), reliable=True)
    assert tracker.admit(_frame(0, instance="old", epoch=1, key="a.other"), reliable=True)
    assert tracker.fenced == 2


@pytest.mark.parametrize("jump", [1, 1000, 2**30, FAR - 200])
def test_a_false_jump_costs_none_of_the_genuine_frames(jump):
    tracker = Tracker(shared=False)
    assert tracker.admit(_frame(0), reliable=True)
    tracker.admit(_frame(2 + jump), reliable=True)
    tracker.admit(_frame(104 + jump), reliable=True)
    assert all(tracker.admit(_frame(n), reliable=True) for n in range(2, 50, 2))
    assert (tracker.refuted, tracker.repeats) == (1, 0)


def test_a_jump_that_no_outage_explains_is_refused_and_changes_nothing():
    tracker = Tracker(shared=False)
    assert tracker.admit(_frame(0), reliable=True)
    for before in (2**40, 2**61):
        with pytest.raises(RefusedFrame) as refused:
            tracker.admit(_frame(before), reliable=True)
        assert refused.value.cause == "out_of_range"
    assert tracker.admit(_frame(2), reliable=True)
    assert (tracker.gaps, tracker.repeats) == (0, 0)


def test_a_shared_member_knows_a_repeat_however_long_ago_the_frame_was():
    """A server that comes back empty is given again all that producers still have."""
    tracker = Tracker(shared=True, remember=4)
    frames = [_frame(before=2 * n, count=2, epoch=1 + n // 50) for n in range(100)]
    assert all(tracker.admit(frame, reliable=True) for frame in frames)
    assert not any(tracker.admit(frame, reliable=True) for frame in frames)
    assert tracker.repeats == 200
    assert tracker.refuted == 0, "older epochs of older frames are true"


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(1, 4)), max_size=60))
def test_ranges_know_what_they_were_given(numbers):
    ranges, known = NumberRanges(), set()
    for first, count in numbers:
        assert ranges.add(first, first + count) == (first not in known)
        if first not in known:
            known |= set(range(first, first + count))
    assert ranges.end == max(known, default=-1) + 1


def test_ranges_are_bounded():
    ranges = NumberRanges()
    for number in range(10_000):
        ranges.add(3 * number, 3 * number + 1)
    assert not ranges.add(29_997, 29_998)
    assert ranges.add(0, 1), "the lowest were forgotten"


def test_a_false_first_frame_is_seen_by_frames_from_before_all_that_could_be_kept():
    tracker = Tracker(shared=False)
    assert tracker.admit(_frame(2**61), reliable=True)
    assert all(tracker.admit(_frame(n), reliable=True) for n in range(KEPT - 10, KEPT, 2))
    assert tracker.refuted == 1


def test_a_jump_counts_once_the_numbers_behind_it_have_gone_on():
    tracker = Tracker(shared=False)
    tracker.admit(_frame(0), reliable=True)
    assert all(tracker.admit(_frame(10 + 2 * n), reliable=True) for n in range(CONFIRMED + 1))
    assert not tracker.admit(_frame(2), reliable=True)
    assert (tracker.gaps, tracker.repeats) == (8, 2)


def test_what_another_instance_read_while_this_one_rested_is_not_read_again():
    tracker = Tracker(shared=False)
    tracker.admit(_frame(0), reliable=True)
    tracker.rested()
    assert tracker.admit(_frame(10), reliable=True)
    assert not tracker.admit(_frame(2), reliable=True)


def test_an_epoch_that_its_own_writer_denies_fences_nobody():
    tracker = Tracker(shared=False)
    assert tracker.admit(_frame(0, epoch=3), reliable=True)
    tracker.admit(_frame(2, epoch=MAX_EPOCH), reliable=True)
    assert all(tracker.admit(_frame(n, epoch=3), reliable=True) for n in (4, 6))
    assert not tracker.admit(_frame(0, epoch=2, instance="older"), reliable=True)
    assert (tracker.fenced, tracker.refuted) == (2, 1)


def _observation(**options):
    events = []
    fields = {"frequency": None, "start": "", **options}
    subject = Observation(
        Key("a.b"),
        opened=lambda _o: events.append("opened"),
        closed=lambda _o: events.append("closed"),
        **fields,
    )
    return subject, events


def _item(value, timestamp=0):
    return Item("a.b", value, timestamp, timestamp, "app", "i", 1)


def test_the_interest_lives_from_the_first_subscription_to_the_last():
    subject, events = _observation()
    first, second = subject.subscribe(print), subject.pipe(ops.map(str)).subscribe(print)
    assert events == ["opened"]
    first.dispose()
    assert events == ["opened"]
    second.dispose()
    assert events == ["opened", "closed"]
    subject.subscribe(print)
    subject.dispose()
    assert events == ["opened", "closed", "opened", "closed"]


def test_a_frequency_pair_thins_out():
    subject, _ = _observation(frequency=(1.0, 10.0))
    items = [_item(n, n * 10_000_000) for n in range(100)]
    assert [item.value for item in subject.thinned(items)] == list(range(0, 100, 10))


def test_what_a_callback_raises_is_reported_and_the_others_go_on():
    got, failed = [], []
    callbacks = (lambda item: 1 / item.value, lambda item: got.append(item.value))
    deliver([_item(0), _item(1)], callbacks, lambda _c, item, error: failed.append((item.value, type(error))))
    assert got == [0, 1]
    assert failed == [(0, ZeroDivisionError)]
