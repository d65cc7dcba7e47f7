"""What is above the highest count of training is weighed by how much counts vary in training."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.kitsune.behaviour.baseline import MOST_EVENTS, Baseline, SlidingSums


def learnt(counts_of_blocks, subject="host", early=0):
    baseline = Baseline(1)
    for block, count in enumerate(counts_of_blocks):
        baseline.learn(subject, block, (count,))
    baseline.close(early)
    return baseline


@given(st.lists(st.tuples(st.floats(0, 5), st.integers(1, 4)), min_size=1, max_size=60))
def test_sums_are_those_of_a_naive_count(steps):
    """Each window holds what came within its length, as a list that forgets nothing says."""
    sums, now, seen = SlidingSums((1.0, 10.0)), 0.0, []
    for step, weight in steps:
        now += step
        seen.append((now, weight))
        naive = tuple(sum(w for at, w in seen if at >= now - window) for window in (1.0, 10.0))
        assert sums.add("a", now, weight) == pytest.approx(naive)


def test_events_of_one_subject_and_subjects_are_bounded():
    """The oldest event and the subject that was quiet longest go first."""
    sums = SlidingSums((1.0,), most=2)
    for number in range(3 * MOST_EVENTS):
        total = sums.add("flood", number * 1e-6)[0]
    assert total <= MOST_EVENTS
    for subject in "abc":
        sums.add(subject, 1.0)
    assert sums.add("a", 1.0) == (1.0,)


def test_what_training_saw_has_no_weight_and_more_weighs_by_its_scale():
    steady, restless = learnt([4, 4, 4, 4]), learnt([1, 4, 2, 9])
    assert steady.nats("host", (4,)) == (0.0, 0)
    assert steady.nats("host", (9,))[0] == pytest.approx(5.0)
    assert restless.nats("host", (14,))[0] < steady.nats("host", (9,))[0]


def test_strangers_are_compared_with_the_busiest_and_known_hosts_with_themselves():
    baseline = learnt([3, 1])
    assert baseline.nats("stranger", (3,))[0] == 0
    baseline = Baseline(1)
    for block in (0, 1):
        baseline.learn("busy", block, (20.0,))
        baseline.learn("quiet", block, (1.0,))
    baseline.close()
    assert baseline.nats("busy", (20,))[0] == baseline.nats("stranger", (20,))[0] == 0
    assert baseline.nats("quiet", (20,))[0] > 10


def test_the_beginning_of_training_says_nothing_about_known_hosts():
    """There everything was new; a newcomer's beginning is compared with it."""
    baseline = learnt([50, 1, 1, 1], early=2)
    assert baseline.nats("host", (20,))[0] > 5
    assert baseline.nats("newcomer", (50,))[0] == 0


def test_state_survives_json():
    baseline = Baseline(1)
    baseline.learn(("s1", 1, (2, 3)), 0, (7.0,))
    baseline.close()
    again = Baseline(1)
    again.restore(json.loads(json.dumps(baseline.to_state())))
    assert again.nats(("s1", 1, (2, 3)), (9,)) == baseline.nats(("s1", 1, (2, 3)), (9,))
    with pytest.raises(ValueError, match="windows"):
        Baseline(2).restore(baseline.to_state())
