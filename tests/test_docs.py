"""What the documents show is what the product does: every command in them is run."""

import re
import shlex
from pathlib import Path

import pytest

from sdnator.datasets.mirai_like import Options, make
from sdnator.labels import labels_path
from tests.end_to_end.command import sdnator
from tests.requirements import optional_program, require_netns

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
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
    make(Options(seed=2, benign_seconds=120, attack_seconds=20), path)
    return path


@pytest.mark.parametrize(("document", "line"), shell_lines(), ids=lambda text: text)
def test_command_of_the_documents_works(document, line, capture, tmp_path, monkeypatch):
    """A `make` line names a target; an `sdnator` line runs to a good end on a small capture."""
    words = shlex.split(line)
    if words[0] == "make":
        assert set(words[1:]) <= MAKE_TARGETS
        return
    assert words[0] == ".venv/bin/sdnator", f"no test knows how to run: {line}"
    monkeypatch.chdir(tmp_path)
    if "bmv2" in words:
        optional_program("simple_switch_grpc")
        require_netns()
    if "syn-flood" in words:
        require_netns()
    values = {"CAPTURE.pcap": str(capture), "LABELS.csv": str(labels_path(capture)), "12000": "1000"}
    arguments = [values.get(word, word) for word in words[1:]]
    if words[1] == "replay" and "--train" not in words:
        arguments += ["--train", "1000"]
    done = sdnator(*arguments)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """Every relative link and picture of a document exists."""
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path.name} links to {target}"
