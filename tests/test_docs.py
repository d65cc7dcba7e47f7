"""What the documents show is what the product does: every command in them is run."""

import gzip
import json
import re
import shlex
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apps.sonata_adapter.host.spark import SparkMissing, require_spark
from due.backends import open_archive
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.capture.labels import labels_path, read_labels
from sdnator.datasets.mirai_like import MiraiLikeOptions, make
from sdnator.replay.packet_accounting import PacketState
from sdnator.testing.archived_packets import archive_packets
from sdnator.testing.query_traffic import BASE_US, mixed
from tests.end_to_end.command import sdnator
from tests.requirements import missing, optional_program, require_netns
from tests.sdnator.datasets.publisher import UCI, serving

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_TYPED = "what somebody may type\n"
MAKE_TARGETS = set(re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def shell_lines() -> list[tuple[str, str]]:
    """(document, command) for every line of every `sh` block."""
    found = []
    for path in DOCUMENTS:
        for block in re.findall(r"```sh\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
            found += [(path.name, line.split("#")[0].strip()) for line in block.splitlines()]
    return list({line: (name, line) for name, line in found if line}.values())  # each command once


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """What stands for CAPTURE.pcap and LABELS.csv."""
    path = tmp_path_factory.mktemp("docs") / "capture.pcap"
    make(MiraiLikeOptions(seed=2, benign_seconds=120, attack_seconds=20), path)
    return path


@pytest.fixture(scope="module")
def fetched(capture, tmp_path_factory):
    """A mirror with the capture as the data set mirai, and a data folder into which it was fetched."""
    labels = gzip.compress(
        "\n".join(str(int(flag)) for flag in read_labels(labels_path(capture)).attack).encode()
    )
    home = tmp_path_factory.mktemp("share")
    with serving() as publisher:
        publisher.files[f"{UCI}/mirai/Mirai_pcap.pcap.gz"] = gzip.compress(capture.read_bytes())
        publisher.files[f"{UCI}/mirai/Mirai_labels.csv.gz"] = labels
        done = sdnator(
            "dataset", "fetch", "mirai", "--mirror", publisher.url, environment={"XDG_DATA_HOME": str(home)}
        )
        assert done.returncode == 0, done.stderr
        yield publisher.url, home


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """URL of an archive with packets of the last minutes."""
    url = f"sqlite://{tmp_path_factory.mktemp('docs-archive')}/archive.db"
    frames = mixed(["ddos"], seconds=6)
    with closing(open_archive(url)) as driver:
        begin_ns = time.time_ns() - 300 * 10**9
        archive_packets(driver, "s1", frames, base_us=BASE_US, begin_ns=begin_ns, every_ns=10**6)
    return url


def prepared(words: list[str]) -> tuple[list[str], str]:
    """Makes what a command about users or certificates begins with; further words, and what a person would type."""
    if words[1:3] == ["cert", "add"]:
        assert sdnator("cert", "init", "--out", words[words.index("--out") + 1]).returncode == 0
    if words[1] != "user" or words[2] not in ("add", "passwd", "remove"):
        return [], ""
    if words[2] != "add":
        there = sdnator("user", "add", words[3], "--password-stdin", given=_TYPED)
        assert there.returncode == 0, there.stderr
    return ([], "") if words[2] == "remove" else (["--password-stdin"], _TYPED)


def require_parts(words: list[str]) -> None:
    """What a command needs of its machine."""
    if "bmv2" in words:
        optional_program("simple_switch_grpc")
    if "bmv2" in words or "syn-flood" in words:
        require_netns()
    if "spark" in words:
        try:
            require_spark()
        except SparkMissing as error:
            missing(str(error))


BRIDGE = next(line for _, line in shell_lines() if " bridge " in line and " enrol " not in line)


@pytest.mark.parametrize(
    ("document", "line"), [each for each in shell_lines() if each[1] != BRIDGE], ids=lambda text: text
)
def test_command_of_the_documents_works(document, line, capture, tmp_path, monkeypatch, request):
    """A `make` line names a target; an `sdnator` line runs to a good end on a small capture."""
    words = shlex.split(line)
    if words[0] == "make":
        assert set(words[1:]) <= MAKE_TARGETS
        return
    assert words[0] == ".venv/bin/sdnator", f"no test knows how to run: {line}"
    monkeypatch.chdir(tmp_path)
    require_parts(words)
    if words[1] in ("archive", "queries") and "--since" in words:
        monkeypatch.setenv("DUE_ARCHIVE", request.getfixturevalue("archive"))
    if "mirai" in words:
        mirror, home = request.getfixturevalue("fetched")
        monkeypatch.setenv("XDG_DATA_HOME", str(home))
        if "fetch" in words:
            words += ["--mirror", mirror]
        if "detect" in words:
            words += ["--fm-grace", "90", "--ad-grace", "900"]
    values = {"CAPTURE.pcap": str(capture), "LABELS.csv": str(labels_path(capture)), "12000": "1000"}
    arguments = [values.get(word, word) for word in words[1:]]
    if words[1] in ("model", "app", "user") or "--security" in words:
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
        monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    more, given = prepared(words)
    arguments += more
    if "--model" in words:
        trained = [
            "--fm-grace",
            "100",
            "--ad-grace",
            "900",
            "--save-model",
            words[words.index("--model") + 1],
        ]
        assert sdnator("detect", str(capture), "--out", "scores", *trained).returncode == 0
    if words[1] == "replay" and "--train" not in words and "--model" not in words:
        arguments += ["--train", "1000"]
    done = sdnator(*arguments, given=given)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_bridge_of_the_documents_works(tmp_path):
    """It joins two sites, and ends in order."""
    with EmbeddedServer(tmp_path / "n") as near, EmbeddedServer(tmp_path / "f") as far:
        for name, server in (("near.json", near), ("far.json", far)):
            (tmp_path / name).write_text(json.dumps({"updates": server.url}))
            (tmp_path / name).chmod(0o600)
        command = [sys.executable, "-m", "sdnator.cli.main", *shlex.split(BRIDGE)[1:]]
        with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert json.loads(process.stdout.readline())["ready"] is True
            process.terminate()
            assert process.wait(60) == 0


def test_the_notebook_of_the_documents_works(capture, tmp_path, monkeypatch, capsys):
    """The Python block of replay.md runs on a small capture and prints a block and the figures of a detection."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/replay.md").read_text("utf-8"), re.DOTALL)
    assert "train=12_000" in block
    monkeypatch.chdir(tmp_path)
    Path("house.pcap").symlink_to(capture)
    Path("house.labels.csv").symlink_to(labels_path(capture))
    names: dict[str, Any] = {}
    exec(block.replace("12_000", "1_000"), names)  # noqa: S102 - our own document
    result = names["result"]
    packets = result.figures["packets_in"]
    assert packets > 1_000
    assert {len(result.scores), len(result.states), len(result.time_ns), len(result.attack)} == {packets}
    assert int(np.count_nonzero(result.states == PacketState.TRAIN)) == 1_001
    assert not np.isnan(result.scores_without_blocking).any()
    assert np.isnan(result.scores[result.states == PacketState.DROPPED]).all()
    assert result.figures["packets_dropped"] == int(np.count_nonzero(result.states == PacketState.DROPPED))
    printed = capsys.readouterr().out
    assert all(f"{found['address']} {found['reason']}" in printed for found in result.blocks)
    assert f"{result.figures['auc']} ({packets},)" in printed


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """Every relative link and picture of a document exists."""
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path.name} links to {target}"


def _rows(document: str, title: str) -> list[list[str]]:
    """Cells of the table under a heading that is the map of the code."""
    text = (ROOT / document).read_text(encoding="utf-8").partition(f"# {title}\n")[2]
    table = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE)
    return [line.strip("| ").split(" | ") for line in table[0].splitlines()[2:]] if table else []


def _has(path: Path, name: str) -> bool:
    """Whether a file defines each part of a dotted name."""
    source = path.read_text(encoding="utf-8")
    return all(re.search(rf"^ *(class|def) {part}\b", source, re.MULTILINE) for part in name.split("."))


README_MAP = _rows("README.md", "Where to look in the code")
MAP = _rows("docs/architecture.md", "Where to look")


@pytest.mark.parametrize(("what", "name", "files"), MAP, ids=[what for what, *_ in MAP])
def test_the_map_leads_to_the_code(what, name, files):
    """A row of the map names a class or function, and its file is the first one."""
    first, *others = re.findall(r"`([\w/]+\.py)`", files)
    assert _has(ROOT / first, name.strip("`"))
    assert [other for other in others if not (ROOT / other).exists()] == []


def test_the_readme_has_part_of_the_map():
    """Whoever reads the README alone gets to the same places."""
    places = {(name.strip("`"), re.findall(r"`([\w/]+\.py)`", files)[0]) for _, name, files in MAP}
    link = re.compile(r"`([\w.]+)` in \[`[\w/.]+`\]\(([\w/.]+)\)")
    named = {found for _, cell in README_MAP for found in link.findall(cell)}
    assert len(named) >= len(README_MAP)
    assert named <= places
