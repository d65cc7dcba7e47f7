"""A kept model is taken up where it belongs; elsewhere the reason is told and the file stays beside."""

import json
import stat
from typing import Any, cast

import numpy as np
import pytest

from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.kept_model import MOST_ASIDE, KeptModel, models_aside, set_aside, trained_for
from apps.kitsune.model_instructions import ANSWER, INSTRUCTIONS
from apps.kitsune.service import PACKETS, SCORE, TRAINING_KEY, KitsuneService, Settings
from due import Engine, RecordBatch
from sdnator.testing.packet_rows import part
from tests.apps.hostile import Hands
from tests.apps.kitsune.test_hostile import KEY, mixed

SMALL = DetectorSettings(fm_grace=20, ad_grace=200)
HERE = {"s1": ("embedded", "1=veth:eth1")}


def kept(tmp_path, settings=SMALL, switches=HERE):
    return KeptModel(tmp_path / "model" / "kitsune.npz", trained_for(settings, switches))


@pytest.fixture
def trained(tmp_path):
    """A detector that was trained, and kept."""
    detector = Detector(SMALL)
    detector.process(mixed(400), "s1")
    kept(tmp_path).keep(detector)
    return detector


def test_it_is_taken_up_where_switches_ports_and_settings_are_the_same(tmp_path, trained):
    place = kept(tmp_path)
    found = place.detector(SMALL, None)
    assert found is not None
    assert found.model.is_trained
    assert found.behaviour.senders == trained.behaviour.senders
    assert found.drift is not None
    assert place.text.startswith("using the kept model of")
    assert stat.S_IMODE(place.path.stat().st_mode) == 0o600
    assert [each.name for each in place.path.parent.iterdir()] == ["kitsune.npz"]


@pytest.mark.parametrize(
    ("settings", "switches", "why"),
    [
        (
            SMALL,
            {"s1": ("embedded", "1=veth:eth9")},
            "switch s1 was embedded, 1=veth:eth1 and is embedded, 1=veth:eth9",
        ),
        (SMALL, {}, "switch s1 was embedded, 1=veth:eth1 and is not there"),
        (DetectorSettings(fm_grace=20, ad_grace=300), HERE, "trained with ad_grace=200, not 300"),
        (DetectorSettings(fm_grace=20, ad_grace=200, mode="reference"), HERE, "mode=bounded, not reference"),
    ],
)
def test_elsewhere_it_stays_beside_and_the_reason_is_one_line(tmp_path, trained, settings, switches, why):
    place = kept(tmp_path, settings, switches)
    assert place.detector(settings, None) is None
    assert place.text.startswith("training again: ")
    assert why in place.text
    assert "\n" not in place.text
    (aside,) = models_aside(place.path)
    assert str(aside) in place.text
    assert not place.path.exists()


def test_one_of_another_schema_or_a_damaged_one_is_not_used(tmp_path, trained, monkeypatch):
    monkeypatch.setattr("apps.kitsune.kept_model.SCHEMA", 2)
    place = kept(tmp_path)
    assert place.detector(SMALL, None) is None
    assert "its schema is 1, this program's is 2" in place.text
    place.path.write_bytes(b"no model")
    assert place.detector(SMALL, None) is None
    assert "not a Kitsune model" in place.text
    assert len(models_aside(place.path)) == 2


def test_models_beside_are_bounded(tmp_path):
    path = tmp_path / "kitsune.npz"
    for _ in range(MOST_ASIDE + 3):
        path.write_bytes(b"x")
        assert set_aside(path) is not None
    assert len(models_aside(path)) == MOST_ASIDE
    assert set_aside(path) is None


def service(tmp_path, engine=None, **changes):
    fields: dict[str, Any] = {
        "fm_grace": 20,
        "ad_grace": 200,
        "keep_model": str(tmp_path / "model" / "kitsune.npz"),
    }
    made = KitsuneService(
        cast("Engine", engine or Hands()), Settings(**(fields | {"keep_for": HERE} | changes))
    )
    made.start()
    return made


def fed(engine, batch, size=50):
    for at in range(0, len(batch), size):
        engine.hand(PACKETS, KEY, part(batch, at, at + size))


