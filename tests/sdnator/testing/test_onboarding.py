"""The test that the onboarding page shows is a test, and passes."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def shown():
    """The code block of the section "Testing an app"."""
    section = (ROOT / "docs" / "onboarding.md").read_text(encoding="utf-8").partition("## Testing an app")[2]
    found = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert found is not None
    return found[1]


def run(folder, text):
    """pytest, in a process of its own, on a file with this text."""
    path = folder / "test_shown.py"
    path.write_text(text, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(folder),
        str(path),
    ]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_shown_test_passes(tmp_path):
    """Pasted into a file it runs as it stands."""
    done = run(tmp_path, shown())
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "1 passed" in done.stdout


def test_the_shown_test_can_fail(tmp_path):
    """It does look at what the app writes."""
    done = run(tmp_path, shown().replace("== 64", "== 63"))
    assert "1 failed" in done.stdout, done.stdout[-2000:]
