"""The compiled program belongs to its source."""

import json
import shutil

import pytest

from sdnator import p4_program


def test_artefacts_belong_to_the_source():
    """p4c was run after the last change of any P4 file, and nobody edited what it wrote."""
    p4_program.check(p4_program.folder())


@pytest.mark.parametrize("name", ["sdnator.p4", "include/parser.p4", "sdnator.json", "sdnator.p4info.txtpb"])
def test_any_change_is_noticed(tmp_path, name):
    """One more byte in a source or artefact is an error that names the file."""
    base = tmp_path / "p4"
    shutil.copytree(p4_program.folder(), base)
    with (base / name).open("a", encoding="utf-8") as file:
        file.write("\n")
    with pytest.raises(p4_program.P4ProgramError, match=name):
        p4_program.check(base)


def test_program_is_found_and_is_what_p4c_made():
    """The JSON is for BMv2 and names the compiler."""
    program = p4_program.find()
    loaded = json.loads(program.bmv2_json.read_text(encoding="utf-8"))
    assert loaded["__meta__"]["compiler"].startswith("https://github.com/p4lang/p4c")
