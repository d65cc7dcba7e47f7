"""Parts of the cluster benchmark that cannot run say why; those that break or lose something end it with 1."""

import json
import sys
from types import SimpleNamespace

import pytest

from benchmarks import cluster
from benchmarks.cluster_stage import PartMissing, Round, lost_in, median_pause, rounds_of
from sdnator.testing.kafka_servers import KafkaMissing


def _raising(error: Exception):
    def figures(*_: object) -> dict[str, object]:
        raise error

    return SimpleNamespace(figures=figures)


def _run(monkeypatch, tmp_path, part: SimpleNamespace) -> tuple[int, dict[str, object]]:
    monkeypatch.setitem(sys.modules, "benchmarks.cluster_bridge", part)
    code = cluster.main(["--only", "bridge", "--json", str(tmp_path / "f.json")])
    return code, json.loads((tmp_path / "f.json").read_text())


def test_a_part_that_cannot_run_here_says_why(monkeypatch, tmp_path):
    code, figures = _run(monkeypatch, tmp_path, _raising(PartMissing("no root")))
    assert (code, figures["bridge_missing"]) == (0, "no root")


def test_a_part_that_breaks_ends_with_1(monkeypatch, tmp_path):
    code, figures = _run(monkeypatch, tmp_path, _raising(RuntimeError("nothing crosses")))
    assert (code, figures["bridge_failed"]) == (1, "RuntimeError: nothing crosses")


@pytest.mark.parametrize("name", ["bridge_lost", "bridge_uncounted", "kafka_acknowledged_lost"])
def test_a_loss_ends_with_1(monkeypatch, tmp_path, name):
    for lost in (0, 3):
        part = SimpleNamespace(figures=lambda *_, lost=lost: {name: lost, "failover_ms_p50": {"bridge": 1.0}})
        code, figures = _run(monkeypatch, tmp_path, part)
        assert (code, figures[name], figures["failover_ms_p50"]) == (int(lost > 0), lost, {"bridge": 1.0})


@pytest.mark.parametrize(("difference", "code"), [(0.0, 0), (1e-12, 0), (1e-9, 1), (float("inf"), 1)])
def test_another_score_ends_with_1(monkeypatch, tmp_path, difference, code):
    part = SimpleNamespace(figures=lambda *_: {"shard_scores_equal": difference})
    assert _run(monkeypatch, tmp_path, part)[0] == code


def test_the_plan_needs_root(monkeypatch, tmp_path):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert cluster.main(["--only", "plan", "--json", str(tmp_path / "f.json")]) == 0
    assert "root" in json.loads((tmp_path / "f.json").read_text())["plan_missing"]


def test_the_plan_is_measured_with_its_own_load(monkeypatch, tmp_path):
    part = SimpleNamespace(
        figures_of=lambda pps, seconds: {"plan_error": pps + seconds}, PPS=1.0, SECONDS=4.0
    )
    monkeypatch.setitem(sys.modules, "benchmarks.cluster_plan", part)
    monkeypatch.setattr("os.geteuid", lambda: 0)
    cluster.main(["--only", "plan", "--scale", "0.5", "--json", str(tmp_path / "f.json")])
    assert json.loads((tmp_path / "f.json").read_text())["plan_error"] == 3.0


def test_kafka_without_its_jars_is_missing(monkeypatch, tmp_path):
    def no_java() -> None:
        raise KafkaMissing("Kafka needs Java")

    monkeypatch.setattr("benchmarks.cluster_kafka.kafka_jars", no_java)
    code = cluster.main(["--only", "kafka", "--json", str(tmp_path / "f.json")])
    assert (code, json.loads((tmp_path / "f.json").read_text())["kafka_missing"]) == (0, "Kafka needs Java")


def test_rounds_end_when_the_time_is_over():
    found = rounds_of(("one", "two"), lambda name, number: Round(number, len(name)), 5, end=0.0)
    assert {name: len(results) for name, results in found.items()} == {"one": 1, "two": 1}
    found = rounds_of(("one",), lambda _, number: Round(number, 10.0 * number), 3, end=float("inf"))
    assert (lost_in(found), median_pause(found, "one")) == (3, 10.0)
