"""What faults cost: `python -m benchmarks.faults --json FILE [--only NAME …]`.

Real processes are killed, stopped and slowed down; the tests of the same faults assert what comes out, here
the seconds are taken.  The scenarios are those of `benchmarks.faults_due` (data layer, Coordinator) and
`benchmarks.faults_switch` (switch and controller).
"""

import importlib.util
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import faults_due
from benchmarks.measure import arguments, bars, machine, table, write_json

Scenario = Callable[[Path], dict[str, Any]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run all scenarios, print, write; 1 where a scenario failed."""
    known = scenarios()
    parser = arguments("faults", __doc__, rounds=1)
    parser.add_argument(
        "--only", nargs="+", choices=sorted(known), metavar="NAME", help="these scenarios only"
    )
    options = parser.parse_args(argv)
    found: dict[str, dict[str, Any]] = {}
    for name, scenario in known.items():
        if not options.only or name in options.only:
            print(f"{name} ...", file=sys.stderr, flush=True)
            found[name] = _run(scenario)
    _show(found)
    write_json(options.json, {"scenarios": found, "machine": machine()})
    return int(any("failed" in figures for figures in found.values()))


def scenarios() -> dict[str, Scenario]:
    """By name."""
    found: dict[str, Scenario] = dict(faults_due.SCENARIOS)
    if importlib.util.find_spec("benchmarks.faults_switch") is not None:
        found.update(importlib.import_module("benchmarks.faults_switch").SCENARIOS)
    return found


def _run(scenario: Scenario) -> dict[str, Any]:
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        try:
            figures = scenario(Path(folder))
        except LookupError as error:
            return {"skipped": str(error)}
        except Exception as error:  # noqa: BLE001 - one scenario must not cost the figures of the others
            return {"failed": f"{type(error).__name__}: {error}"}
    return {**figures, "scenario_s": time.monotonic() - began}


def _show(found: dict[str, dict[str, Any]]) -> None:
    rows = [[name, figure, value] for name, figures in found.items() for figure, value in figures.items()]
    table(["fault", "figure", "value"], rows)
    seconds = {
        f"{name} {figure}": float(value)
        for name, figures in found.items()
        for figure, value in figures.items()
        if figure.endswith("_s") and figure not in ("scenario_s", "heartbeat_s", "away_s")
    }
    bars("seconds", seconds)


if __name__ == "__main__":
    sys.exit(main())
