"""The memory of a process and of all below it, by name."""

import os
import subprocess
import sys

from benchmarks.soak_memory import folder_bytes, footprints

HOLDS = "import sys; held = bytearray(80 << 20); print('ready', flush=True); sys.stdin.read()"


def test_processes_below_one_are_found_with_what_they_hold():
    """A known one by its name, others by that of the one above and their program."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        known = footprints(os.getpid(), {child.pid: "kitsune"})
        unknown = footprints(os.getpid(), {})
        child.kill()
    assert known["kitsune"]["anonymous_kb"] >= 80 << 10
    assert known["kitsune"]["processes"] == known["kitsune"]["threads"] == 1
    assert known["kitsune"]["files"] >= 3
    assert known["up"]["processes"] == 1
    assert any(name.startswith("up/") and each["anonymous_kb"] >= 80 << 10 for name, each in unknown.items())


def test_the_size_of_a_folder(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "a").write_bytes(b"1234")
    (tmp_path / "below" / "b").write_bytes(b"12")
    assert folder_bytes(tmp_path) == 6
