"""What `sdnator up` makes of its plan; tests/sdnator/supervisor has what becomes of parts that die."""

import stat
from contextlib import ExitStack

import msgspec
import pytest

from apps.p4runtime_ctrl.state.mac_learning import LearnSettings
from sdnator.config.planned_switches import PlannedSwitch
from sdnator.config.up_settings import LearnPlan
from sdnator.errors import BadInput, PipelineError
from sdnator.supervisor.settings import SupervisorSettings
from sdnator.up.parts import UpParts
from sdnator.up.pipeline import StandingPipeline
from sdnator.up.plan import StandingPlan

SECRET = "redis://:hunter2hunter2@127.0.0.1:1/0"  # noqa: S105 - nobody's


@pytest.fixture
def parts(tmp_path):
    """Make the parts of a plan."""
    (tmp_path / "logs").mkdir()
    with ExitStack() as stack:
        yield lambda **more: UpParts(StandingPlan(**{"state": tmp_path, "archive": "", **more}), stack)


def test_switches_are_started_first_and_stopped_last_and_follow_nobody(parts):
    """No other part's restart touches them."""
    switches = (PlannedSwitch(name="a"), PlannedSwitch(name="b"))
    specs = parts(switches=switches).specs()
    assert [spec.name for spec in specs[:3]] == ["switch-a", "switch-b", "updates"]
    for switch in specs[:2]:
        assert switch.restart is not None
        assert (switch.after, switch.needs, switch.follows) == ((), (), ())


def test_no_death_ends_the_pipeline_and_only_the_page_may_be_missing_at_first(parts):
    specs = parts(dashboard={}, supervisor=SupervisorSettings(restart_s=1.0)).specs()
    assert {spec.restart and spec.restart.first_s for spec in specs} == {1.0}
    assert [spec.name for spec in specs if not spec.vital] == ["dashboard"]


def test_urls_reach_an_app_in_a_file_of_its_user_and_not_as_arguments(parts, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr("sdnator.up.parts.Child", lambda *given, **more: seen.append((given, more)))
    made = parts(updates=SECRET, archive=SECRET.replace("redis", "mongodb"), engine={"linger": 0.1})
    made._app("kitsune")
    assert "hunter2" not in repr(seen)
    engine = tmp_path / "kitsune.engine.json"
    assert stat.S_IMODE(engine.stat().st_mode) == 0o600
    said = msgspec.json.decode(engine.read_bytes())
    password = made.identities.all["kitsune"].password
    user = f"{made.identities.prefix}kitsune:{password}"
    assert (said["updates"], said["linger"]) == (f"redis://{user}@127.0.0.1:1/0", 0.1)
    assert "network.packets.p4runtime_ctrl.*.all" in said["observable"]
    assert password not in repr(seen)
    made.share_credential()  # of a server that lets it make no users
    made._app("kitsune")
    assert msgspec.json.decode(engine.read_bytes())["updates"] == SECRET


def test_several_processes_of_an_app_share_its_credential_and_settings_but_no_file(
    parts, tmp_path, monkeypatch
):
    seen = []
    monkeypatch.setattr("sdnator.up.parts.Child", lambda *given, **_: seen.append(given))
    settings = {"p4runtime_ctrl": {"instances": "sharded"}}
    made = parts(settings=settings, processes={"p4runtime_ctrl": 2}, dashboard={})
    specs = {spec.name: spec for spec in made.specs()}
    assert specs["p4runtime_ctrl-2"].vital
    assert "p4runtime_ctrl-2" in specs["dashboard"].after
    for part in ("p4runtime_ctrl", "p4runtime_ctrl-2"):
        specs[part].start()
    assert [(given[0], given[1][0]) for given in seen] == [
        (part, "apps.p4runtime_ctrl.service") for part in ("p4runtime_ctrl", "p4runtime_ctrl-2")
    ]
    engines = [msgspec.json.decode((tmp_path / f"{given[0]}.engine.json").read_bytes()) for given in seen]
    assert engines[0]["updates"] == engines[1]["updates"]
    assert engines[0]["directory"] != engines[1]["directory"]
    first, second = ((tmp_path / f"{given[0]}.settings.json").read_bytes() for given in seen)
    assert first == second


def test_kitsune_goes_on_with_what_it_has_learnt(parts, tmp_path):
    """Started again after its training, it does not train anew over its own model."""
    model = tmp_path / "home.model"
    made = parts(settings={"kitsune": {"save_model": str(model)}})
    assert made.settings("kitsune") == {"save_model": str(model)}
    model.write_bytes(b"learnt")
    assert made.settings("kitsune") == {"save_model": "", "load_model": str(model)}


@pytest.mark.parametrize(
    ("updates", "kind"), [("http://somewhere", BadInput), ("redis://127.0.0.1:1/0", PipelineError)]
)
def test_a_server_that_is_not_there_ends_the_start_before_anything_runs(tmp_path, updates, kind):
    plan = StandingPlan(state=tmp_path, archive="", updates=updates)
    with pytest.raises(kind, match="Data Updates"), StandingPipeline(plan, print):
        pass
    assert not list((tmp_path / "logs").iterdir())


def test_the_controller_is_told_which_switch_learns(parts):
    """As its own settings have it; a switch that does not learn has nothing of it."""
    switches = (PlannedSwitch(learn=LearnPlan(ports=(1, 2))), PlannedSwitch(name="s2"))
    first, second = parts(switches=switches).settings("p4runtime_ctrl")["switches"]
    assert msgspec.convert(first["learn"], LearnSettings).ports == (1, 2)
    assert "learn" not in second


def test_a_password_is_in_no_message(tmp_path):
    plan = StandingPlan(state=tmp_path, archive="", updates=SECRET)
    with pytest.raises(PipelineError) as caught, StandingPipeline(plan, print):
        pass
    assert "hunter2" not in str(caught.value)


def test_logs_of_the_last_run_are_kept_beside(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "kitsune.log").write_text("before")
    plan = StandingPlan(state=tmp_path, archive="", updates="redis://127.0.0.1:1/0")
    with pytest.raises(PipelineError), StandingPipeline(plan, print):
        pass
    assert (tmp_path / "logs" / "kitsune.log.1").read_text() == "before"


def test_every_part_is_told_the_token_of_the_metrics_by_a_file(parts, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr("sdnator.up.parts.Child", lambda *given, **more: seen.append((given, more)))
    file = tmp_path / "metrics.token"
    secret = "hunter2" * 3
    file.write_text(secret + "\n")
    made = parts(metrics_host="127.0.0.1", metrics_token_file=str(file))
    for name in ("kitsune", "coordinator"):
        made._app(name)
    assert str(file) in repr(seen[0])
    assert "hunter2" not in repr(seen)
    assert made.settings("coordinator")["metrics_token"] == secret
    assert not parts().settings("coordinator")["metrics_token"]
