"""`sdnator dataset …` does what its help says, and bad input is one clear error."""

import json
import re

import pytest
import typer
from typer.testing import CliRunner

from sdnator.capture.labels import labels_path, read_labels
from sdnator.cli.dataset_commands import dataset, gap_ns
from sdnator.cli.main import app
from sdnator.datasets import local_sets
from sdnator.datasets.local_sets import LocalDataSet
from sdnator.errors import BadInput
from sdnator.testing.table_samples import TSHARK_HEADER, TSHARK_UDP

SHORT = ["--benign-seconds", "30", "--attack-seconds", "20"]


def _run(*words: object) -> str:
    """Output of a command that must succeed."""
    result = CliRunner().invoke(dataset, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def _fail(*words: object) -> str:
    """Text of the BadInput that a command must raise."""
    with pytest.raises(BadInput) as caught:
        CliRunner().invoke(dataset, [str(word) for word in words], catch_exceptions=False)
    return str(caught.value)


def test_make_splice_and_what_they_say(tmp_path):
    out = _run("make", "mirai-like", tmp_path / "a.pcap", "--seed", 3, *SHORT)
    assert re.search(r"a\.pcap: [\d,]+ packets, 50 s; [\d,]+ of the attack, the first at number \d+", out)
    _run(
        "make",
        "mirai-like",
        tmp_path / "b.pcap",
        "--no-background",
        "--floods",
        "syn",
        "--answer-all",
        *SHORT,
    )
    out = _run("splice", tmp_path / "a.pcap", tmp_path / "b.pcap", tmp_path / "c.pcap", "--gap", "500ms")
    packets = int(re.search(r"c\.pcap: ([\d,]+) packets", out)[1].replace(",", ""))  # type: ignore[index]
    assert len(read_labels(labels_path(tmp_path / "c.pcap"), packets)) == packets


def test_options_of_the_generator(tmp_path):
    """No floods, no scan: far fewer attack packets."""
    quiet = _run("make", "mirai-like", tmp_path / "a.pcap", "--floods", "none", "--no-scan", *SHORT)
    loud = _run("make", "mirai-like", tmp_path / "b.pcap", *SHORT)
    count = [int(re.search(r"([\d,]+) of the attack", text)[1].replace(",", "")) for text in (quiet, loud)]  # type: ignore[index]
    assert count[0] < count[1]
    assert "--floods dns: dns is not known" in _fail(
        "make", "mirai-like", tmp_path / "c.pcap", "--floods", "dns"
    )


def test_rebuild(tmp_path):
    (tmp_path / "t.tsv").write_text(f"{TSHARK_HEADER}\n{TSHARK_UDP}\n")
    assert "1 packet, times in µs" in _run("rebuild", tmp_path / "t.tsv", tmp_path / "o.pcap")
    (tmp_path / "t.tsv").write_text("nonsense\n")
    assert "19 columns" in _fail("rebuild", tmp_path / "t.tsv", tmp_path / "p.pcap")
    assert not (tmp_path / "p.pcap").exists()


def test_replay_and_detect_by_name(tmp_path, monkeypatch):
    """A name that was not fetched says how to fetch it; one that was stands for capture, labels and training."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.chdir(tmp_path)
    for words in (["replay", "mirai"], ["detect", "mirai", "--out", "scores"]):
        with pytest.raises(BadInput, match="run `sdnator dataset fetch mirai`"):
            CliRunner().invoke(app, words, catch_exceptions=False)
    _run("make", "mirai-like", tmp_path / "a.pcap", *SHORT)
    local_sets.remember(
        LocalDataSet(name="mirai", capture=tmp_path / "a.pcap", labels=labels_path(tmp_path / "a.pcap"))
    )
    with pytest.raises(BadInput, match=r"a\.pcap: [\d,]+ packets, but training alone needs 55,001"):
        CliRunner().invoke(app, ["replay", "mirai"], catch_exceptions=False)
    graces = ["--fm-grace", "100", "--ad-grace", "400"]
    done = CliRunner().invoke(app, ["detect", "mirai", "--out", "scores", "--json", *graces])
    assert done.exit_code == 0
    assert "data set mirai" in done.stderr
    assert json.loads(done.stdout)["training_packets"] == 501
    assert json.loads(done.stdout)["auc"] is not None


def test_folders_that_are_not_there(tmp_path):
    nowhere = tmp_path / "no" / "x.pcap"
    assert "cannot be written (No such file" in _fail("make", "mirai-like", nowhere, *SHORT)
    (tmp_path / "file").write_text("")
    assert "cannot be written" in _fail("make", "mirai-like", tmp_path / "file" / "x.pcap", *SHORT)


@pytest.mark.parametrize(
    ("text", "value"), [("1s", 10**9), ("500ms", 5 * 10**8), ("0s", 0), ("1.5min", 9 * 10**10)]
)
def test_gaps(text, value):
    assert gap_ns(text) == value


@pytest.mark.parametrize("text", ["1", "s", "-1s", "1h", "1s2"])
def test_wrong_gaps(text):
    with pytest.raises(BadInput, match="--gap"):
        gap_ns(text)


def test_it_is_a_typer_app():
    """The command line mounts it as `dataset`."""
    assert isinstance(dataset, typer.Typer)
