"""`sdnator detect` on captures and tables: files, figures, errors; nothing half-written stays."""

import csv
import gzip
import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sdnator.capture.captures import CaptureWriter
from sdnator.capture.labels import Labels, write_labels
from sdnator.cli.detect_command import detect_command
from sdnator.detect.run import DetectOptions, detect
from sdnator.errors import BadInput
from tests.apps.kitsune.test_afterimage import require_reference_arithmetic
from tests.requirements import shared_data

FM, AD = 500, 1500


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """The first 3,000 real packets as tshark's table."""
    path = tmp_path_factory.mktemp("table") / "first.tsv.gz"
    with gzip.open(shared_data("kitsune/mirai_38k.tsv.gz"), "rb") as whole, gzip.open(path, "wb") as first:
        for _ in range(3_001):
            first.write(whole.readline())
    return path


def options(folder, capture, **changes):
    return DetectOptions(out=folder / "out", capture=capture, fm_grace=FM, ad_grace=AD, **changes)


def scores_of(folder):
    with (folder / "out" / "scores.csv").open() as file:
        return list(csv.DictReader(file))


def test_features_and_scores_of_a_table_equal_the_published_ones(table, tmp_path):
    require_reference_arithmetic()
    seen = []
    summary = detect(
        options(tmp_path, table, features=tmp_path / "f.npy"),
        lambda packets, alerts: seen.append((packets, alerts)),
    )
    features = np.load(tmp_path / "f.npy")
    assert features.dtype == np.float64
    assert features.flags.c_contiguous
    wanted = np.load(shared_data("kitsune/features_first3000_f64.npz"))["features"]
    assert np.array_equal(features, wanted)
    rows = scores_of(tmp_path)
    found = np.array([float(row["score"]) for row in rows])
    published = np.load(shared_data("kitsune/scores.npz"))["first3000_fm500_ad1500_m10"]
    assert np.allclose(found, published, rtol=1e-12, atol=0)
    assert [row["state"] for row in rows] == ["train"] * 2_001 + ["scored"] * 999
    assert (rows[0]["index"], rows[0]["time"]) == ("0", "1540446382.933899000")
    assert (summary["packets"], summary["training_packets"], seen[-1][0]) == (3_000, 2_001, 3_000)
    names = {"alerts.csv", "scores.csv", "scores.parquet", "scores.png", "summary.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == summary


def test_a_capture_with_labels_has_measures(tmp_path):
    capture = shared_data("kitsune/mirai2000.pcap")
    labels = Labels.of(np.arange(2_000) > 1_500)
    write_labels(tmp_path / "labels.csv", labels)
    summary = detect(
        DetectOptions(
            out=tmp_path / "out", capture=capture, labels=tmp_path / "labels.csv", fm_grace=100, ad_grace=900
        )
    )
    assert 0 <= summary["auc"] <= 1
    assert {"tpr_at_fpr_0", "tpr_at_fpr_0.001", "equal_error_rate"} <= summary.keys()


def test_a_model_is_saved_used_and_retrained(table, tmp_path):
    model = tmp_path / "model.npz"
    first = detect(options(tmp_path, table, save_model=model))
    trained = scores_of(tmp_path)
    second = detect(options(tmp_path, table, model=model))
    assert second["training_packets"] == 0
    assert [row["score"] for row in scores_of(tmp_path)[2_001:]] == [row["score"] for row in trained[2_001:]]
    assert second["model_age_s"] < 0  # the model learnt from this very capture
    assert abs(second["benign_drift"]) < 0.5
    third = detect(options(tmp_path, table, retrain_from=model))
    assert third["training_packets"] == first["training_packets"] == 2_001


def test_nanosecond_captures_keep_their_times(tmp_path):
    path = tmp_path / "ns.pcap"
    with CaptureWriter(path, nanoseconds=True) as writer:
        for number in range(200):
            writer.write(1_600_000_000_000_000_001 + number * 1_000_003, bytes(60))
    detect(DetectOptions(out=tmp_path / "out", capture=path, fm_grace=10, ad_grace=50))
    assert scores_of(tmp_path)[3]["time"] == "1600000000.003000010"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"fm_grace": 5_000}, "training alone needs 6,501"),
        ({"model": "none.npz"}, "no such model"),
        ({"model": "a", "retrain_from": "b"}, "cannot be combined"),
        ({"labels": "none.csv"}, "none.csv"),
        ({"threshold": -1.0}, "threshold=-1.0"),
        ({"features": "no/such/folder/f.npy"}, "cannot be written"),
    ],
)
def test_bad_input_is_said_and_leaves_nothing(table, tmp_path, changes, text):
    paths = {"model", "retrain_from", "labels", "features"}
    changes = {name: tmp_path / value if name in paths else value for name, value in changes.items()}
    with pytest.raises(BadInput, match=text):
        detect(
            DetectOptions(
                **{"out": tmp_path / "out", "capture": table, "fm_grace": FM, "ad_grace": AD} | changes
            )
        )
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert left == []


def test_a_folder_that_cannot_be_written_is_named(table, tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(BadInput, match="out: cannot be written"):
        detect(options(tmp_path, table))


def test_an_interrupted_run_leaves_no_features(table, tmp_path):
    def interrupt(_packets, _alerts):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        detect(options(tmp_path, table, features=tmp_path / "f.npy"), interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def command():
    app = typer.Typer()
    app.command()(detect_command)
    return app


def test_the_command_prints_figures_and_json(table, tmp_path):
    arguments = [str(table), "--out", str(tmp_path / "out"), "--fm-grace", str(FM), "--ad-grace", str(AD)]
    plain = CliRunner().invoke(command(), arguments)
    assert plain.exit_code == 0
    assert "3,000 packets: 2,001 for training, 999 scored" in plain.output
    as_json = CliRunner().invoke(command(), [*arguments, "--json", "--mode", "bounded"])
    assert json.loads(as_json.stdout)["mode"] == "bounded"


def test_the_command_wants_one_source(tmp_path):
    result = CliRunner().invoke(command(), ["--out", str(tmp_path)])
    assert isinstance(result.exception, BadInput)
