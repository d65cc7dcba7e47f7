"""What of a changed plan is taken up while the pipeline runs, and what waits."""

from dataclasses import replace
from pathlib import Path

from sdnator.config.planned_switches import PlannedSwitch
from sdnator.up.plan import StandingPlan, changes, taken_up

PLAN = StandingPlan(
    state=Path("/s"), archive="sqlite:///a", settings={"firewall": {}, "kitsune": {}}, dashboard={"port": 1}
)


def test_the_same_plan_changes_nothing():
    assert changes(PLAN, replace(PLAN)) == changes(PLAN, PLAN)
    assert changes(PLAN, PLAN).again == ()
    assert changes(PLAN, PLAN).waits == ()


def test_settings_of_a_part_start_it_again():
    new = replace(PLAN, settings={"firewall": {"detect": False}, "kitsune": {}}, dashboard={"port": 2})
    found = changes(PLAN, new)
    assert found.again == ("firewall", "dashboard")
    assert taken_up(PLAN, new, found.again) == new


def test_new_settings_are_for_all_processes_of_an_app_and_their_number_waits():
    two = replace(PLAN, processes={"firewall": 2, "kitsune": 2})
    assert two.parts()[-4:] == ("sonata_adapter", "firewall", "firewall-2", "dashboard")
    found = changes(
        two, replace(two, settings={"firewall": {"detect": False}, "kitsune": {"threshold": 2.0}})
    )
    assert found.again == ("firewall", "firewall-2")
    found = changes(PLAN, two)
    assert (found.again, found.waits) == ((), ("processes: takes effect when the pipeline is restarted",))
    assert taken_up(PLAN, two, ()) == PLAN


def test_what_the_switches_know_waits_for_the_next_start():
    new = replace(PLAN, updates="redis://x", switches=(PlannedSwitch(name="s2"),), dashboard=None)
    found = changes(PLAN, new)
    assert found.again == ()
    assert [text.partition(":")[0] for text in found.waits] == ["updates", "switches", "dashboard.enabled"]
    assert taken_up(PLAN, new, found.again) == PLAN


def test_kitsune_keeps_its_training(tmp_path):
    """Unless a trained model is named; whether that is being written or used is no change."""
    new = replace(PLAN, settings={"firewall": {}, "kitsune": {"threshold": 2.0}})
    found = changes(PLAN, new)
    assert (found.again, len(found.waits)) == ((), 1)
    assert taken_up(PLAN, new, found.again) == PLAN
    model = replace(PLAN, settings={"firewall": {}, "kitsune": {"threshold": 2.0, "load_model": "/m"}})
    assert changes(PLAN, model).again == ("kitsune",)
    kept = tmp_path / "kitsune.npz"
    new = replace(PLAN, settings={"firewall": {}, "kitsune": {"threshold": 2.0, "keep_model": str(kept)}})
    assert changes(PLAN, new).again == ()
    kept.write_bytes(b"trained")
    assert changes(PLAN, new).again == ("kitsune",)
    trained = replace(PLAN, settings={"firewall": {}, "kitsune": {"load_model": "/m"}})
    assert changes(PLAN, trained).again == ()


def test_a_log_level_is_for_all():
    found = changes(PLAN, replace(PLAN, log_level="debug"))
    assert found.again == ("coordinator", "p4runtime_ctrl", "sonata_adapter", "firewall", "dashboard")
    assert "train it again" in found.waits[0]
