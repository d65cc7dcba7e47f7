"""The C tracker finds what its Python twin finds, to the last bit."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.kitsune.behaviour import behaviour as twin
from apps.kitsune.behaviour import contacts
from apps.kitsune.behaviour.behaviour import Behaviour
from apps.kitsune.behaviour.native import NativeBehaviour
from apps.kitsune.blocked import Blocked
from apps.kitsune.kernel import load_kernel
from apps.messages import Target
from tests.apps.firewall.enforcement.test_eve import decision
from tests.apps.kitsune.behaviour.test_behaviour import SYN, batch, packet
from tests.apps.kitsune.random_traffic import scores_of, traffic

TRAINING = 900


def plain(state):
    """Order of sets and tables does not matter."""
    if isinstance(state, dict):
        return {name: plain(value) for name, value in state.items()}
    if isinstance(state, list | tuple):
        return sorted((plain(each) for each in state), key=repr)
    return state


def feed(sides, random, start_s, *, left, blocked=None, count=None):
    """One batch through both; returns the findings."""
    count = int(random.integers(1, 400)) if count is None else count
    batch, scores = traffic(random, count, start_s), scores_of(random, count)
    trained = min(left, count)
    rescored = scores_of(np.random.default_rng(count), min(TRAINING, twin.CALIBRATION_PACKETS))
    found = [
        side.add(batch, f"s{count % 2}", scores, trained, lambda: rescored, 1.5, blocked) for side in sides
    ]
    assert repr(found[0]) == repr(found[1])
    assert sides[0].subjects == sides[1].subjects
    return trained, found[0]


@pytest.mark.parametrize("small", [False, True], ids=["usual limits", "small limits"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None)
def test_findings_and_what_is_learnt_are_equal(small, seed):
    """Every kind of packet, late ones, floods, scans, blocks in force, limits that are reached, a model file."""
    random = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        if small:
            patch.setattr(twin, "KEPT", 20)
            patch.setattr("apps.kitsune.behaviour.findings.KEPT", 20)
            patch.setattr(contacts, "MOST_CONTACTS", 30)
            patch.setattr(contacts, "LEAST_ARP_REPLIES", 1)
        sides = [Behaviour(TRAINING), NativeBehaviour(TRAINING, load_kernel())]
        blocked, left, at, findings = Blocked(), TRAINING, 0.0, 0
        for step in range(12):
            trained, found = feed(sides, random, at, left=left, blocked=blocked)
            left, at, findings = (
                left - trained,
                at + float(random.exponential(400 if step % 4 == 3 else 30)),
                findings + len(found),
            )
            if step == 8:
                target = Target(kind="ip", address="192.168.2.2")
                blocked.decide(decision(id="d1", action="block", switch="*", target=target))
        feed(sides, random, at, left=left, count=left + 50)
        states = [json.loads(json.dumps(side.to_state())) for side in sides]
        assert plain(states[0]) == plain(states[1])
        again = [Behaviour.from_state(states[0]), NativeBehaviour.restored(states[0], load_kernel())]
        for _ in range(3):
            feed(again, random, at, left=0)
        assert plain(again[0].to_state()) == plain(again[1].to_state())


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=4, deadline=None)
def test_a_subject_of_many_events_is_counted_as_by_the_twin(seed):
    """More events than are remembered of one subject, quiet hours between them, and a clock that is set back."""
    random = np.random.default_rng(seed)
    sides = [Behaviour(TRAINING), NativeBehaviour(TRAINING, load_kernel())]
    left, at = TRAINING, 0.0
    for step in range(5):
        batch = traffic(random, 1_500, at, hosts=2)
        scores = random.lognormal(2.0, 1.0, 1_500)
        found = [side.add(batch, "s1", scores, left, lambda: np.full(50, 0.5), 1.5) for side in sides]
        assert repr(found[0]) == repr(found[1])
        assert sides[0].subjects == sides[1].subjects
        left, at = 0, at + [5, 2_000, -900, 90, 0][step]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=8, deadline=None)
def test_a_contact_that_is_forgotten_before_it_ends_ends_all_the_same(seed):
    """With so little room contacts are forgotten while an answer is still awaited."""
    random = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contacts, "MOST_CONTACTS", 3)
        sides = [Behaviour(TRAINING), NativeBehaviour(TRAINING, load_kernel())]
        left, at = TRAINING, 0.0
        for _ in range(10):
            trained, _ = feed(sides, random, at, left=left)
            left, at = left - trained, at + float(random.exponential(2))
        assert plain(json.loads(json.dumps(sides[0].to_state()))) == plain(
            json.loads(json.dumps(sides[1].to_state()))
        )


def test_the_queue_of_awaited_answers_loses_none_when_it_shrinks_after_a_burst():
    """It has room for 8,192 after the burst; later a few hundred wait at a time."""
    sides = [Behaviour(1), NativeBehaviour(1, load_kernel())]
    begins = [0.0, *np.linspace(10, 10.5, 5_000), *np.linspace(30, 50, 4_000)]
    rows = [packet(at, 0x0A000000 + n % 199, 0x0B000000 + n, flags=SYN) for n, at in enumerate(begins)]
    for first in range(0, len(rows), 1_000):
        columns = batch(rows[first : first + 1_000])
        scores = np.zeros(len(columns))
        found = [side.add(columns, "s1", scores, int(not first), lambda: np.zeros(1), 1.5) for side in sides]
        assert repr(found[0]) == repr(found[1])
    assert plain(json.loads(json.dumps(sides[0].to_state()))) == plain(
        json.loads(json.dumps(sides[1].to_state()))
    )
