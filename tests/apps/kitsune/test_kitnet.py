"""Scores equal the published ones within 1e-12, in the kernel, its twin and the naive version, in any batches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.kitsune.kitnet import KitNet
from sdnator.testing.oracles.kitnet import NaiveKitNet as Naive
from tests.naive.kitsune.kitnet import PythonKitNet
from tests.requirements import shared_data

NETWORKS = {"kernel": KitNet, "twin": PythonKitNet}
FM, AD = 500, 1500


@pytest.fixture(scope="module")
def published():
    features = np.load(shared_data("kitsune/features_first3000_f64.npz"))["features"]
    return features, np.load(shared_data("kitsune/scores.npz"))["first3000_fm500_ad1500_m10"]


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("step", [1, 17, 3000])
def test_equals_the_published_scores(published, name, step):
    features, wanted = published
    network = NETWORKS[name](fm_grace=FM, ad_grace=AD)
    found = np.concatenate([network.process(features[at : at + step])[0] for at in range(0, 3000, step)])
    assert not found[: FM + AD + 1].any()
    assert np.abs(found[FM + AD + 1 :] / wanted[FM + AD + 1 :] - 1).max() < 1e-12


def test_the_naive_version_equals_the_published_scores(published):
    features, wanted = published
    naive = Naive(100, 10, FM, AD)
    found = np.array([naive.process(row) for row in features])
    assert np.allclose(found, wanted, rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", NETWORKS)
def test_first_score_follows_fm_plus_ad_plus_one_packets(name):
    rows = np.random.default_rng(3).random((30, 6))
    network = NETWORKS[name](6, fm_grace=5, ad_grace=10, max_ae=3)
    scores, errors = network.process(rows)
    assert np.count_nonzero(scores == 0) == network.training_packets == 16
    assert errors.shape == (14, len(network.feature_map))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 12), st.integers(1, 5), st.integers(0, 10**6))
def test_kernel_equals_twin_and_naive_on_random_features(width, most, seed):
    rows = np.random.default_rng(seed).normal(size=(90, max(width, 2)))
    width = rows.shape[1]
    kernel = KitNet(width, fm_grace=20, ad_grace=30, max_ae=most)
    twin = PythonKitNet(width, fm_grace=20, ad_grace=30, max_ae=most)
    naive = Naive(width, most, 20, 30)
    wanted = np.array([naive.process(row) for row in rows])
    assert np.allclose(twin.process(rows)[0], wanted, rtol=1e-10, atol=0)
    assert np.allclose(kernel.process(rows)[0], wanted, rtol=1e-10, atol=0)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 47])
def test_scores_do_not_depend_on_how_many_rows_come_at_a_time(count):
    """The kernel takes sixteen at a time, whatever else is asked."""
    rows = np.random.default_rng(4).random((100, 6))
    network = KitNet(6, fm_grace=5, ad_grace=30, max_ae=3)
    network.learn(rows[:36])
    for found, wanted in zip(network.score(rows[36 : 36 + count]), network.score(rows[36:]), strict=True):
        assert np.array_equal(found, wanted[:count])


@pytest.mark.parametrize("name", NETWORKS)
def test_a_given_map_trains_on_all_training_packets(name):
    rows = np.random.default_rng(5).random((40, 4))
    network = NETWORKS[name](4, fm_grace=9, ad_grace=20, feature_map=[[0, 1], [2, 3]])
    network.process(rows[:29])
    assert network.ensemble is not None
    assert np.array_equal(network.ensemble.high[0], rows[:29, :2].max(axis=0))
    assert not network.is_trained


@pytest.mark.parametrize("name", NETWORKS)
def test_a_constant_feature_that_moves_is_limited_by_clip_only(name):
    rows = np.random.default_rng(7).random((80, 4))
    rows[:, 1] = 5.0
    moved = rows[:3].copy()
    moved[:, 1] = 6.0
    scores = {}
    for clip in (0.0, 1e6):
        network = NETWORKS[name](4, fm_grace=20, ad_grace=50, clip=clip)
        network.learn(rows[:71])
        scores[clip] = network.score(moved)[0]
    assert (scores[0.0] > 1e12).all()
    assert ((scores[1e6] > 1) & (scores[1e6] < 1e12)).all()


@pytest.mark.parametrize("name", NETWORKS)
def test_nan_gives_nan_and_enters_no_range(name):
    rows = np.random.default_rng(9).random((60, 4))
    rows[40, 2] = np.nan
    network = NETWORKS[name](4, fm_grace=20, ad_grace=50, max_ae=4)
    network.learn(rows)
    assert network.ensemble is not None
    assert np.isfinite(network.ensemble.high[0, : len(network.feature_map[0])]).all()


def test_scoring_before_training_says_what_is_missing():
    with pytest.raises(ValueError, match="has seen 0 packets and needs 55001"):
        KitNet().score(np.zeros((1, 100)))


def test_graces_below_one_are_refused():
    with pytest.raises(ValueError, match="fm_grace=0"):
        KitNet(fm_grace=0)
