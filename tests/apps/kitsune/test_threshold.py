"""The calibrated threshold lets through as many benign packets as asked for, if their scores are log-normal."""

import numpy as np
import pytest

from apps.kitsune.threshold import Benign, Calibration


def scores(count, seed=1, middle=-4.6, spread=0.8):
    return np.exp(np.random.default_rng(seed).normal(middle, spread, count))


def test_the_threshold_lets_the_wanted_share_through():
    benign = Benign.of(scores(100_000), seconds=3600.0)
    assert benign.packets_per_hour == 100_000
    threshold = benign.threshold(100.0)
    assert 60 <= np.count_nonzero(scores(100_000, seed=2) > threshold) <= 160


def test_a_heavier_upper_tail_raises_the_threshold():
    light = scores(10_000)
    heavy = np.where(light > np.quantile(light, 0.98), light * 5, light)
    assert Benign.of(heavy, 3600.0).threshold(1.0) > Benign.of(light, 3600.0).threshold(1.0)


def test_drift_counts_in_spreads():
    benign = Benign.of(scores(50_000), 3600.0)
    assert benign.drift(scores(50_000, seed=3)) == pytest.approx(0, abs=0.05)
    assert benign.drift(scores(50_000, seed=3, middle=-3.0)) > 1.5
    assert benign.drift(np.zeros(0)) == 0


def test_calibration_completes_once_whatever_the_batches():
    calibration = Calibration(1000)
    data, times = scores(3000), np.arange(3000.0)
    completed = [calibration.add(data[at : at + 300], times[at : at + 300]) for at in range(0, 3000, 300)]
    assert completed.index(True) == 3
    assert completed.count(True) == 1
    assert calibration.benign is not None
    assert (calibration.benign.packets, calibration.benign.packets_per_hour) == (
        1000,
        pytest.approx(3600, rel=0.01),
    )


def test_a_short_run_is_fitted_at_its_end():
    calibration = Calibration(1000)
    calibration.add(scores(50), np.arange(50.0))
    calibration.close(50.0)
    assert calibration.benign is not None
    empty = Calibration(1000)
    empty.close(1.0)
    assert empty.benign is None


def test_zero_nan_and_infinite_scores_do_not_break_the_fit():
    benign = Benign.of(np.array([0.0, np.nan, np.inf, 0.1, 0.2, 0.3]), 1.0)
    assert np.isfinite(benign.threshold(1.0))


@pytest.mark.parametrize("alarms", [0.0, -1.0, float("nan")])
def test_no_alarms_at_all_cannot_be_promised(alarms):
    with pytest.raises(ValueError, match="must be greater than 0"):
        Benign.of(scores(100), 1.0).threshold(alarms)


def test_too_few_scores_are_refused():
    with pytest.raises(ValueError, match="at least 2"):
        Benign.of(np.array([1.0]), 1.0)
    with pytest.raises(ValueError, match="calibration_packets=1"):
        Calibration(1)