def test_a_service_that_starts_again_scores_at_once(tmp_path):
    engine = Hands()
    first = service(tmp_path, engine)
    assert "no model is kept yet" in first.ready()["model"]
    fed(engine, mixed(400))
    first.stop()
    again = service(tmp_path)
    assert again.ready()["model"].startswith("using the kept model")
    assert again.health()["model"]["done"]
    (told,) = [each for each in (engine.values(TRAINING_KEY)) if each["done"]]
    assert list(told["ports"]) == [{"switch": "s1", "port": int(mixed(1)["port"][0]), "packets": 221}]


def test_training_is_told_in_small_steps(tmp_path):
    engine = Hands()
    made = service(tmp_path, engine)
    fed(engine, mixed(200), 10)
    steps = [each["packets"] for each in engine.values(TRAINING_KEY)]
    assert steps == list(range(10, 201, 10))
    model = made.health()["model"]
    assert (model["packets"], model["wanted"], model["done"]) == (200, 221, False)
    assert model["seconds_left"] is None or model["seconds_left"] > 0


def test_an_operator_has_it_trained_anew(tmp_path):
    """At once, and the old model stays beside; a late instruction, or another app's, does nothing."""
    engine = Hands()
    made = service(tmp_path, engine)
    fed(engine, mixed(400))
    engine.hand(INSTRUCTIONS, INSTRUCTIONS, {"id": "o0", "verb": "retrain"}, app="intruder")
    engine.hand(INSTRUCTIONS, INSTRUCTIONS, {"id": "o1", "verb": "retrain", "expires": 1})
    assert made.health()["model"]["done"]
    engine.hand(INSTRUCTIONS, INSTRUCTIONS, {"id": "o2", "verb": "retrain"})
    assert [each["done"] for each in engine.values(ANSWER)] == [False, True]
    assert made.health()["model"]["packets"] == 0
    assert len(models_aside(tmp_path / "model" / "kitsune.npz")) == 1
    fed(engine, mixed(400))
    assert made.health()["model"]["done"]
    assert json.dumps(made.health()["model"])


def test_another_model_trains_beside_the_one_in_use_and_takes_over(tmp_path):
    """Scores never stop; the old file stays beside, and the new training is told."""
    engine, whole = Hands(), mixed(900)
    made = service(tmp_path, engine)
    fed(engine, part(whole, 0, 400))
    trained_at = made.health()["model"]["trained_at_us"]
    engine.hand(INSTRUCTIONS, INSTRUCTIONS, {"id": "o1", "verb": "renew"})
    assert "if it is no worse" in engine.values(ANSWER)[-1]["text"]
    fed(engine, part(whole, 400, 600))
    model = made.health()["model"]
    assert model["beside"] == {"packets": 200, "wanted": 221, "compared": 0, "to_compare": 55}
    assert model["done"]
    fed(engine, part(whole, 600, 900))
    model = made.health()["model"]
    assert model["done"]
    assert model["beside"] is None
    assert model["trained_at_us"] == int(whole["time_us"][620]) > trained_at
    assert len(models_aside(tmp_path / "model" / "kitsune.npz")) == 1
    assert [each["done"] for each in engine.values(TRAINING_KEY)].count(True) == 2
    assert sum(each["count"] for each in engine.values(SCORE)) == 900


def test_a_model_that_is_worse_does_not_take_over(tmp_path, caplog):
    """It learnt from packets of one length, and finds all others odd."""
    engine, whole = Hands(), mixed(700)
    made = service(tmp_path, engine)
    fed(engine, part(whole, 0, 400))
    before = made.health()["model"]["trained_at_us"]
    engine.hand(INSTRUCTIONS, INSTRUCTIONS, {"id": "o1", "verb": "renew"})
    alike = part(whole, 400, 621)
    fed(engine, RecordBatch({**alike, "length": np.full(221, 60)}), 221)
    # an hour later nothing is left of the statistics of those
    later = part(whole, 0, 400)
    fed(engine, RecordBatch({**later, "time_us": later["time_us"] + 3_600_000_000}))
    assert made.health()["model"]["beside"] is None
    assert made.health()["model"]["trained_at_us"] == before
    assert "the model in use stays" in caplog.text
    assert models_aside(tmp_path / "model" / "kitsune.npz") == []
