"""Health becomes Prometheus text that the reference parser reads, with units in the names."""

from prometheus_client.parser import text_string_to_metric_families

from due.metrics import render

ENGINE = {
    "app": "x", "instance": "i1", "phase": "alone", "active": True, "written": 7,
    "updates": {"kept_bytes": 12}, "receiving": {"gaps": 3, "misplaced": 4}, "liveness": {"status": "ok", "heartbeat_s": 0.5}, "archive": {"backlog": 2},
}  # fmt: skip


def _samples(health):
    families = list(text_string_to_metric_families(render("x", ENGINE, health)))
    return {
        sample.name
        + str({k: v for k, v in sample.labels.items() if k not in ("app", "instance")}): sample.value
        for family in families
        for sample in family.samples
    }


def test_the_engine_is_described_with_types_and_units():
    found = _samples({})
    assert found["due_written_items_total{}"] == 7
    assert found["due_updates_kept_bytes{}"] == 12
    assert found["due_missing_items_total{}"] == 3
    assert found["due_archive_backlog_frames{}"] == 2
    assert found["due_misplaced_frames_total{}"] == 4
    assert found["due_heartbeat_silent_seconds{}"] == 0.5
    assert found["due_active{}"] == 1
    assert found["due_phase{'phase': 'alone'}"] == 1
    kinds = {f.name: f.type for f in text_string_to_metric_families(render("x", ENGINE, {}))}
    assert (kinds["due_written_items"], kinds["due_active"]) == ("counter", "gauge")


def test_an_apps_numbers_lists_and_switches_are_samples():
    found = _samples(
        {
            "age_s": 1.5,
            "guarded": ["a", "b"],
            "text": "left out",
            "deep": {"odd name!": float("nan"), "on": False},
            "switches": [{"name": 's"1\n', "lost": 4}, {"lost": 5}],
        }
    )
    assert found["x_age_seconds{}"] == 1.5
    assert found["x_guarded{}"] == 2
    assert found["x_deep_on{}"] == 0
    assert str(found["x_deep_odd_name_{}"]) == "nan"
    assert found["""x_switches_lost{'name': 's"1\\n'}"""] == 4
    assert found["x_switches_lost{'index': '1'}"] == 5
    assert not [name for name in found if "text" in name]
