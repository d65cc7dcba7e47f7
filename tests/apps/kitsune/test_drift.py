"""A notice when a day of benign scores has left training's distribution, and none on traffic like training's."""

import json

import numpy as np
import pytest

from apps.kitsune.drift import BLOCK_S, DAY_BLOCKS, LEAST_BLOCKS, LEAST_PACKETS, Drift


def scores(seed, count, *, shift=0.0, memory=0.98):
    """Log-normal and strongly autocorrelated, as scores are."""
    random = np.random.default_rng(seed)
    steps = random.normal(0, np.sqrt(1 - memory**2), count)
    state, found = random.normal(), np.empty(count)
    for number, step in enumerate(steps):
        state = memory * state + step
        found[number] = state
    return np.exp(-3 + 0.5 * found + shift)


def trained(seed=0):
    drift = Drift.of(scores(seed, 5_000))
    assert drift is not None
    return drift


def live(drift, days, *, seed=1, first=0, shift=0.0, packets=400):
    """Half hour by half hour; returns the days on which something changed."""
    told = []
    for block in range(first, first + round(days * DAY_BLOCKS)):
        times = block * BLOCK_S + np.linspace(0, BLOCK_S - 1, packets)
        if drift.add(scores((seed, block), packets, shift=shift), times):
            told.append(block / DAY_BLOCKS)
    return told


@pytest.mark.parametrize("seed", range(5))
def test_no_notice_in_two_weeks_of_traffic_like_training(seed):
    """Packets are autocorrelated: a test that took them for independent draws would cry every day."""
    assert live(trained(seed), 14, seed=100 + seed) == []


def test_one_notice_when_scores_have_left_and_one_when_they_are_back():
    drift = trained()
    live(drift, 1)
    (left,) = live(drift, 2, first=DAY_BLOCKS, shift=1.2)
    assert 1 < left < 2.1
    assert drift.reading.drifted
    assert drift.reading.least > drift.limit
    (back,) = live(drift, 3, first=3 * DAY_BLOCKS)
    assert 3 < back < 4.1
    assert not drift.reading.drifted


def test_one_loud_hour_is_no_drift():
    """However many packets it has: the unit is the half hour."""
    drift = trained()
    live(drift, 1)
    told = live(drift, 2 / DAY_BLOCKS, first=DAY_BLOCKS, shift=5.0, packets=20_000)
    assert told + live(drift, 1, first=DAY_BLOCKS + 2) == []


def test_nothing_is_said_of_a_few_hours_or_packets():
    drift = trained()
    assert live(drift, (LEAST_BLOCKS - 1) / DAY_BLOCKS, shift=3.0) == []
    quiet = trained()
    assert live(quiet, 2, shift=3.0, packets=LEAST_PACKETS - 1) == []
    assert Drift.of(np.zeros(3)) is None


def test_it_survives_a_restart():
    drift = trained()
    live(drift, 1, shift=0.8)
    again = Drift.from_state(json.loads(json.dumps(drift.to_state())))
    assert again.to_state()["drifted"]
    assert live(again, 0.5, first=DAY_BLOCKS, shift=0.8) == []  # it was told before
    for damage in ({"limit": 0}, {"line": "x"}, {"blocks": [[1, 2]]}):
        with pytest.raises((ValueError, TypeError)):
            Drift.from_state({**drift.to_state(), **damage})
