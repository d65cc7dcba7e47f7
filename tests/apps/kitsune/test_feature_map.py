"""The map of features equals the published one, and the clustering scipy's, ties included."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import linkage, to_tree

from apps.kitsune.feature_map import FeatureMapper, single_linkage, split_tree
from sdnator.testing.oracles.kitnet import NaiveFeatureMap as Naive
from sdnator.testing.oracles.kitnet import split
from tests.requirements import shared_data


@settings(max_examples=150, deadline=None)
@given(st.integers(2, 24), st.integers(1, 12), st.integers(0, 10**6), st.booleans())
def test_clustering_equals_scipy_with_many_ties(count, most, seed, tied):
    random = np.random.default_rng(seed)
    values = random.integers(0, 4, (count, count)) / 4 if tied else random.random((count, count))
    distance = np.triu(values, 1) + np.triu(values, 1).T
    expected = split(to_tree(linkage(distance[np.triu_indices(count, 1)])), most)
    assert split_tree(*single_linkage(distance), most) == expected


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 30), st.integers(0, 10**6))
def test_learning_in_parts_equals_learning_one_by_one(width, seed):
    rows = np.random.default_rng(seed).integers(0, 5, (40, width)).astype(float)
    mapper, naive = FeatureMapper(width), Naive(width)
    for part in np.array_split(rows, [1, 7, 30]):
        mapper.learn(part)
    for row in rows:
        naive.update(row)
    assert mapper.cluster(5) == naive.groups(5)
    assert sorted(feature for group in mapper.cluster(5) for feature in group) == list(range(width))


def test_map_of_the_published_features():
    features = np.load(shared_data("kitsune/features_first3000_f64.npz"))["features"]
    mapper = FeatureMapper(100)
    mapper.learn(features[:501])
    wanted = json.loads(shared_data("kitsune/feature_map_first3000_fm500_ad1500_m10.json").read_text())
    assert mapper.cluster(10) == wanted


def test_one_feature_per_autoencoder():
    mapper = FeatureMapper(4)
    mapper.learn(np.random.default_rng(1).random((20, 4)))
    assert sorted(mapper.cluster(1)) == [[0], [1], [2], [3]]


def test_features_that_are_not_finite_are_named():
    mapper = FeatureMapper(3)
    mapper.learn(np.array([[1.0, 2.0, 3.0], [1.0, np.nan, 4.0]]))
    with pytest.raises(ValueError, match=r"features \[1\] were not finite among the first 2 packets"):
        mapper.cluster(2)
