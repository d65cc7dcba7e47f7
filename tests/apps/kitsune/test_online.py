"""The Python API: one by one equals in batches, and a packet scored and then learnt counts once."""

import doctest

import numpy as np
import pytest

import apps.kitsune.online
from apps.kitsune.model_file import ModelFileError
from apps.kitsune.online import Kitsune
from apps.packets import PACKET_COLUMNS
from sdnator.testing.packet_rows import part
from tests.apps.kitsune.real_packets import real


def rows(batch):
    return [{name: int(batch[name][number]) for name in PACKET_COLUMNS} for number in range(len(batch))]


@pytest.fixture(scope="module")
def batch():
    return real(260)


def test_one_by_one_equals_in_batches(batch):
    many, single = (Kitsune(fm_grace=50, ad_grace=100) for _ in range(2))
    many.learn_many(part(batch, 0, 151))
    for row in rows(batch)[:151]:
        single.learn_one(row)
    assert many.is_trained
    assert single.is_trained
    wanted = many.score_many(part(batch, 151, 260))
    assert np.array_equal(wanted, [single.score_one(row) for row in rows(batch)[151:]])


def test_scored_then_learnt_counts_once(batch):
    plain, both = (Kitsune(fm_grace=50, ad_grace=100) for _ in range(2))
    for kitsune in (plain, both):
        kitsune.learn_many(part(batch, 0, 151))
    for row in rows(batch)[151:]:
        both.score_one(row)
        both.learn_one(row)
        plain.learn_one(row)
    assert np.array_equal(plain.features(batch), both.features(batch))


def test_scoring_needs_a_map():
    with pytest.raises(ValueError, match="needs 55001"):
        Kitsune().score_one({"length": 60, "time_us": 0})


def test_saved_and_loaded(batch, tmp_path):
    kitsune, other = Kitsune(fm_grace=50, ad_grace=100), Kitsune()
    with pytest.raises(ModelFileError):
        kitsune.save(tmp_path / "m.npz")
    kitsune.learn_many(part(batch, 0, 151))
    kitsune.save(tmp_path / "m.npz", site="home")
    other.load(tmp_path / "m.npz")
    other.features(part(batch, 0, 151))
    assert np.array_equal(other.score_many(part(batch, 151, 260)), kitsune.score_many(part(batch, 151, 260)))


def test_the_example_runs():
    assert doctest.testmod(apps.kitsune.online).failed == 0
