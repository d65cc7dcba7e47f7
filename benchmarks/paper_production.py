"""Findings 10 to 12: the manufacturing example's comparison, from its pure cores."""

import sys
from pathlib import Path
from typing import Any, Final

from benchmarks.paper_findings import Measured

EXAMPLE: Final = Path(__file__).parents[1] / "examples" / "manufacturing"
_FIGURES: Final = (
    (10, "makespan_to_decentralized"),
    (10, "makespan_to_bound"),
    (11, "anomalies_to_best_other"),
    (12, "urgent_to_best_other"),
    (12, "final_to_best_other"),
)
"""In the order in which the example's criteria come."""
_BESIDE: Final = ("urgent_to_urgent_first", "final_to_urgent_first")


def figures(
    seeds: int, minutes: float, keep: Path, report_folder: Path | None
) -> tuple[dict[int, dict[str, Measured]], dict[str, Any]]:
    """Findings 10 to 12 by number, and all shares; each figure is the worst mean over the fleets, with its interval.

    Args:
        seeds: how many are wanted.
        minutes: after which no more cells are begun.
        keep: the file of results, which is gone on with.
        report_folder: for the example's own report; None: none.
    """
    sys.path.insert(0, str(EXAMPLE))
    from manufacturing.criteria import FLEETS
    from manufacturing.running import report
    from manufacturing.statistics import CellTable

    table = CellTable(keep)
    table.fill(seeds, FLEETS, workers=2, minutes=minutes)
    whole = min(table.whole_seeds(FLEETS), seeds)
    if not whole:
        return {}, {"seeds": 0, "note": f"no seed was complete after {minutes:g} minutes"}
    cells = report.figures_of(table, whole, FLEETS)
    if report_folder is not None:
        report.write(cells, report_folder)
    found: dict[int, dict[str, Measured]] = {}
    for (number, name), criterion in zip(_FIGURES, cells["criteria"], strict=True):
        found.setdefault(number, {})[name] = _worst(criterion)
    for name, criterion in zip(_BESIDE, cells["beside"], strict=True):
        found[12][name] = _worst(criterion)
    return found, cells


def _worst(criterion: dict[str, Any]) -> Measured:
    """The mean of the worst fleet, between the ends of its interval."""
    worst = max(criterion["figures"].values(), key=lambda one: one["mean"])
    return Measured((worst["low"], worst["mean"], worst["high"]))
