"""The run file says what runs, and never what has ended."""

import json
import os
import stat
import subprocess
import sys

import pytest

from sdnator.errors import BadInput, PipelineError
from sdnator.up import running

FOUND = running.Running(
    pid=7,
    started=8,
    updates="unix:///u",
    archive="sqlite:///a",
    coordinator="http://127.0.0.1:1",
    parts={"x": 9},
)
HOLDER = """
import sys, time
from pathlib import Path
from sdnator.up import running
with running.claimed(Path(sys.argv[1])):
    running.write(Path(sys.argv[1]), running.Running(pid=1, started=2, updates="", archive="", coordinator=""))
    print("claimed", flush=True)
    time.sleep(600)
"""


def test_what_is_written_is_found_while_it_runs_and_not_later(tmp_path):
    assert running.find(tmp_path) is None
    with running.claimed(tmp_path):
        assert running.holder(tmp_path) == os.getpid()
        assert running.find(tmp_path) is None, "it starts: nothing is known of it yet"
        running.write(tmp_path, FOUND)
        assert running.find(tmp_path) == FOUND
    assert running.find(tmp_path) is None
    assert running.holder(tmp_path) is None
    assert not (tmp_path / "run.json").exists()


def test_only_one_runs(tmp_path):
    with (
        running.claimed(tmp_path),
        pytest.raises(PipelineError, match="sdnator down"),
        running.claimed(tmp_path),
    ):
        pass
    with running.claimed(tmp_path):
        pass


def test_a_killed_one_deceives_nobody(tmp_path):
    """Its run file stays behind, but the kernel has let the lock go."""
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"claimed\n"
        assert running.find(tmp_path) is not None
        process.kill()
        process.wait()
        assert (tmp_path / "run.json").exists()
        assert running.find(tmp_path) is None
    with running.claimed(tmp_path):
        assert running.find(tmp_path) is None, "what the killed one wrote is gone"


def test_another_users_pipeline_is_not_taken_for_none(tmp_path):
    """Such as that of `sudo sdnator up`, which runs although its lock cannot be opened."""
    with running.claimed(tmp_path):
        (tmp_path / "run.lock").chmod(0)
        before = os.geteuid()
        if before == 0:
            os.seteuid(65_534)
        try:
            with pytest.raises(PipelineError, match="sudo"):
                running.find(tmp_path)
        finally:
            os.seteuid(before)


def test_run_file_is_its_owners(tmp_path):
    """It holds URLs, and these may hold passwords."""
    with running.claimed(tmp_path / "state"):
        running.write(tmp_path / "state", FOUND)
        assert stat.S_IMODE((tmp_path / "state" / "run.json").stat().st_mode) == 0o600
        assert stat.S_IMODE((tmp_path / "state").stat().st_mode) == 0o700


@pytest.mark.parametrize("text", [json.dumps({"schema": 99}), "[]", "no json", "[" * 100_000])
def test_another_versions_run_file_is_refused(tmp_path, text):
    with running.claimed(tmp_path):
        (tmp_path / "run.json").write_text(text)
        with pytest.raises(BadInput, match=r"run\.json"):
            running.find(tmp_path)


def test_folders_follow_xdg_and_ignore_relative_paths(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "a b"))
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert running.state_folder() == tmp_path / "a b" / "sdnator"
    assert running.data_folder() == tmp_path / ".local" / "share" / "sdnator"
    assert running.default_archive() == f"sqlite://{tmp_path}/.local/share/sdnator/archive.db"


def test_who_needs_a_pipeline_is_told_how_to_start_one(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with pytest.raises(PipelineError, match="sdnator up"):
        running.need()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="XDG_STATE_HOME"), running.claimed(tmp_path / "file" / "state"):
        pass


@pytest.mark.parametrize("more", [{}, {"pid": 1, "nobody_knows": 2}])
def test_a_damaged_run_file_is_refused(tmp_path, more):
    """Fields are missing, or unknown ones are there."""
    with running.claimed(tmp_path):
        (tmp_path / "run.json").write_text(json.dumps({"schema": running.SCHEMA, **more}))
        with pytest.raises(BadInput, match="is damaged"):
            running.find(tmp_path)
