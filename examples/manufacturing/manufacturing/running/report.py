"""The report of a comparison: four figures as in the paper, normalised, with intervals; criteria; what detectors missed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from manufacturing.criteria import Criterion, fairer, judge, mean_ratio
from manufacturing.scheduling import SCHEDULERS
from manufacturing.statistics import CellTable

REFERENCE: Final = "decentralized"
"""Makespans are shown as shares of this scheduler's, seed by seed."""
_COLOURS: Final = {
    "decentralized": "#9aa7b5",
    "baseline": "#5b7fa6",
    "fcfs": "#d9a441",
    "urgent_first": "#b86f52",
    "dynamic": "#2f8f5b",
}
FIGURES: Final = (
    ("normal", "normal", "final", "Normal: makespan"),
    ("anomalies", "anomalies", "final", "Anomalies: makespan"),
    ("ppe", "ppe", "ppe", "PPE: makespan of the urgent orders"),
    ("ppe_final", "ppe", "final", "PPE: makespan of all orders"),
)
"""File, scenario, which makespan, title."""


def figures_of(table: CellTable, seeds: int, fleets: Sequence[int]) -> dict[str, Any]:
    """All figures of a comparison as plain values.

    Args:
        table: the results.
        seeds: how many of them count, from 0 on; all cells of these must be there.
        fleets: sizes.
    """
    final, ppe, bounds = table.figures(seeds)
    shares: dict[str, dict[str, dict[str, Any]]] = {}
    for name, kind, which, _ in FIGURES:
        some = ppe if which == "ppe" else final
        shares[name] = {
            one: {
                str(n): msgspec.to_builtins(mean_ratio(some[kind, one, n], some[kind, REFERENCE, n]))
                for n in fleets
            }
            for one in SCHEDULERS
        }
    return {
        "seeds": seeds,
        "fleets": list(fleets),
        "normalised_to": REFERENCE,
        "shares": shares,
        "criteria": [msgspec.to_builtins(one) for one in judge(final, ppe, bounds, fleets)],
        "beside": [msgspec.to_builtins(one) for one in fairer(final, ppe, fleets)],
        "detection": _detection(table, seeds),
    }


def _detection(table: CellTable, seeds: int) -> dict[str, float]:
    """Faults, alarms and misses of the twins that watch sensors, over all their cells."""
    watched = [
        one
        for one in table
        if one.seed < seeds
        and one.scenario == "anomalies"
        and one.scheduler in ("fcfs", "urgent_first", "dynamic")
    ]
    faults = sum(one.faults for one in watched)
    return {
        "faults": faults,
        "alarms": sum(one.alarms for one in watched),
        "false_alarms": sum(one.false_alarms for one in watched),
        "ruined": sum(one.ruined for one in watched),
        "prints": sum(one.prints for one in watched),
        "missed_share": sum(one.ruined for one in watched) / faults if faults else 0.0,
    }


def write(figures: Mapping[str, Any], folder: Path) -> Path:
    """Four PNGs and `report.md` in a folder; the path of the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Additive manufacturing: four schedulers",
        "",
        f"{figures['seeds']} seeds; makespans as shares of {figures['normalised_to']}'s, mean and interval of 95 %.",
        "`urgent_first` is not the paper's: it is fcfs that serves urgent orders first, a fairer peer for PPE.",
        "",
    ]
    for name, _, _, title in FIGURES:
        _draw(figures["shares"][name], figures["fleets"], title, folder / f"{name}.png")
        lines += [
            f"## {title}",
            "",
            f"![{title}]({name}.png)",
            "",
            *_table(figures["shares"][name], figures["fleets"]),
            "",
        ]
    lines += ["## Criteria", "", "| finding | criterion | bar | figures | held |", "|---|---|---|---|---|"]
    criteria = msgspec.convert([*figures["criteria"], *figures["beside"]], list[Criterion])
    for one in criteria:
        values = ", ".join(f"{n}: {found.mean:.3f}" for n, found in one.figures.items())
        lines.append(
            f"| {one.finding} | {one.says} | {one.bar:g} | {values} | {'yes' if one.held else 'no'} |"
        )
    found = figures["detection"]
    watched = (
        f"Twins that watch sensors: {found['faults']} faults, {found['alarms']} alarms, {found['false_alarms']} of them "
        f"false, {found['ruined']} of {found['prints']} prints ruined."
    )
    lines += ["", watched, ""]
    path = folder / "report.md"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def _table(shares: Mapping[str, Any], fleets: Sequence[int]) -> list[str]:
    lines = [
        "| scheduler | " + " | ".join(f"{n} printers" for n in fleets) + " |",
        "|---" * (len(fleets) + 1) + "|",
    ]
    for name, by_fleet in shares.items():
        cells = [by_fleet[str(n)] for n in fleets]
        texts = [f"{cell['mean']:.3f} ({cell['low']:.3f} to {cell['high']:.3f})" for cell in cells]
        lines.append(f"| {name} | " + " | ".join(texts) + " |")
    return lines


def _draw(shares: Mapping[str, Any], fleets: Sequence[int], title: str, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    places = np.arange(len(fleets))
    width = 0.8 / len(shares)
    for row, (name, by_fleet) in enumerate(shares.items()):
        means = [by_fleet[str(n)]["mean"] for n in fleets]
        half = [by_fleet[str(n)]["high"] - by_fleet[str(n)]["mean"] for n in fleets]
        at = places + (row - (len(shares) - 1) / 2) * width
        axes.bar(at, means, width, yerr=half, capsize=2, label=name, color=_COLOURS[name])
    axes.set_xticks(places, [f"{n}" for n in fleets])
    axes.set_xlabel("printers")
    axes.set_ylabel(f"share of {REFERENCE}'s")
    axes.set_title(title)
    axes.legend(ncols=len(shares), fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.18), frameon=False)
    figure.savefig(path, dpi=120)
