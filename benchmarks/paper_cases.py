"""The paper's networking workflows, by the demonstrations that exist; they belong to no finding of 1 to 12.

Workflow 1: packets, Kitsune, firewall, switch (`sdnator demo`).  Workflow 2: a SYN flood, seen and stopped in the switch
(`sdnator demo syn-flood`, which needs root).
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.paper_findings import Measured

_MOST_S: Final = 400.0
_LAST_S: Final = 60.0


def figures(*, quick: bool) -> tuple[dict[int, dict[str, Measured]], dict[str, Any]]:
    """No finding, and what each workflow reported; quick: workflow 1 alone."""
    found = {"workflow 1": _demo()}
    if not quick:
        found["workflow 2"] = _demo("syn-flood")
    return {}, found


def _demo(*which: str) -> dict[str, Any]:
    program = str(Path(sys.executable).with_name("sdnator"))
    with tempfile.TemporaryDirectory() as folder:
        code, said, problem = run_ending((program, "demo", *which, "--json"), Path(folder), _MOST_S)
    if code:
        return {"failed": problem.strip()[-500:] or f"exit code {code}"}
    return dict(json.loads(said))


def run_ending(command: Sequence[str], folder: Path, seconds: float) -> tuple[int, str, str]:
    """Run a program that ends with us, and that is asked to end where it takes too long: it has namespaces to remove.

    Args:
        command: program and arguments.
        folder: to run it in.
        seconds: after which it is asked to end, and again as long until it is killed.

    Returns:
        Exit code, standard output, standard error.
    """
    process = subprocess.Popen(
        ["setpriv", "--pdeathsig", "TERM", *command],
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        said, problem = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.terminate()
        said, problem = process.communicate(timeout=seconds)
        problem = f"it was asked to end after {seconds:g} s\n{problem}"
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_LAST_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    return process.returncode, said, problem
