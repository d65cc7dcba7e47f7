"""The paper's networking workflows, by the demonstrations that exist; they belong to no finding of 1 to 12.

Workflow 1: packets, Kitsune, firewall, switch (`sdnator demo`).  Workflow 2: a SYN flood, seen and stopped in the switch
(`sdnator demo syn-flood`, which needs root).
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from benchmarks.paper_findings import Measured

_MOST_S: Final = 400.0


def figures(*, quick: bool) -> tuple[dict[int, dict[str, Measured]], dict[str, Any]]:
    """No finding, and what each workflow reported; quick: workflow 1 alone."""
    found = {"workflow 1": _demo()}
    if not quick:
        found["workflow 2"] = _demo("syn-flood")
    return {}, found


def _demo(*which: str) -> dict[str, Any]:
    program = Path(sys.executable).with_name("sdnator")
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [program, "demo", *which, "--json"],
            cwd=folder,
            check=False,
            capture_output=True,
            text=True,
            timeout=_MOST_S,
        )
    if done.returncode:
        return {"failed": done.stderr.strip()[-500:]}
    return dict(json.loads(done.stdout))
