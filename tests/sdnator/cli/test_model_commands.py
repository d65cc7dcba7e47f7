"""`sdnator model` without a pipeline; with one it is tested in tests/end_to_end/test_up.py."""

import json

import pytest
from typer.testing import CliRunner

from apps.kitsune.detector import Detector
from apps.kitsune.kept_model import KeptModel, models_aside
from sdnator.cli.model_commands import model
from sdnator.errors import BadInput
from sdnator.up import running
from tests.apps.kitsune.test_hostile import mixed
from tests.apps.kitsune.test_kept_model import HERE, SMALL, trained_for


@pytest.fixture
def path(tmp_path, monkeypatch):
    """Where the model of a state folder of its own is kept."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return running.model_file(running.state_folder())


def run(*arguments: str) -> str:
    done = CliRunner().invoke(model, arguments)
    if done.exception is not None:
        raise done.exception
    return done.stdout


def keep(path):
    detector = Detector(SMALL)
    detector.process(mixed(400), "s1")
    KeptModel(path, trained_for(SMALL, HERE)).keep(detector)


def test_a_kept_model_is_shown_and_set_aside(path):
    assert "no model is kept" in run("show")
    assert "the next `sdnator up` trains" in run("retrain")
    keep(path)
    shown = run("show")
    assert shown.startswith("trained until")
    assert "for switch s1: embedded, 1=veth:eth1" in shown
    assert json.loads(run("show", "--json"))["kept"]["senders"] > 0
    assert "kept as" in run("retrain")
    (aside,) = models_aside(path)
    assert not path.exists()
    assert str(aside) in run("show")


def test_a_damaged_one_is_named_with_a_remedy(path):
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no model")
    with pytest.raises(BadInput, match="sdnator model retrain"):
        run("show")
    run("retrain")
    assert "no model is kept" in run("show")
