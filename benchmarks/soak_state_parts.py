"""The parts of `benchmarks.soak_state`, each in a process of its own: memory of one is no memory of another."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from benchmarks import (
    soak_state_adapter,
    soak_state_controller,
    soak_state_coordinator,
    soak_state_firewall,
)

OTHERS: Final = {
    "firewall": soak_state_firewall.figures,
    "sonata_adapter": soak_state_adapter.figures,
    "p4runtime_ctrl": soak_state_controller.figures,
    "coordinator": soak_state_coordinator.figures,
}
PARTS: Final = ("kitsune", *OTHERS)
_AT_ONCE: Final = 2
"""Kitsune's part takes as long as the others one after the other."""


def run_all(options: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Run all parts.

    Args:
        options: of the command line, for each.

    Returns:
        Figures by part.

    Raises:
        SystemExit: a part ended without figures.
    """
    with tempfile.TemporaryDirectory(prefix="soak-state-") as folder, ThreadPoolExecutor(_AT_ONCE) as pool:
        places = {name: Path(folder) / f"{name}.json" for name in PARTS}
        runs = {name: pool.submit(_run, name, place, options) for name, place in places.items()}
        for name, run in runs.items():
            if run.result() not in (0, 1) or not places[name].exists():
                raise SystemExit(f"soak_state: the part {name} ended with {run.result()}")
        return {name: json.loads(place.read_text()) for name, place in places.items()}


def _run(name: str, place: Path, options: Sequence[str]) -> int:
    command = [sys.executable, "-m", "benchmarks.soak_state", "--part", name, "--json", str(place), *options]
    return subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode
