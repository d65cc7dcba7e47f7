"""What is above the highest count of training is weighed by how much counts vary in training."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.kitsune.behaviour.baseline import LEAST_SCALE, MOST_EVENTS, Baseline, SlidingSums


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
    assert steady.nats("host", (4,)).nats == 0
    assert steady.nats("host", (9,)) == (pytest.approx(5.0), 0, 4)
    assert restless.nats("host", (14,)).nats < steady.nats("host", (9,)).nats


def test_strangers_are_compared_with_the_busiest_and_known_hosts_with_themselves_too():
    """A quiet host that does what a busy one did is told by the tail of the busy one."""

    def of(own):
        baseline = Baseline(1, own=own)
        for block in (0, 1):
            baseline.learn("busy", block, (20.0,))
            baseline.learn("quiet", block, (1.0,))
        baseline.close()
        return baseline

    for baseline in (of(own=True), of(own=False)):
        assert baseline.nats("busy", (20,)).nats == baseline.nats("stranger", (20,)).nats == 0
    assert of(own=True).nats("quiet", (20,)).nats == pytest.approx(18 / 5)
    assert of(own=False).nats("quiet", (20,)).nats == 0


def test_the_beginning_of_training_says_nothing_about_known_hosts():
    """There everything was new; a newcomer's beginning is compared with it."""
    baseline = learnt([50, 1, 1, 1], early=2)
    assert baseline.nats("host", (20,)).nats > 1
    assert baseline.nats("newcomer", (50,)).nats == 0


def test_each_kind_has_its_own_highest_count():
    """What many do at one service proves nothing at another."""
    baseline = Baseline(1, own=False)
    for block in range(3):
        baseline.learn("host", block, (9.0,), "common")
    baseline.close()
    assert baseline.nats("host", (9,), "common").nats == 0
    assert baseline.nats("host", (9,), "never seen").nats == pytest.approx(9 / LEAST_SCALE)


def test_being_above_everybody_weighs_more_than_above_oneself():
    baseline = learnt([4, 4, 4, 4])
    plain = baseline.nats("stranger", (9,)).nats
    baseline.rarity = 3.0
    assert baseline.nats("stranger", (9,)).nats == pytest.approx(plain + 3)
    assert baseline.nats("stranger", (4,)).nats == 0


def test_maxima_of_the_last_blocks_are_what_is_still_to_be_expected():
    """At the beginning every kind is new, which does not go on."""
    steady, growing = learnt([50, 1, 1, 1], early=2), learnt([1, 1, 1, 50], early=2)
    assert steady.exceeded == 0
    assert growing.exceeded > 0


def test_state_survives_json():
    baseline = Baseline(1)
    baseline.learn(("s1", 1, (2, 3)), 0, (7.0,), (23, True))
    baseline.close()
    baseline.rarity = 2.0
    again = Baseline(1)
    again.restore(json.loads(json.dumps(baseline.to_state())))
    for kind in ((23, True), None):
        seen = baseline.nats(("s1", 1, (2, 3)), (9,), kind)
        assert again.nats(("s1", 1, (2, 3)), (9,), kind) == seen
    with pytest.raises(ValueError, match="windows"):
        Baseline(2).restore(baseline.to_state())


def test_rates_weigh_by_orders_of_magnitude():
    """A stream three times as fast as any before may be a new program; one a thousand times as fast is a flood."""
    baseline = Baseline(1, 8.0, own=False, rates=True)
    for block in range(4):
        baseline.learn("host", block, (40.0,), "udp")
    baseline.close()
    assert baseline.nats("other", (40,), "udp").nats == 0
    assert baseline.nats("other", (120,), "udp").nats < 3
    assert baseline.nats("other", (4_000,), "udp").nats > 10
    doubled = [baseline.nats("other", (48 * 2**n - 8,), "udp").nats for n in (1, 2, 3)]
    assert doubled[1] - doubled[0] == pytest.approx(doubled[2] - doubled[1])
