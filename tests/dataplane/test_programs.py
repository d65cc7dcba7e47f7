"""Compiled programs belong to their sources: the product's, and the one that the tests of the switch run."""

import json
import shutil
from pathlib import Path

import pytest

from sdnator import p4_program
from tests.requirements import optional_program

FEATURES = Path(__file__).resolve().parent / "programs"
PROGRAMS = [(FEATURES, "features"), (p4_program.folder(), "sdnator")]


def test_features_json_is_that_of_features_p4():
    """p4c was run after the last change, and nobody edited what it wrote."""
    p4_program.check(FEATURES, "features")


def test_a_change_of_features_p4_is_noticed(tmp_path):
    base = tmp_path / "programs"
    shutil.copytree(FEATURES, base)
    with (base / "features.p4").open("a", encoding="utf-8") as file:
        file.write("\n")
    with pytest.raises(p4_program.P4ProgramError, match=rf"features\.p4 changed.*compile {base} features"):
        p4_program.check(base, "features")


@pytest.mark.parametrize(("folder", "name"), PROGRAMS, ids=[name for _, name in PROGRAMS])
def test_p4c_makes_the_same_again_without_a_warning(tmp_path, folder, name):
    optional_program("p4c-bm2-ss")
    base = tmp_path / "programs"
    shutil.copytree(folder, base)
    p4_program.compile_program(base, name)
    versions = {json.loads((f / f"{name}.build.json").read_text())["p4c"] for f in (base, folder)}
    if len(versions) > 1:
        pytest.skip(f"p4c is of another version than the one that compiled {name}: {versions}")
    assert p4_program.hashes(base, name) == p4_program.hashes(folder, name)
