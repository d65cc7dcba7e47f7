"""A saved model scores as the trained one did; anything else in its place is refused with a sentence."""

import json
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.kitsune.kernel import load_kernel
from apps.kitsune.kitnet import KitNet
from apps.kitsune.model_file import ModelFileError, NotAModelError, WrongVersionError, load_model, save_model

ROWS = np.random.default_rng(1).random((60, 100))


@pytest.fixture(scope="module")
def network():
    network = KitNet(fm_grace=10, ad_grace=30)
    network.learn(ROWS[:41])
    return network


@pytest.fixture
def path(tmp_path, network):
    save_model(tmp_path / "model.npz", network, {"senders": None, "word": "ä"})
    return tmp_path / "model.npz"


def test_scores_are_the_same_after_loading(path, network):
    model = load_model(path)
    assert model.network.is_trained
    assert model.notes == {"senders": None, "word": "ä"}
    assert np.array_equal(model.network.score(ROWS)[0], network.score(ROWS)[0])
    in_kernel = load_model(path, kernel=load_kernel()).network.score(ROWS)[0]
    assert np.allclose(in_kernel, network.score(ROWS)[0], rtol=1e-12)


def test_nothing_else_is_left_in_the_folder(path):
    assert [entry.name for entry in path.parent.iterdir()] == ["model.npz"]


def test_a_truncated_file_is_refused_wherever_it_ends(path):
    whole = path.read_bytes()
    for size in (0, 1, 30, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(NotAModelError, match=r"model\.npz: an incomplete Kitsune model"):
            load_model(path)


@pytest.mark.parametrize("content", [b"#!/bin/sh\nexit 0\n", b"\x80\x04.", b"\x00" * 100])
def test_another_file_is_no_model_and_nobody_is_told_to_trust_it(path, content):
    path.write_bytes(content)
    with pytest.raises(NotAModelError, match="not a Kitsune model; use a file from --save-model") as raised:
        load_model(path)
    assert "pickle" not in str(raised.value)


def test_a_folder_is_told_in_words(tmp_path):
    with pytest.raises(
        ModelFileError, match=r"cannot be read \(Is a directory\); use a file from --save-model"
    ):
        load_model(tmp_path)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_bytes_never_surprise(tmp_path_factory, network, data):
    path = tmp_path_factory.mktemp("damage") / "model.npz"
    save_model(path, network, {})
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(raw))
    try:
        load_model(path)
    except ModelFileError as error:
        assert str(path) in str(error)  # noqa: PT017 - most damage hits a checksum, some changes nothing


def rewritten(path, **changes):
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(bytes(arrays["header"])) | {k: v for k, v in changes.items() if k not in arrays}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    arrays |= {name: value for name, value in changes.items() if name in arrays and name != "header"}
    np.savez(path, **arrays)


def test_other_versions_and_formats_are_refused(path):
    rewritten(path, version=2)
    with pytest.raises(WrongVersionError, match="model version 2, this program reads version 1"):
        load_model(path)
    rewritten(path, format="something", version=1)
    with pytest.raises(NotAModelError, match="format 'something'"):
        load_model(path)


@pytest.mark.parametrize(
    "change",
    [
        {"feature_map": [[0, 1]]},
        {"feature_map": "x"},
        {"width": 115},
        {"lambdas": [1]},
        {"notes": 3},
        {"fm_grace": 0},
        {"ensemble_weights": np.zeros((2, 2, 2))},
    ],
)
def test_parts_that_do_not_fit_are_refused(path, change):
    rewritten(path, **change)
    with pytest.raises(NotAModelError, match="damaged Kitsune model"):
        load_model(path)


def test_foreign_files_are_refused(tmp_path):
    foreign = tmp_path / "other.npz"
    np.savez(foreign, a=np.zeros(3))
    with pytest.raises(NotAModelError, match="no header"):
        load_model(foreign)
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(NotAModelError):
        load_model(foreign)
    np.savez(foreign, header=np.array([{"a": 1}], dtype=object))
    with pytest.raises(NotAModelError):
        load_model(foreign)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ModelFileError, match="no such model"):
        load_model(tmp_path / "none.npz")


def test_an_untrained_model_and_an_unwritable_place_are_refused(tmp_path, network):
    with pytest.raises(ModelFileError, match="0 of 55001 training packets"):
        save_model(tmp_path / "m.npz", KitNet(), {})
    with pytest.raises(ModelFileError, match="cannot be written"):
        save_model(tmp_path / "no" / "m.npz", network, {})


@pytest.mark.parametrize(("place", "byte"), [(4, 255), (6, 1)])
def test_a_zip_file_of_another_version_or_encrypted_is_refused(path, place, byte):
    """Python's reader has errors of its own for these."""
    whole = bytearray(path.read_bytes())
    directory = whole.index(b"PK\x01\x02")
    whole[directory + place + 2] = whole[whole.index(b"PK\x03\x04") + place] = byte
    path.write_bytes(bytes(whole))
    with pytest.raises(NotAModelError, match="an incomplete Kitsune model"):
        load_model(path)
