"""A tracker drops what came already, counts what is missing, and hears no replaced instance."""

import reactivex.operators as ops
from hypothesis import given
from hypothesis import strategies as st

from due.codec import Frame
from due.keys import Key
from due.messages import Item
from due.observation import Observation, Tracker, deliver


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


@given(st.lists(st.integers(0, 9), max_size=40))
def test_repeats_are_dropped_and_order_never_goes_back(order):
    tracker = Tracker(shared=False)
    admitted = [n for n in order if tracker.admit(_frame(2 * n), reliable=True)]
    assert admitted == sorted(set(admitted))


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
