"""The measures of the paper's table, on cases small enough to count by hand."""

import numpy as np
import pytest

from sdnator.detect.detection_quality import eer, measures, tpr_at


def test_a_perfect_and_a_useless_detector():
    attack = np.array([False] * 50 + [True] * 50)
    perfect = measures(attack, np.arange(100.0))
    assert perfect == {"auc": 1.0, "tpr_at_fpr_0": 1.0, "tpr_at_fpr_0.001": 1.0, "equal_error_rate": 0.0}
    useless = measures(attack, np.ones(100))
    assert useless["auc"] == 0.5
    assert useless["tpr_at_fpr_0"] == 0.0


def test_rates_counted_by_hand():
    score = np.array([1.0, 2, 3, 9, 4, 5, 8, 10])
    attack = np.array([False] * 4 + [True] * 4)
    assert tpr_at(attack, score, 0.0) == 0.25
    assert tpr_at(attack, score, 0.25) == 1.0
    assert eer(attack, score) == pytest.approx(0.25, abs=0.13)


def test_one_class_alone_has_no_measures():
    for attack in (np.zeros(3, dtype=bool), np.ones(3, dtype=bool)):
        assert set(measures(attack, np.arange(3.0)).values()) == {None}
