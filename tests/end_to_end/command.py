"""The `sdnator` command as a user runs it."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SECONDS = 170


def sdnator(
    *arguments: str | Path,
    seconds: float = SECONDS,
    environment: Mapping[str, str] | None = None,
    given: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, standard output and error as text; `given` is its standard input, if not empty."""
    command = [sys.executable, "-m", "sdnator.cli.main", *map(str, arguments)]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
        input=given or None,
        env=os.environ | dict(environment or {}),
    )


def figures(*arguments: str | Path) -> dict[str, Any]:
    """The JSON object of a command that must succeed."""
    done = sdnator(*arguments, "--json")
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert isinstance(found, dict)
    return found
