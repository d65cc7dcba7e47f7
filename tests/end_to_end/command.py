"""The `sdnator` command as a user runs it."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

SECONDS = 170


def sdnator(*arguments: str | Path, seconds: float = SECONDS) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, standard output and error as text."""
    command = [sys.executable, "-m", "sdnator.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)


def figures(*arguments: str | Path) -> dict[str, Any]:
    """The JSON object of a command that must succeed."""
    done = sdnator(*arguments, "--json")
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert isinstance(found, dict)
    return found
