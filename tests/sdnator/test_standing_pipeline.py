"""Parts that die are started again, but not for ever, and never the switch."""

import time

import msgspec
import pytest

from apps.p4runtime_ctrl.stations import LearnSettings
from sdnator.errors import BadInput, PipelineError
from sdnator.planned_switches import PlannedSwitch
from sdnator.standing_pipeline import DEATHS, StandingPipeline
from sdnator.standing_plan import StandingPlan
from sdnator.up_settings import LearnPlan


@pytest.fixture
def pipeline(tmp_path):
    (tmp_path / "logs").mkdir()
    told: list[str] = []
    made = StandingPipeline(StandingPlan(state=tmp_path, archive=""), told.append)
    yield made, told
    made.stop()


def watch_until_error(made):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        made.watch()
        time.sleep(0.01)


def test_what_dies_again_and_again_ends_the_pipeline(pipeline):
    made, told = pipeline
    made._child("kitsune", "tests.sdnator.short_lived").wait_ready()
    with pytest.raises(PipelineError, match="kitsune dies again and again"):
        watch_until_error(made)
    assert told == ["kitsune ended with exit code 0 without a word: started again"] * DEATHS


def test_the_switch_is_not_started_again(pipeline):
    made, told = pipeline
    made._child("switch", "tests.sdnator.short_lived").wait_ready()
    with pytest.raises(PipelineError, match="switch ended with exit code 0"):
        watch_until_error(made)
    assert told == []


@pytest.mark.parametrize(
    ("updates", "kind"), [("http://somewhere", BadInput), ("redis://127.0.0.1:1/0", PipelineError)]
)
def test_a_server_that_is_not_there_ends_the_start_before_anything_runs(tmp_path, updates, kind):
    plan = StandingPlan(state=tmp_path, archive="", updates=updates)
    with pytest.raises(kind, match="Data Updates"), StandingPipeline(plan, print):
        pass
    assert not list((tmp_path / "logs").iterdir())


def test_the_controller_is_told_which_switch_learns(tmp_path):
    """As its own settings have it; a switch that does not learn has nothing of it."""
    switches = (PlannedSwitch(learn=LearnPlan(ports=(1, 2))), PlannedSwitch(name="s2"))
    made = StandingPipeline(StandingPlan(state=tmp_path, archive="", switches=switches), print)
    made._bases = made.switch_addresses = dict.fromkeys(("s1", "s2"), 0)
    first, second = made._settings("p4runtime_ctrl")["switches"]
    assert msgspec.convert(first["learn"], LearnSettings).ports == (1, 2)
    assert "learn" not in second


def test_logs_of_the_last_run_are_kept_beside(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "kitsune.log").write_text("before")
    plan = StandingPlan(state=tmp_path, archive="", updates="redis://127.0.0.1:1/0")
    with pytest.raises(PipelineError), StandingPipeline(plan, print):
        pass
    assert (tmp_path / "logs" / "kitsune.log.1").read_text() == "before"
