"""What all benchmarks share: the machine, interleaved rounds, medians, a table, bars, a JSON file."""

import argparse
import json
import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

_BAR = 40


def arguments(name: str, text: str | None, *, rounds: int) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    parser = argparse.ArgumentParser(prog=f"benchmarks.{name}", description=text)
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--rounds", type=int, default=rounds, help="rounds of which the median counts")
    parser.add_argument("--scale", type=float, default=1.0, help="share of the work, for a quick look")
    return parser


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    model = "unknown"
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[0],
        "python": platform.python_version(),
        "kernel": platform.release(),
    }


def interleaved(peers: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Run all peers in turn, `rounds` times; the median of each."""
    results: dict[str, list[float]] = {name: [] for name in peers}
    for _ in range(rounds):
        for name, peer in peers.items():
            results[name].append(peer())
    return {name: statistics.median(values) for name, values in results.items()}


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print an aligned table."""
    texts = [list(map(str, head)), *[[_text(cell) for cell in row] for row in rows]]
    widths = [max(len(row[column]) for row in texts) for column in range(len(head))]
    for row in texts:
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)))


def bars(title: str, values: Mapping[str, float]) -> None:
    """Print a plot: one bar per value, to the scale of the longest."""
    print(f"\n{title}")
    longest = max(values.values(), default=0) or 1
    width = max(map(len, values), default=0)
    for name, value in values.items():
        print(f"  {name.rjust(width)} {'█' * max(1, round(_BAR * value / longest))} {_text(value)}")


def write_json(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write the figures, if a file was asked for."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(figures, indent=2) + "\n")


def _text(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
