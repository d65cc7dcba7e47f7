"""`sdnator demo syn-flood --keep`: a relative folder is below the current one, for the archive, too."""

from contextlib import nullcontext
from pathlib import Path
from typing import NoReturn

import pytest

from sdnator.demos.syn_flood import demo as syn_flood
from sdnator.errors import PipelineError


def test_a_relative_folder_to_keep_is_below_the_current_one(tmp_path, monkeypatch):
    """The archive's URL is made from it: relative, it would be at the root of the file system."""

    def stage(_lab: object, folder: Path, **_options: object) -> NoReturn:
        raise PipelineError(str(folder))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(syn_flood, "Lab", nullcontext)
    monkeypatch.setattr(syn_flood, "FloodStage", stage)
    with pytest.raises(PipelineError, match=str(tmp_path / "k2")):
        syn_flood.run_syn_flood(syn_flood.SynFloodOptions(keep=Path("k2")))
